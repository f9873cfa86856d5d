"""Noise processes of a channel.

    δω = B(T) + ε_d2d + ε_ins(t) + M(T, ω)·ω + ε_res(t)·ω + ε_RW(t)                       (Berman, eq. 1)

Errors that are linear in parameters are terms (`terms`); all others are noise. Every slow one is a scalar process `x`:

    dx = −decay·x dt + diffusion dw,   Var x(0) = initial_std²,

which drives the channel's integral at the rate `(bias_gain + rate_gain·ω(t))·x` (ω: the input of the channel):

| error | initial_std | decay | diffusion | bias_gain | rate_gain |
|---|---|---|---|---|---|
| bias instability (σ, τ) | σ | 1/τ | σ√(2/τ) | 1 | 0 |
| rate random walk K | 0 | 0 | K | 1 | 0 |
| residual scale-factor instability (σ, τ) | σ | 1/τ | σ√(2/τ) | 0 | 1 |
| error of the temperature measurement (σ, τ) | σ | 1/τ | σ√(2/τ) | dB/dT | dM/dT |
| a constant (turn-on bias, sample clock) | σ | 0 | 0 | 1 or 0 | 0 or 1 |
"""

import equinox as eqx
import numpy as np
from jaxtyping import Float

from gradcal_jax.arrays import AnyArray, PytreeModule


class Processes(PytreeModule):
    """`m` independent scalar noise processes; every field has the shape `(m,)` and SI units. `sources`: the name of the
    error source of each."""

    initial_std: Float[AnyArray, " m"]
    decay: Float[AnyArray, " m"]
    diffusion: Float[AnyArray, " m"]
    bias_gain: Float[AnyArray, " m"]
    rate_gain: Float[AnyArray, " m"]
    sources: tuple[str, ...] = eqx.field(static=True)

    @property
    def count(self) -> int:
        return self.decay.shape[0]

    def __add__(self, other: "Processes") -> "Processes":
        both = zip(_numbers(self), _numbers(other), strict=True)
        return Processes(*map(np.concatenate, both), sources=self.sources + other.sources)


def _numbers(of: Processes) -> list[AnyArray]:
    return [of.initial_std, of.decay, of.diffusion, of.bias_gain, of.rate_gain]


def _process(source, *numbers) -> Processes:
    return Processes(*(np.reshape(np.asarray(v, dtype=float), (1,)) for v in numbers), sources=(source,))


def no_processes() -> Processes:
    """The empty set, to add to."""
    return Processes(*(np.zeros(0) for _ in range(5)), sources=())


def gauss_markov(
    standard_deviation, correlation_time, *, bias_gain=1.0, rate_gain=0.0, source="bias instability"
) -> Processes:
    """Stationary Gauss–Markov process: σ in rad/s (or 1, or K, by the gains), τ in s (`inf`: a constant)."""
    decay = 1.0 / np.asarray(correlation_time, dtype=float)
    diffusion = standard_deviation * np.sqrt(2.0 * decay)
    return _process(source, standard_deviation, decay, diffusion, bias_gain, rate_gain)


def rate_random_walk(coefficient) -> Processes:
    """Rate random walk K in rad/s/√s; it starts at zero, since its initial value is part of the bias."""
    return _process("rate random walk", 0.0, 0.0, coefficient, 1.0, 0.0)


def constant(standard_deviation, *, bias_gain=0.0, rate_gain=0.0, source="turn-on bias") -> Processes:
    """An error drawn once per run: turn-on bias (`bias_gain=1`, rad/s) or sample clock (`rate_gain=1`)."""
    return _process(source, standard_deviation, 0.0, 0.0, bias_gain, rate_gain)
