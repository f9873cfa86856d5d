"""The noise of a gyro channel and of its angle reference.

**Processes.** Every slow error is one scalar process `x` with

    dx = −decay·x dt + diffusion dw,   Var x(0) = initial_std²,

that drives the integrated angle at the rate `(bias_gain + rate_gain·ω(t))·x`:

| error | initial_std | decay | diffusion | bias_gain | rate_gain |
|---|---|---|---|---|---|
| bias instability (σ, τ) | σ | 1/τ | σ√(2/τ) | 1 | 0 |
| rate random walk K | 0 | 0 | K | 1 | 0 |
| residual scale-factor instability (σ, τ) | σ | 1/τ | σ√(2/τ) | 0 | 1 |
| error of the temperature measurement (σ, τ) | σ | 1/τ | σ√(2/τ) | dB/dT | dM/dT |
| a constant (turn-on bias, sample clock) | σ | 0 | 0 | 1 or 0 | 0 or 1 |

So the rate random walk is a limit of the first row and needs no code of its own.
"""

from dataclasses import fields

import equinox as eqx
import numpy as np
from jaxtyping import Float

from gradcal_jax.arrays import AnyArray, PytreeModule


class Processes(PytreeModule):
    """`m` independent scalar noise processes; every field has the shape `(m,)` and SI units."""

    initial_std: Float[AnyArray, " m"]
    decay: Float[AnyArray, " m"]
    diffusion: Float[AnyArray, " m"]
    bias_gain: Float[AnyArray, " m"]
    rate_gain: Float[AnyArray, " m"]

    @property
    def count(self) -> int:
        return self.decay.shape[0]

    def __add__(self, other: "Processes") -> "Processes":
        names = (f.name for f in fields(self))
        return Processes(*(np.concatenate([getattr(self, name), getattr(other, name)]) for name in names))


def _process(initial_std, decay, diffusion, bias_gain, rate_gain) -> Processes:
    numbers = (initial_std, decay, diffusion, bias_gain, rate_gain)
    return Processes(*(np.reshape(np.asarray(v, dtype=float), (1,)) for v in numbers))


def no_processes() -> Processes:
    """The empty set, to add to."""
    return Processes(*(np.zeros(0) for _ in range(5)))


def gauss_markov(standard_deviation, correlation_time, *, bias_gain=1.0, rate_gain=0.0) -> Processes:
    """Stationary Gauss–Markov process: σ in rad/s (or 1, or K, by the gains), τ in s (`inf`: a constant)."""
    decay = 1.0 / np.asarray(correlation_time, dtype=float)
    return _process(standard_deviation, decay, standard_deviation * np.sqrt(2.0 * decay), bias_gain, rate_gain)


def rate_random_walk(coefficient) -> Processes:
    """Rate random walk K in rad/s/√s; it starts at zero, since its initial value is part of the bias."""
    return _process(0.0, 0.0, coefficient, 1.0, 0.0)


def constant(standard_deviation, *, bias_gain=0.0, rate_gain=0.0) -> Processes:
    """An error drawn once per run: turn-on bias (`bias_gain=1`, rad/s) or sample clock (`rate_gain=1`)."""
    return _process(standard_deviation, 0.0, 0.0, bias_gain, rate_gain)


class Reference(PytreeModule):
    """Noise of the reference: an angle read at standstill or on the move, or a held rate.

    All standard deviations: `reading_noise` rad, white, of each reading; `standstill_offset` rad, drawn each time the
    table comes to rest; `timing_error` s, adds `ω·σ_t` on the move; `rate_accuracy`, relative, drawn for each set
    point. (The encoder's error by angle is a term: `terms.EncoderHarmonics`.)
    """

    reading_noise: Float[AnyArray, ""]
    standstill_offset: Float[AnyArray, ""]
    timing_error: Float[AnyArray, ""]
    rate_accuracy: Float[AnyArray, ""]
    has_offset: bool = eqx.field(static=True, default=False)


def angle_reference(reading_noise=0.0, standstill_offset=0.0, timing_error=0.0, rate_accuracy=0.0) -> Reference:
    """A `Reference` from plain numbers (SI). An offset of exactly 0 gets no noise state."""
    numbers = (np.asarray(v, dtype=float) for v in (reading_noise, standstill_offset, timing_error, rate_accuracy))
    return Reference(*numbers, has_offset=bool(standstill_offset != 0.0))
