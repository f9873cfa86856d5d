"""The equation of a calibration, among named inputs in the rows of an array `(inputs, n)`.

    measured = s + Σ map(T, s) · signals,        s = input + Σ misalignment(T) · inputs across it

with s as the channel's own signal. Outside the range of the data, the maps keep their values at its edge.

In every round of its solution, what the equation leaves at the corrected values is divided by the linear part and added
to them. The error shrinks in each round by a factor of the size of the terms that are not linear, or that differ from
their value at the middle temperature; so raw counts converge, too.

The arithmetic is that of the arrays and maps: double precision for corrections, single precision for C.
"""

from collections.abc import Callable, Iterable, Sequence
from typing import Any, NamedTuple

import numpy as np

from gradcal_jax.calibration.file import CalibratedChannel, CalibratedTerm, signal_of
from gradcal_jax.records.log import Floats
from gradcal_jax.spec.bases import SplineKeys

Array = Any
Map = Callable[[Array], Array]
"""A term's map at known temperatures as a function of the channel's own rates (rad/s), `(n,) -> (n,)`."""
SIGNALS = tuple(f"{kind} {axis}" for kind in ("rate", "force") for axis in "xyz")
"""The inputs of an IMU, in the order of its matrices."""


class PlacedTerm(NamedTuple):
    """A term among inputs: the number of its channel's input; whether it is a misalignment; and the numbers, from 1, of
    the inputs that multiply it, negative for a magnitude."""

    channel: CalibratedChannel
    term: CalibratedTerm
    of: int
    across: bool
    factors: list[int]

    @property
    def table(self) -> Floats:
        """The coefficients `(functions of temperature, functions of rate)`."""
        return self.term.table

    @property
    def sides(self) -> list[float]:
        """Centre and inverse scale of temperature and of rate. Raises `ValueError` for bases other than polynomials."""
        sides: list[float] = []
        for basis in self.term.bases:
            if isinstance(basis, SplineKeys):
                raise ValueError(
                    f"a C header holds polynomials, and {self.term.name} of {self.channel.label} has knots: estimate "
                    "it with a degree, or export to csv"
                )
            sides += [basis.centre, 1.0 / basis.scale]
        return sides


class Equation(NamedTuple):
    """The terms of channels with their maps at the temperatures of n rows."""

    terms: Sequence[PlacedTerm]
    maps: Sequence[Map]

    def errors(self, inputs: Array) -> Array:
        """What the channels measure more than their inputs, `(inputs, n)`, SI."""
        along, errors = inputs.copy(), np.zeros_like(inputs)
        for (channel, _, of, across, factors), value in zip(self.terms, self.maps, strict=True):
            error = value(clipped(along[of], channel.valid_rate))
            for number in factors:
                k = abs(number) - 1
                signal = along[k] if k == of else inputs[k]
                error = error * (np.abs(signal) if number < 0 else signal)
            errors[of] += error
            if across:
                along[of] += error
        return errors

    def solve(
        self, measured: Array, inverse: Array, *, fewest: int, most: int, settled: float
    ) -> tuple[Array, Array, int]:
        """The inputs, their last change, and the number of rounds until that is below a share `settled` of the largest
        value. `inverse`: that of the linear part."""
        now = 0.0 * measured
        rounds = 0
        while True:
            rounds += 1
            left = measured - now - self.errors(now)
            before, now = now, now.copy()
            # Only inputs with an effect: a missing reading does not affect the other triad.
            for k, j in np.argwhere(inverse):
                now[k] += inverse[k, j] * left[j]
            change = np.abs(now - before)
            size = np.nanmax(np.abs(now), axis=1, initial=1e-300)
            done = rounds >= fewest and np.all(np.nanmax(change, axis=1, initial=0.0) <= settled * size)
            if done or rounds == most:
                return now, change, rounds


def equation(channels: Sequence[CalibratedChannel], inputs: Sequence[str], temperature_c: Iterable[Floats]) -> Equation:
    """In double precision, at temperatures `(n,)` of each channel, °C."""
    followed = {channel.name: of for channel, of in zip(channels, temperature_c, strict=True)}
    terms = placed_terms(channels, inputs)
    return Equation(terms, [map_of(one.channel, one.term, followed[one.channel.name]) for one in terms])


def placed_terms(channels: Sequence[CalibratedChannel], inputs: Sequence[str]) -> list[PlacedTerm]:
    """The terms, misalignments first, without those of an unknown input, which counts as zero."""
    numbers = {name: number for number, name in enumerate(inputs, 1)}
    numbers |= {f"|{name}|": -number for name, number in numbers.items()}
    terms: list[PlacedTerm] = []
    for channel in channels:
        for term in channel.term:
            if not numbers.keys() >= {channel.input, *term.signals}:
                continue
            own, factors = numbers[channel.input], [numbers[name] for name in term.signals]
            # By a misalignment the channel senses what acts across its axis, so that its other terms multiply it.
            other = len(factors) == 1 and factors != [own]
            across = other and term.signals[0].startswith(signal_of(channel.kind))
            terms.append(PlacedTerm(channel, term, own - 1, across, factors))
    return sorted(terms, key=lambda one: not one.across)


def clipped(values: Array, bounds: tuple[float, float]) -> Array:
    """The values, or the nearest bound, in the precision of the values."""
    low, high = map(float, bounds)  # (a quantity would make single precision double)
    return np.clip(values, low, high)


def map_of(channel: CalibratedChannel, term: CalibratedTerm, temperature_c: Floats) -> Map:
    """The map of a channel's term, in its unit, at temperatures `(n,)`, °C."""
    of_temperature, of_rate = term.bases
    within = clipped(temperature_c, channel.valid_temperature)
    over_rate = of_temperature.values(within) @ term.table
    return lambda rate: (over_rate * of_rate.values(rate)).sum(axis=-1)


def linear_part(
    channels: Sequence[CalibratedChannel],
    temperature_c: float,
    inputs: Sequence[str] = SIGNALS,
    *,
    mean_over_rates: bool = False,
) -> tuple[Floats, Floats]:
    """At one temperature: measured = matrix (n, n) · inputs + bias (n,), SI, for slow rates or with the mean of the
    maps over the rates that they cover. Absent terms count as zero."""
    count = len(inputs)
    across, gain, others, bias = np.eye(count), np.ones(count), np.zeros((count, count)), np.zeros(count)
    for channel, term, of, misaligns, factors in placed_terms(channels, inputs):
        rates = np.linspace(*channel.valid_rate, 201) if mean_over_rates and term.rate else np.zeros(1)
        over_rates: Floats = map_of(channel, term, np.array([temperature_c]))(rates)
        value = float(np.mean(over_rates))
        if not factors:
            bias[of] += value
        elif factors == [of + 1]:
            gain[of] += value
        elif len(factors) == 1 and factors[0] > 0:
            (across if misaligns else others)[of, factors[0] - 1] += value
    return gain[:, None] * across + others, bias
