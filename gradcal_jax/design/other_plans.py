"""Free coordinates of plans without moves: temperature programmes for a standing axis, and the standard method.

As in `coordinates`, any real vector is a plan that the rig can execute:

| what | from free numbers | why it is feasible |
|---|---|---|
| durations of a programme's stretches | least times + remaining time · softmax | they fill the time exactly |
| slopes | tanh between steepest cooling and heating, clipped to the chamber's range | both limits hold |
| first temperature, the standard method's temperatures | range · sigmoid | inside the chamber's range |
| the standard method's rates | largest · tanh | the table's and the sensor's limit |
| integration time | even share of the time without soaks | it fills the time exactly |
"""

import equinox as eqx
import numpy as np
from jaxtyping import Float

from gradcal_jax.arrays import AnyArray, namespace
from gradcal_jax.motion import Programme, Schedule, standard_plan
from gradcal_jax.motion.motion import even_division, standing
from gradcal_jax.motion.schedule import Points, make_schedule

# Least duration of a stretch, as a share of an even one.
_LEAST_SHARE = 0.1
# Distance of a vector's values from their bounds, as a share.
_INSIDE = 1e-4
# Pieces of a stretch in which the readings of a standing axis are searched.
_PIECES_A_STRETCH = 16


class ProgrammeCoordinates(eqx.Module):
    """Temperature programmes of `stretches` slopes for a standing axis, after a soak.

    `soak`, `time` (of the programme, without the soak), `read_every`: s. `coldest`, `warmest`: °C; `heating`,
    `cooling`: K/s, sizes. `soak_used`: whether the soak's readings count.
    """

    soak: Float[AnyArray, ""]
    time: Float[AnyArray, ""]
    read_every: Float[AnyArray, ""]
    coldest: Float[AnyArray, ""]
    warmest: Float[AnyArray, ""]
    heating: Float[AnyArray, ""]
    cooling: Float[AnyArray, ""]
    stretches: int = eqx.field(static=True)
    soak_used: bool = eqx.field(static=True)

    @property
    def size(self) -> int:
        """Number of free coordinates."""
        return 2 * self.stretches + 1

    def decode(self, z: Float[AnyArray, " size"]) -> Schedule:
        """The plan of a vector, its readings relaxed."""
        of = self.programme(z)
        xp, nothing = namespace(of), [0.0]
        durations = xp.concatenate([xp.reshape(xp.asarray(self.soak), (1,)), of.durations])
        whole = Programme(
            of.start, durations, xp.concatenate([xp.asarray(nothing), of.slopes]), xp.zeros(durations.shape)
        )
        first = 0 if self.soak_used else 1
        pieces, none = standing(even_division(_PIECES_A_STRETCH, True)), np.zeros(self.stretches + 1)
        blank = Programme(np.zeros(()), none, none, none)
        stays = range(first, self.stretches + 1)
        template = make_schedule(
            blank, [(0.0, 0.0, 0.0)] * len(stays), [(k, pieces) for k in range(len(stays))], first_knot=first,
            spacing=1.0,
        )  # fmt: skip
        numbers = durations[first:], xp.asarray(self.read_every), whole
        return eqx.tree_at(lambda s: (s.duration, s.spacing, s.programme), template, numbers)

    def programme(self, z: Float[AnyArray, " size"]) -> Programme:
        """The programme of a vector, without its soak."""
        timed, sloped, first = (z[: self.stretches], z[self.stretches : 2 * self.stretches], z[2 * self.stretches :])
        xp = namespace(z, self.time)
        least = _LEAST_SHARE * self.time / self.stretches
        weight = xp.exp(timed - xp.max(timed))
        durations = least + (self.time - self.stretches * least) * weight / xp.sum(weight)
        slopes = 0.5 * (self.heating - self.cooling) + 0.5 * (self.heating + self.cooling) * xp.tanh(sloped)
        here = _between(self.coldest, self.warmest, first[0])
        start, reached = here, []
        for k in range(self.stretches):
            there = xp.clip(here + slopes[k] * durations[k], self.coldest, self.warmest)
            reached.append((there - here) / durations[k])
            here = there
        return Programme(xp.asarray(start), durations, xp.stack(reached), xp.zeros(durations.shape))

    def vector(self, start: float, durations: np.ndarray, slopes: np.ndarray) -> Float[np.ndarray, " size"]:
        """Coordinates of a programme of at most `stretches` slopes (°C, s, K/s), the longest ones halved as often as
        necessary; values at a bound are moved slightly inside."""
        while len(durations) < self.stretches:
            k = int(np.argmax(durations))
            durations = np.insert(durations, k, 0.5 * durations[k])
            durations[k + 1] *= 0.5
            slopes = np.insert(slopes, k, slopes[k])
        time, heating, cooling = (float(v) for v in (self.time, self.heating, self.cooling))
        spare = np.maximum(durations / time - _LEAST_SHARE / self.stretches, _INSIDE)
        size = (2.0 * slopes - heating + cooling) / (heating + cooling)
        first = _share(float(self.coldest), float(self.warmest), np.array([start]))
        return np.concatenate([np.log(spare), np.arctanh(np.clip(size, _INSIDE - 1.0, 1.0 - _INSIDE)), first])


class StandardCoordinates(eqx.Module):
    """The standard method at a number of `temperatures`, all rates at each, in a fixed time.

    `soak` (each), `time` (all): s. `coldest`, `warmest`: °C. `max_rate` rad/s. `fixed_rates` rad/s hold unless
    `rates_free`.
    """

    soak: Float[AnyArray, ""]
    time: Float[AnyArray, ""]
    coldest: Float[AnyArray, ""]
    warmest: Float[AnyArray, ""]
    max_rate: Float[AnyArray, ""]
    fixed_rates: Float[AnyArray, " r"]
    temperatures: int = eqx.field(static=True)
    rates_free: bool = eqx.field(static=True)
    points: Points = eqx.field(static=True, default="one run")

    @property
    def size(self) -> int:
        """Number of free coordinates."""
        return self.temperatures + (self.fixed_rates.shape[0] if self.rates_free else 0)

    def decode(self, z: Float[AnyArray, " size"]) -> Schedule:
        """The plan of a vector, temperatures in rising order."""
        xp = namespace(z, self.time)
        temperatures = xp.sort(_between(self.coldest, self.warmest, z[: self.temperatures]))
        rates = self.max_rate * xp.tanh(z[self.temperatures :]) if self.rates_free else self.fixed_rates
        count = rates.shape[0]
        integration = (self.time / self.temperatures - self.soak) / count
        template = standard_plan(np.zeros(self.temperatures), 0.0, 0.0, np.zeros(count), points=self.points)
        stay = self.soak + count * integration
        zeros = xp.zeros(self.temperatures)
        jumps = xp.concatenate([zeros[:1], xp.diff(temperatures)])
        programme = Programme(xp.asarray(temperatures[0]), zeros + stay, zeros, jumps)
        first = lambda v: xp.reshape(xp.asarray(v), (1,))  # noqa: E731
        duration = xp.concatenate([first(self.soak), xp.zeros(count) + integration])
        numbers = duration, xp.concatenate([first(0.0), rates]), programme
        return eqx.tree_at(lambda s: (s.duration, s.peak_rate, s.programme), template, numbers)

    def vector(self, temperatures: np.ndarray, rates: np.ndarray) -> Float[np.ndarray, " size"]:
        """Coordinates of temperatures (°C) and rates (rad/s); values at a bound are moved slightly inside."""
        places = _share(float(self.coldest), float(self.warmest), np.asarray(temperatures))
        shares = np.clip(rates / float(self.max_rate), _INSIDE - 1.0, 1.0 - _INSIDE)
        return np.concatenate([places, np.arctanh(shares)]) if self.rates_free else places

    def plan_of(self, z: Float[np.ndarray, " size"]) -> tuple[np.ndarray, np.ndarray, float]:
        """Temperatures (°C), rates (rad/s) and the integration time (s) of a vector."""
        plan = self.decode(z)
        return plan.programme.chamber()[0], plan.peak_rate[1:], float(plan.duration[1])


def _share(low: float, high: float, value: np.ndarray) -> np.ndarray:
    """The inverse of `_between`."""
    share = np.clip((value - low) / (high - low), _INSIDE, 1.0 - _INSIDE)
    return np.log(share / (1.0 - share))


def _between(low, high, z):
    return low + (high - low) * 0.5 * (1.0 + namespace(z).tanh(0.5 * z))
