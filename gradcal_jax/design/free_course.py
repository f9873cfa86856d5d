"""The chamber's temperature course as free numbers in a search of cycles: its legs, turning points and slopes.

On each leg a few cycles at fixed shares of its time stand for all of it, with the weight of their number. What they see
(temperature, slope, time since power-on, and the turning points before, on which a hysteresis depends) is a function of
the course's coordinates, whose derivative JAX takes with that of the motion. Plays are exact at reversals: a turning
point acts through a minimum or maximum, of which the derivative is that of the side on which the course is.
"""

import math
from typing import NamedTuple

import equinox as eqx
import jax.numpy as jnp
import numpy as np
from jaxtyping import Bool, Float, Int

from gradcal_jax.arrays import AnyArray, namespace
from gradcal_jax.motion import Programme, quadrature

# Legs of a course at least, and cycles that stand for all others: on a leg at least, and in all about.
_LEGS, _LEGS_AT_REST, _FEWEST, _SAMPLES = 4, 6, 3, 12
_GROWS = 3.0
# Least duration of a stretch, as a share of an even one; distance of a vector's values from their bounds, as a share.
_LEAST_SHARE = 0.1
_INSIDE = 1e-4


class Ramp(NamedTuple):
    """Cycles of a plan on one slope, K/s: `begins` °C, where the first of two cycles begins, and their `mounting`.

    `first`: a stretch of the plan begins with the first one. `shifts` `(J, p, p)`: S of each further cycle, of which
    the `place` is 1 for one like the first, 2 for one like the second, which ends the stretch, and 0 for none.
    `elapsed` s since power-on; `history` °C and `behind` K: as of a `TableMotion`. `number`: on a free course, of how
    many cycles the first one is one, wherever they are (None: the ramps follow one another).
    """

    begins: Float[AnyArray, ""]
    slope: Float[AnyArray, ""]
    mounting: Int[AnyArray, ""]
    first: Bool[AnyArray, ""]
    shifts: Float[AnyArray, "J p p"]
    place: Int[AnyArray, " J"]
    elapsed: float | Float[AnyArray, ""] = 0.0
    history: Float[AnyArray, " H"] = np.zeros(0)
    behind: Float[AnyArray, " O"] = np.zeros(0)
    number: Float[AnyArray, ""] | None = None


class ProgrammeCoordinates(eqx.Module):
    """Temperature programmes of `stretches` slopes after a soak, each from any real vector: durations are least times
    and shares of what is left, slopes lie between the steepest cooling and heating and end within the range.

    `soak`, `time` (of the programme, without the soak): s. `coldest`, `warmest`: °C; `heating`, `cooling`: K/s, sizes.
    """

    soak: Float[AnyArray, ""]
    time: Float[AnyArray, ""]
    coldest: Float[AnyArray, ""]
    warmest: Float[AnyArray, ""]
    heating: Float[AnyArray, ""]
    cooling: Float[AnyArray, ""]
    stretches: int = eqx.field(static=True)

    @property
    def size(self) -> int:
        """Number of free coordinates."""
        return 2 * self.stretches + 1

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


class FreeCourse(NamedTuple):
    """Courses of the chamber, after a soak. `before` °C: turning points of the temperature before the plan; `lag` s;
    `parameters`: how many the model has; `lags`: of the model's other temperatures, s."""

    coordinates: ProgrammeCoordinates
    before: Float[np.ndarray, " b"]
    lag: float
    parameters: int
    lags: tuple[float, ...] = ()

    def ramps(self, z: Float[AnyArray, " size"], period: AnyArray) -> Ramp:
        """Stacked ramps of the course of a vector, with cycles of `period` s."""
        course, legs = self.coordinates.programme(z), self.coordinates.stretches
        each = max(_FEWEST, math.ceil(_SAMPLES / legs))
        shares, weights = quadrature(each)
        knots = jnp.concatenate([jnp.asarray(self.before), jnp.reshape(course.start, (1,)), course.chamber()[1]])
        earlier, since = len(self.before), course.times()
        ramps: list[Ramp] = []
        behind = jnp.zeros(len(self.lags))
        for leg in range(legs):
            slope, lasting = course.slopes[leg], course.durations[leg]
            # The first of two cycles is about its place.
            place = shares * lasting - 0.5 * period
            begins = knots[earlier + leg] + slope * (place - self.lag)
            # As many turning points on each leg: the first one stands several times.
            past = jnp.concatenate([jnp.repeat(knots[:1], legs - 1 - leg), knots[: earlier + leg + 1]])
            one = jnp.ones(each)
            ramps.append(
                Ramp(
                    begins,
                    slope * one,
                    jnp.zeros(each, int),
                    jnp.ones(each, bool),
                    jnp.zeros((each, 0, self.parameters, self.parameters)),
                    jnp.zeros((each, 0), int),
                    self.coordinates.soak + since[leg] + place,
                    jnp.tile(past, (each, 1)),
                    behind_on_leg(behind, self.lags, slope, place),
                    jnp.asarray(weights) * lasting / period,
                )
            )
            behind = behind_on_leg(behind, self.lags, slope, lasting[None])[0]
        return Ramp(*(jnp.concatenate(of) for of in zip(*ramps, strict=True)))

    def starts(self, own: Float[np.ndarray, " size"]) -> list[Float[np.ndarray, " size"]]:
        """Courses from which a search begins: the file's own, and there and back over the same range, from either
        end."""
        of, time = self.coordinates.programme(own), float(self.coordinates.time)
        knots = np.append(of.start, of.chamber()[1])
        low, high = float(np.min(knots)), float(np.max(knots))
        first, last = (low, high) if knots[0] <= knots[-1] else (high, low)
        result = [own]
        for begin, turn, share in ((first, last, 0.5), (last, first, 0.5), (first, last, 0.65)):
            durations = np.array([share, 1.0 - share]) * time
            slopes = np.array([turn - begin, begin - turn]) / durations
            result.append(self.coordinates.vector(begin, durations, slopes))
        return result


def behind_on_leg(first: AnyArray, lags: tuple[float, ...], slope: AnyArray, since: AnyArray) -> AnyArray:
    """How far (K) first-order lags (s) are behind, `(k, O)`, `since` `(k,)` s after the beginning of a leg at which
    they are `first` `(O,)` behind. Before it, along its continuation, a deviation grows at most by e^`_GROWS`."""
    xp = namespace(first, slope, since)
    times = xp.asarray(lags)[None]
    steady = slope * times
    return steady + (first[None] - steady) * xp.exp(xp.minimum(-since[:, None] / times, _GROWS))


def cycles_alike(number: int, samples: int) -> list[Int[np.ndarray, " k"]]:
    """The numbers of a leg's cycles in groups of which one stands for all: the first, the last, and about `samples`
    others."""
    inner = np.arange(1, number - 1)
    groups = np.array_split(inner, min(samples, max(len(inner), 1)))
    return [group for group in (np.arange(1), *groups, np.arange(max(number - 1, 1), number)) if len(group)]


def legs_of(own: int, *, stands: bool) -> int:
    """How many legs a search's courses have, of a plan with `own` ones. `stands`: it has nothing else to change."""
    return max(own, _LEGS_AT_REST if stands else _LEGS)


def _share(low: float, high: float, value: np.ndarray) -> np.ndarray:
    """The inverse of `_between`."""
    share = np.clip((value - low) / (high - low), _INSIDE, 1.0 - _INSIDE)
    return np.log(share / (1.0 - share))


def _between(low, high, z):
    return low + (high - low) * 0.5 * (1.0 + namespace(z).tanh(0.5 * z))
