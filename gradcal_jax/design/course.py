"""The chamber's temperature course as free numbers in a search: its legs, turning points and slopes; and the same in
numbers that its controller takes."""

import math
from typing import Any, NamedTuple

import numpy as np
from jaxtyping import Float

from gradcal_jax.arrays import AnyArray, namespace
from gradcal_jax.motion import Programme
from gradcal_jax.recipe.tracks import ControllerSteps

# Least duration of a stretch, as a share of an even one; distance of a vector's values from their bounds, as a share.
_LEAST_SHARE = 0.1
_INSIDE = 1e-4
# A stretch of fewer steps of slope becomes a soak: rounding would change its duration too much.
_LEVEL = 5
# Resolution of the soak that fills the end of a programme; s.
_TIME = 0.1


class ProgrammeCoordinates(NamedTuple):
    """Temperature programmes of `stretches` slopes after a soak, each from any real vector `(2·stretches + 1,)`:
    durations are least times and shares of what is left, slopes lie between the steepest cooling and heating and end
    within the range.

    `soak`, `time` (of the programme, without the soak): s. `coldest`, `warmest`: °C; `heating`, `cooling`: K/s, sizes.
    """

    soak: float
    time: float
    coldest: float
    warmest: float
    heating: float
    cooling: float
    stretches: int

    def programme(self, z: Float[AnyArray, " size"]) -> Programme:
        """The programme of a vector: its soak, and the stretches."""
        timed, sloped, first = z[: self.stretches], z[self.stretches : -1], z[-1]
        xp = namespace(z)
        least = _LEAST_SHARE * self.time / self.stretches
        weight = xp.exp(timed - xp.max(timed))
        durations = least + (self.time - self.stretches * least) * weight / xp.sum(weight)
        slopes = 0.5 * (self.heating - self.cooling) + 0.5 * (self.heating + self.cooling) * xp.tanh(sloped)
        here = self.coldest + (self.warmest - self.coldest) * 0.5 * (1.0 + xp.tanh(0.5 * first))
        start, reached = here, [xp.zeros(())]
        for k in range(self.stretches):
            there = xp.clip(here + slopes[k] * durations[k], self.coldest, self.warmest)
            reached.append((there - here) / durations[k])
            here = there
        lasting = xp.concatenate([xp.asarray([self.soak]), durations])
        return Programme(xp.asarray(start), lasting, xp.stack(reached), xp.zeros(lasting.shape))

    def vector(self, start: float, durations: np.ndarray, slopes: np.ndarray) -> Float[np.ndarray, " size"]:
        """Coordinates of a programme of at most `stretches` slopes (°C, s, K/s), the longest ones halved as often as
        necessary; values at a bound are moved slightly inside."""
        while len(durations) < self.stretches:
            k = int(np.argmax(durations))
            durations = np.insert(durations, k, 0.5 * durations[k])
            durations[k + 1] *= 0.5
            slopes = np.insert(slopes, k, slopes[k])
        spare = np.maximum(durations / self.time - _LEAST_SHARE / self.stretches, _INSIDE)
        size = (2.0 * slopes - self.heating + self.cooling) / (self.heating + self.cooling)
        share = np.clip((start - self.coldest) / (self.warmest - self.coldest), _INSIDE, 1.0 - _INSIDE)
        sloped = np.arctanh(np.clip(size, _INSIDE - 1.0, 1.0 - _INSIDE))
        return np.concatenate([np.log(spare), sloped, [np.log(share / (1.0 - share))]])

    def starts(self, own: Float[np.ndarray, " size"]) -> list[Float[np.ndarray, " size"]]:
        """Courses from which a search begins: the file's own, and there and back over the same range, from either
        end."""
        knots = self.knots(own)
        low, high = float(np.min(knots)), float(np.max(knots))
        first, last = (low, high) if knots[0] <= knots[-1] else (high, low)
        result = [own]
        for begin, turn, share in ((first, last, 0.5), (last, first, 0.5), (first, last, 0.65)):
            durations = np.array([share, 1.0 - share]) * self.time
            slopes = np.array([turn - begin, begin - turn]) / durations
            result.append(self.vector(begin, durations, slopes))
        return result

    def knots(self, z: Float[np.ndarray, " size"]) -> np.ndarray:
        """Where the slopes begin and end, °C."""
        return self.programme(z).chamber()[1]

    def keys(self, z: Float[np.ndarray, " size"], steps: ControllerSteps) -> dict[str, Any]:
        """The keys of a spec's course: stretches at slopes and temperatures of the controller's steps, no steeper than
        the chamber allows."""
        here = _on_grid(self.knots(z)[0], float(steps.temperature))
        soak = {"soak": _s(self.soak), "at": _c(here), "used": False}
        whole = [soak, *self._stretches(here, z, steps)]
        return {"plan.temperature": None, "plan.gradient": None, "plan.soak": None, "plan.programme": whole}

    def _stretches(self, here: float, z: np.ndarray, steps: ControllerSteps) -> list[dict[str, object]]:
        """Ramps and soaks. The next stretch compensates the rounding of one; one that rounds to nothing is a soak."""
        ends, goals = np.cumsum(self.programme(z).durations[1:]), self.knots(z)[1:]
        slope_step, step = float(steps.slope), float(steps.temperature)
        items: list[dict[str, object]] = []
        written_s, went_up = 0.0, False
        for end, goal in zip(ends, goals, strict=True):
            lasting, up = float(end) - written_s, float(goal) > here
            steepest, room = (self.heating, self.warmest - here) if up else (self.cooling, here - self.coldest)
            count = min(round(abs(float(goal) - here) / lasting / slope_step), int(steepest / slope_step + 1e-6))
            slope = count * slope_step
            change = math.floor(min(slope * lasting, room) / step + 1e-6) * step
            if count < _LEVEL or change <= 0.0:
                whole = float(round(lasting))
                items.append({"soak": _s(whole), "used": True})
                written_s += whole
                continue
            here = _on_grid(here + (change if up else -change), step)
            ramp: dict[str, object] = {"ramp_to": _c(here), "rate": f"{slope * 60.0:.12g} K/min"}
            if items and items[-1].get("rate") == ramp["rate"] and up == went_up:
                items[-1] = ramp
            else:
                items.append(ramp)
            written_s, went_up = written_s + change / slope, up
        if (left := float(ends[-1]) - written_s) > _TIME:
            items.append({"soak": _s(_TIME * math.ceil(left / _TIME - 1e-6)), "used": True})
        return items


def _on_grid(value: float, step: float) -> float:
    return round(value / step) * step


def _s(seconds: float) -> str:
    return f"{seconds:.9g} s"


def _c(temperature: float) -> str:
    return f"{temperature:.12g} degC"
