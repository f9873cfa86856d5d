"""Hysteresis loops by other laws than the plays that estimate them: Preisach relays, or two thermal masses.

Their size is half the difference between heating and cooling, over a wide cycle (relays) or on a ramp of 1 K/min
(thermal masses).
"""

from dataclasses import dataclass, replace
from typing import Any, Final, Literal

import numpy as np

from gradcal_jax.hardware.simulate.draws import draw_truth
from gradcal_jax.hardware.simulate.imu import ImuTruth, Loop, Mass, Vectors
from gradcal_jax.spec.spec_sections import Spec

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
    size: tuple[float, ...]
    width_k: float
    seed: int
    of_input: bool = False
    times_s: tuple[float, float] = (60.0, 600.0)

    def begin(self, temperature_c: float) -> "Loop":
        """The loop in a sensor that has been long at a temperature."""
        shape, size = (_relays if self.law == "relays" else _thermal_masses)(self, temperature_c), np.array(self.size)
        return lambda temperatures_c, period_s: shape(temperatures_c, period_s)[:, None] * size


def _relays(truth: LoopTruth, temperature_c: float) -> Loop:
    """Preisach: relays switch up at `u + r` and down at `u - r`, u over temperatures, r over half-widths.

    Weights add up to one for the relays that are open at a temperature, on average; the linear part of the mean of
    heating and cooling, which is no hysteresis, is taken off."""
    random = np.random.default_rng([truth.seed, 20264])
    middle = random.uniform(_COLDEST_C, _WARMEST_C, _RELAYS)
    half = truth.width_k * random.uniform(_NARROWEST, _WIDEST, _RELAYS)
    up, down = middle + half, middle - half
    weight = random.exponential(1.0, _RELAYS)
    weight /= np.mean([weight[(down < t) & (t < up)].sum() for t in np.linspace(-30.0, 80.0, 56)])
    slope, centre = 2.0 * weight.sum() / (_WARMEST_C - _COLDEST_C), 0.5 * (_COLDEST_C + _WARMEST_C)
    on, last_c = middle < temperature_c, temperature_c

    def output() -> float:
        # A heating leg is behind, so that it is lower: the sign is that of heating less cooling.
        return slope * (last_c - centre) - float(weight @ np.where(on, 1.0, -1.0))

    def shape(temperatures_c: Vectors, period_s: float) -> Vectors:
        nonlocal on, last_c
        places, values = [-1], [output()]
        for k, t in enumerate(temperatures_c.tolist()):
            if abs(t - last_c) >= _STEP_K or k == len(temperatures_c) - 1:
                on, last_c = (on | (t > up)) & ~(t < down), t
                places.append(k)
                values.append(output())
        return np.interp(np.arange(len(temperatures_c)), places, values)

    return shape


def _thermal_masses(truth: LoopTruth, temperature_c: float) -> Loop:
    """Two masses follow the temperature with different time constants, and the error is in proportion to the difference
    of theirs, so that it depends on the slope."""
    spread = _SPREAD * np.random.default_rng([truth.seed, 20267]).uniform(-1.0, 1.0, 2)
    fast_s, slow_s = np.array(truth.times_s) * (1.0 + spread)
    fast, slow = Mass(temperature_c, float(fast_s)), Mass(temperature_c, float(slow_s))
    scale = 1.0 / (_SLOPE_K_PER_S * (slow_s - fast_s))
    return lambda t_c, period_s: (fast.take(t_c, period_s) - slow.take(t_c, period_s)) * scale


def draw_with_loops(spec: Spec, seed: int, number: int, law: Law) -> ImuTruth:
    """The unit of this number, with loops by a law, of the sizes of the spec's plays, in their place."""
    truth, random = draw_truth(spec, seed, number), np.random.default_rng([seed, number, 20265])
    triads = dict(truth.triads)
    for kind in triads:
        triad: Any = getattr(spec.sensor, kind)
        loops: list[LoopTruth] = []
        for plays, of_input in ((triad.hysteresis, False), (triad.scale_factor_hysteresis, True)):
            if plays:
                sizes = np.array([float(p.prior) * float(p.width) for p in plays])
                width = float(np.average([float(p.width) for p in plays], weights=sizes))
                size = float(np.sqrt(np.sum(sizes**2))) * random.standard_normal(3)
                loops.append(LoopTruth(law, tuple(size.tolist()), width, int(random.integers(1 << 31)), of_input))
        triads[kind] = replace(triads[kind], loops=tuple(loops))
    return replace(truth, triads=triads)
