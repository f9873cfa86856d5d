"""Loops of a simulated sensor's error over temperature, by laws other than the estimator's plays. NumPy only.

relays           Preisach: relays that switch up at `u + r` and down at `u − r`, u over temperatures, r over half-widths
thermal masses   two masses that follow the temperature with different time constants; the error is in proportion to
                 the difference of their temperatures, and so depends on the slope

Each is scaled by half of what heating and cooling differ by over a wide cycle (relays), or on a ramp (thermal masses).
"""

import importlib
from abc import ABC, abstractmethod
from dataclasses import dataclass
from typing import Any, Final, Literal

import numpy as np
from numpy.typing import NDArray

from ...formulas import lag_filter

Vectors = NDArray[np.float64]
Law = Literal["relays", "thermal masses"]
LAWS: Final[tuple[Law, ...]] = ("relays", "thermal masses")

_RELAYS = 1500
# Temperatures of relays, °C; half-widths, in the widths of the spec.
_COLDEST_C, _WARMEST_C = -90.0, 150.0
_NARROWEST, _WIDEST = 0.3, 2.0
# The largest change of temperature between two evaluations, K.
_STEP_K = 0.02
# The slope on which the difference of two thermal masses has its size, K/s.
_SLOPE_K_PER_S = 1.0 / 60.0
# The time constants of a sensor's masses are those of its type within this share.
_SPREAD = 0.1


@dataclass(frozen=True)
class LoopTruth:
    """The loop of three sensors: its `law`; half of what heating and cooling differ by, of each (SI); the half-width of
    the play that the spec has in its place, K (relays); `of_input`: it multiplies the input, as a scale factor;
    `times_s`: time constants of two masses."""

    law: Law
    size: tuple[float, float, float]
    width_k: float
    seed: int
    of_input: bool = False
    times_s: tuple[float, float] = (60.0, 600.0)

    def begin(self, temperature_c: float) -> "Loop":
        """The loop in a sensor that has been long at a temperature."""
        made = _Relays if self.law == "relays" else _ThermalMasses
        return made(self, temperature_c)


class Loop(ABC):
    """The state of a loop, which advances from sample to sample."""

    def __init__(self, truth: LoopTruth, temperature_c: float) -> None:
        self._size = np.array(truth.size)
        self._start(truth, temperature_c)

    @abstractmethod
    def _start(self, truth: LoopTruth, temperature_c: float) -> None:
        """The state after a long time at a temperature."""

    @abstractmethod
    def shape(self, temperature_c: Vectors, period_s: float) -> Vectors:
        """`(n,)`: the loop at consecutive temperatures `(n,)`, ±1 on wide legs."""

    def take(self, temperature_c: Vectors, period_s: float) -> Vectors:
        """`(n, 3)`: the errors at consecutive temperatures."""
        return self.shape(temperature_c, period_s)[:, None] * self._size


class _Relays(Loop):
    """Weights add up to one for the relays that are open at a temperature, on average; the linear part of the mean of
    heating and cooling, which is no hysteresis, is taken off."""

    def _start(self, truth: LoopTruth, temperature_c: float) -> None:
        random = np.random.default_rng([truth.seed, 20264])
        middle = random.uniform(_COLDEST_C, _WARMEST_C, _RELAYS)
        half = truth.width_k * random.uniform(_NARROWEST, _WIDEST, _RELAYS)
        self._up, self._down = middle + half, middle - half
        weight = random.exponential(1.0, _RELAYS)
        open_at = np.mean([weight[(self._down < t) & (t < self._up)].sum() for t in np.linspace(-30.0, 80.0, 56)])
        self._weight = weight / open_at
        self._slope = 2.0 * self._weight.sum() / (_WARMEST_C - _COLDEST_C)
        self._centre = 0.5 * (_COLDEST_C + _WARMEST_C)
        self._on = middle < temperature_c
        self._last, self._value = temperature_c, self._output(temperature_c)

    def _output(self, temperature_c: float) -> float:
        total = float(self._weight @ np.where(self._on, 1.0, -1.0))
        # A heating leg is behind, so that it is lower: the sign is that of heating less cooling.
        return self._slope * (temperature_c - self._centre) - total

    def shape(self, temperature_c: Vectors, period_s: float) -> Vectors:
        places, values = [-1], [self._value]
        for k, t in enumerate(temperature_c.tolist()):
            if abs(t - self._last) < _STEP_K and k < len(temperature_c) - 1:
                continue
            self._on = (self._on | (t > self._up)) & ~(t < self._down)
            self._last, self._value = t, self._output(t)
            places.append(k)
            values.append(self._value)
        return np.interp(np.arange(len(temperature_c)), places, values)


class _ThermalMasses(Loop):
    def _start(self, truth: LoopTruth, temperature_c: float) -> None:
        spread = _SPREAD * np.random.default_rng([truth.seed, 20267]).uniform(-1.0, 1.0, 2)
        fast_s, slow_s = np.array(truth.times_s) * (1.0 + spread)
        self._masses = Mass(temperature_c, float(fast_s)), Mass(temperature_c, float(slow_s))
        self._scale = 1.0 / (_SLOPE_K_PER_S * (slow_s - fast_s))

    def shape(self, temperature_c: Vectors, period_s: float) -> Vectors:
        fast, slow = (mass.take(temperature_c, period_s) for mass in self._masses)
        return (fast - slow) * self._scale


class Mass:
    """A thermal mass that follows a temperature with a time constant, and has been long at a first one."""

    def __init__(self, temperature_c: float, time_s: float) -> None:
        self._time_s, self._given, self._own = time_s, temperature_c, temperature_c

    def take(self, temperature_c: Vectors, period_s: float) -> Vectors:
        """Its temperatures `(n,)` at consecutive ones that it follows, linear in between."""
        signal: Any = importlib.import_module("scipy.signal")
        numerator, denominator = lag_filter(period_s, self._time_s)
        state = [numerator[1] * self._given - denominator[1] * self._own]
        result: Vectors = signal.lfilter(numerator, denominator, temperature_c, zi=state)[0]
        if len(result):
            self._given, self._own = float(temperature_c[-1]), float(result[-1])
        return result
