"""Hysteresis loops by another law than the plays that estimate them: Preisach relays. Their size is half the difference
between heating and cooling over a wide cycle."""

from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from gradcal_jax.hardware.simulate.draws import draw_truth
from gradcal_jax.hardware.simulate.imu import ImuTruth, Loop
from gradcal_jax.hardware.simulate.plants import Floats
from gradcal_jax.spec.spec_sections import Spec

_RELAYS = 1500
# Temperatures of relays, °C; half-widths, in the widths of the spec.
_COLDEST_C, _WARMEST_C = -90.0, 150.0
_NARROWEST, _WIDEST = 0.3, 2.0
# The largest change of temperature between two evaluations, K.
_STEP_K = 0.02


@dataclass(frozen=True)
class LoopTruth:
    """The loop of three sensors: half of what heating and cooling differ by, of each (SI); the half-width of the play
    that the spec has in its place, K."""

    size: tuple[float, ...]
    width_k: float
    seed: int
    of_input: bool = False

    def begin(self, temperature_c: float) -> "Loop":
        """The loop in a sensor that has been long at a temperature."""
        shape, size = _relays(self, temperature_c), np.array(self.size)
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

    def shape(temperatures_c: Floats, period_s: float) -> Floats:
        nonlocal on, last_c
        places, values = [-1], [output()]
        for k, t in enumerate(temperatures_c.tolist()):
            if abs(t - last_c) >= _STEP_K or k == len(temperatures_c) - 1:
                on, last_c = (on | (t > up)) & ~(t < down), t
                places.append(k)
                values.append(output())
        return np.interp(np.arange(len(temperatures_c)), places, values)

    return shape


def draw_with_loops(spec: Spec, seed: int, number: int) -> ImuTruth:
    """The unit of this number, whose gyros have loops of the sizes of the spec's plays in their place."""
    truth, random = draw_truth(spec, seed, number), np.random.default_rng([seed, number, 20265])
    triad: Any = spec.sensor.gyro
    sizes = np.array([float(p.prior) * float(p.width) for p in triad.hysteresis])
    width = float(np.average([float(p.width) for p in triad.hysteresis], weights=sizes))
    size = float(np.sqrt(np.sum(sizes**2))) * random.standard_normal(3)
    loop = LoopTruth(tuple(size.tolist()), width, int(random.integers(1 << 31)))
    return replace(truth, triads=truth.triads | {"gyro": replace(truth.triads["gyro"], loops=(loop,))})
