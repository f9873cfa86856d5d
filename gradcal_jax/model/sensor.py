"""The model of a sensor channel: a sum of terms, and the noise that is left.

    δω = B(T) + ε_d2d + ε_ins(t) + M(T, ω)·ω + ε_res(t)·ω + ε_RW(t)                       (Berman, eq. 1)

Errors that are linear in parameters are terms (`terms`); all others are noise. The parameter vector `β` holds
the terms' parameters, one term after the other.

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

from collections.abc import Sequence
from dataclasses import fields

import equinox as eqx
import numpy as np
from jaxtyping import Float

from gradcal_jax.arrays import AnyArray, PytreeModule, namespace
from gradcal_jax.model.nodes import Nodes
from gradcal_jax.model.terms import (
    BIAS,
    SCALE_FACTOR,
    Backlash,
    EncoderHarmonics,
    GradientOfBias,
    Map,
    SignalMap,
    Term,
    block_diagonal,
)


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


class SensorModel(PytreeModule):
    """A sensor channel and its reference: `terms`, `angle_random_walk` (rad/√s), processes, noise of the reference.

    Errors: `ValueError` without any map to calibrate.
    """

    terms: tuple[Term, ...]
    angle_random_walk: Float[AnyArray, ""]
    processes: Processes
    reference: Reference

    def __check_init__(self):
        if not any(isinstance(term, Map | SignalMap) for term in self.terms):
            raise ValueError("nothing to calibrate: give the model a bias map, a scale-factor map, or both")

    @property
    def size(self) -> int:
        """Number of parameters."""
        return sum(term.size for term in self.terms)

    def where(self, name: str) -> slice:
        """Indices of a term's parameters; an empty slice for a term that the model does not have."""
        begin = 0
        for term in self.terms:
            if term.name == name:
                return slice(begin, begin + term.size)
            begin += term.size
        return slice(begin, begin)

    def term(self, name: str) -> Term | None:
        """The term of that name, if there is one."""
        return next((term for term in self.terms if term.name == name), None)

    def map(self, name: str) -> Map | None:
        """The map of that name, if the model estimates it."""
        term = self.term(name)
        return term if isinstance(term, Map) else None

    @property
    def bias(self) -> Map | None:
        return self.map(BIAS)

    @property
    def scale(self) -> Map | None:
        return self.map(SCALE_FACTOR)

    @property
    def harmonics(self) -> EncoderHarmonics | None:
        return next((term for term in self.terms if isinstance(term, EncoderHarmonics)), None)

    def names(self) -> list[str]:
        """Names of the reported parameters in the model's order."""
        return [name for term in self.terms for name in term.names()]

    def units(self) -> list[str]:
        """SI units of the parameters."""
        return [term.unit for term in self.terms for _ in range(term.size)]

    @property
    def to_reported(self) -> np.ndarray:
        """`(p, p)`: the engine's parameters to the reported ones."""
        return block_diagonal([term.to_reported for term in self.terms])

    def columns(self, nodes: Nodes) -> Float[AnyArray, "P p"]:
        """Contribution of each parameter's unit to the integrated error over each piece, rad."""
        blocks, beyond = [], {}
        for term in self.terms:
            if isinstance(term, Map) and term.beyond is not None:
                block, beyond[term.beyond.name] = term.columns_with_beyond(nodes)
            else:
                block = beyond[term.name] if term.name in beyond else term.columns(nodes)
            blocks.append(block)
        return namespace(*blocks).concatenate(blocks, axis=1)

    def prior_rows(self) -> Float[AnyArray, "q p"]:
        """Whitened rows of the priors; together with the data's rows they give the posterior."""
        return block_diagonal([term.prior_rows() for term in self.terms])


def gyro_model(
    bias: Map | None,
    scale: Map | None,
    angle_random_walk: float,
    processes: Processes | None = None,
    reference: Reference | None = None,
    *,
    temperature_gradient_std: float | np.ndarray | None = None,
    harmonics: dict[int, float] | None = None,
    backlash: float = 0.0,
    signals: Sequence[SignalMap] = (),
    path: Sequence[Term] = (),
) -> SensorModel:
    """A channel from its maps, terms of other signals and of the path of temperature, and plain numbers (SI), with the
    maps' discrepancies as the last terms.

    `temperature_gradient_std` (rad/s)/(K/s): the prior of dB/dṪ, `inf` flat, None without that term. `harmonics`: the
    amplitudes (rad) of the encoder's error by order; `backlash` rad, of the drive. The turn-on bias, which cannot be
    separated from B, is B's `common_std`; where B is known it is a process. Errors: `ValueError` where there is nothing
    to estimate.
    """
    maps = [m for m in (bias, scale) if m is not None]
    terms: list[Term] = [*maps, *signals]
    if temperature_gradient_std is not None:
        std = np.asarray(temperature_gradient_std, dtype=float)
        terms.append(GradientOfBias(std=std, has_prior=bool(np.isfinite(std))))
    terms += path
    if harmonics:
        terms.append(
            EncoderHarmonics(amplitudes=np.array(list(harmonics.values()), dtype=float), orders=tuple(harmonics))
        )
    if backlash:
        terms.append(Backlash(std=np.asarray(backlash, dtype=float)))
    terms += [m.beyond for m in maps if m.beyond is not None]
    return SensorModel(
        tuple(terms),
        np.asarray(angle_random_walk, dtype=float),
        no_processes() if processes is None else processes,
        angle_reference() if reference is None else reference,
    )
