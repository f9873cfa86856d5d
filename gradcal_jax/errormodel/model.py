"""The error model of a gyro axis (Berman, eq. 1) as columns of a linear model and processes of a noise model.

    δω = B(T) + ε_d2d + ε_ins(t) + M(T, ω)·ω + ε_res(t)·ω + ε_RW(t)

`B` and `M` are expanded in bases; together with the optional terms they make the parameter vector `β`, whose columns
this module names and orders:

    [ B coefficients | M coefficients (temperature slow, rate fast) | dB/dṪ | harmonics of the encoder, cos and sin |
      discrepancy of B | discrepancy of M ]

Everything else of eq. 1 is noise (`errormodel.noise`).
"""

import itertools
from dataclasses import dataclass

import equinox as eqx
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from gradcal_jax.errormodel.bases import Basis, HigherPolynomials, Polynomial, tensor
from gradcal_jax.errormodel.noise import Processes, Reference


class Map(eqx.Module):
    """A calibrated function: `B(T)` (`rate` is None) or `M(T, ω)`, with its priors.

    `prior_std`: standard deviation of each *reported* coefficient, rad/s for B and 1 for M; `inf` is flat.
    `smoothness_std`: standard deviation of the difference of neighbouring coefficients; `inf` is none.
    `discrepancy`: the higher polynomials that the structure leaves out, each with the standard deviation
    `discrepancy_std`.
    """

    temperature: Basis
    rate: Basis | None
    prior_std: Float[Array | np.ndarray, ""]
    smoothness_std: Float[Array | np.ndarray, ""]
    discrepancy_std: Float[Array | np.ndarray, ""]
    discrepancy_temperature: HigherPolynomials | None = None
    discrepancy_rate: HigherPolynomials | None = None
    has_prior: bool = eqx.field(static=True, default=False)
    has_smoothness: bool = eqx.field(static=True, default=False)

    @property
    def size(self) -> int:
        return self.temperature.size * (1 if self.rate is None else self.rate.size)

    @property
    def discrepancy_size(self) -> int:
        if self.discrepancy_temperature is None:
            return 0
        extra = self.discrepancy_temperature.size
        if self.rate is None or self.discrepancy_rate is None:
            return extra
        rates, beyond = self.rate.size, self.discrepancy_rate.size
        return extra * (rates + beyond) + self.temperature.size * beyond

    def values(self, temperature: Float[Array, "*s"], rate: Float[Array, "*s"]) -> Float[Array, "*s size"]:
        """The engine's functions at temperatures (°C) and rates (rad/s)."""
        at_temperature = self.temperature(temperature)
        return at_temperature if self.rate is None else tensor(at_temperature, self.rate(rate))

    def discrepancy_values(self, temperature: Float[Array, "*s"], rate: Float[Array, "*s"]) -> Float[Array, "*s extra"]:
        """The functions that the structure leaves out, at temperatures (°C) and rates (rad/s)."""
        if self.discrepancy_temperature is None:
            return jnp.zeros((*temperature.shape, 0))
        extra_t = self.discrepancy_temperature
        if self.rate is None or self.discrepancy_rate is None:
            return extra_t(temperature)
        extra_w = self.discrepancy_rate
        # Legendre throughout, whatever form the engine computes the structure in: the prior is on these functions.
        all_t, all_w = extra_t.from_zero(temperature), extra_w.from_zero(rate)
        within_t, beyond_t = all_t[..., : extra_t.lowest], all_t[..., extra_t.lowest :]
        return jnp.concatenate([tensor(beyond_t, all_w), tensor(within_t, all_w[..., extra_w.lowest :])], axis=-1)

    @property
    def to_reported(self) -> np.ndarray:
        """`(size, size)`: engine coefficients to the reported ones (the paper's normalised monomials)."""
        of_temperature = self.temperature.to_reported
        return of_temperature if self.rate is None else np.kron(of_temperature, self.rate.to_reported)

    @property
    def constant(self) -> np.ndarray:
        """`(size,)`: engine coefficients of the map that is 1 everywhere."""
        return (
            self.temperature.constant if self.rate is None else np.kron(self.temperature.constant, self.rate.constant)
        )

    def differences(self) -> np.ndarray:
        """`(q, size)`: differences of neighbouring coefficients, along temperature and along rate."""
        steps = lambda n: np.diff(np.eye(n), axis=0)  # noqa: E731
        n_t = self.temperature.size
        if self.rate is None:
            return steps(n_t)
        n_w = self.rate.size
        return np.concatenate([np.kron(steps(n_t), np.eye(n_w)), np.kron(np.eye(n_t), steps(n_w))])


def make_map(
    temperature: Basis,
    rate: Basis | None = None,
    *,
    prior_std: float = np.inf,
    smoothness_std: float = np.inf,
    discrepancy: tuple[float, int, int] | None = None,
) -> Map:
    """A map from plain numbers (SI). `discrepancy` is (standard deviation, highest degree in T, highest degree in ω).

    Errors: `ValueError` where a discrepancy is asked of a basis that is not polynomial, or reaches no higher than it.
    """
    beyond_t = beyond_w = None
    discrepancy_std = 0.0
    if discrepancy is not None:
        discrepancy_std, degree_t, degree_w = discrepancy
        polynomials = [b for b in (temperature, rate) if isinstance(b, Polynomial)]
        if len(polynomials) < (1 if rate is None else 2):
            raise ValueError(
                "a model discrepancy needs polynomial bases: B-splines and bins take a smoothness prior instead"
            )
        beyond_t, *others = [
            HigherPolynomials(b.degree + 1, degree, b.centre, b.scale)
            for b, degree in zip(polynomials, (degree_t, degree_w), strict=False)
        ]
        beyond_w = others[0] if others else None
        if beyond_t.size == 0 and (beyond_w is None or beyond_w.size == 0):
            raise ValueError("the discrepancy's degrees must exceed the model's, otherwise it describes nothing new")
    scalar = lambda v: np.asarray(v, dtype=float)  # noqa: E731
    return Map(
        temperature,
        rate,
        scalar(prior_std),
        scalar(smoothness_std),
        scalar(discrepancy_std),
        beyond_t,
        beyond_w,
        has_prior=bool(np.isfinite(prior_std)),
        has_smoothness=bool(np.isfinite(smoothness_std)),
    )


@dataclass(frozen=True)
class Columns:
    """Where each group stands in the parameter vector."""

    bias: slice
    scale: slice
    gradient: slice
    harmonics: slice
    bias_discrepancy: slice
    scale_discrepancy: slice
    count: int


class GyroModel(eqx.Module):
    """A gyro axis with its reference: maps to calibrate, noise, and the priors of all of them.

    `angle_random_walk` in rad/√s. `turn_on_std` in rad/s: where B is estimated its constant *is* this run's turn-on
    bias, so the two priors add; where B is known the turn-on bias is noise, put among `processes` by whoever assembles.
    `gradient_std` in (rad/s)/(K/s), `inf` flat; `has_gradient` says whether dB/dṪ is a parameter at all.

    Source: Berman, eq. 1. Errors: `ValueError` where there is nothing to find.
    """

    bias: Map | None
    scale: Map | None
    angle_random_walk: Float[Array | np.ndarray, ""]
    processes: Processes
    reference: Reference
    turn_on_std: Float[Array | np.ndarray, ""]
    gradient_std: Float[Array | np.ndarray, ""]
    has_gradient: bool = eqx.field(static=True, default=False)
    has_gradient_prior: bool = eqx.field(static=True, default=False)

    def __check_init__(self):
        if self.bias is None and self.scale is None:
            raise ValueError("nothing to calibrate: give the model a bias map, a scale-factor map, or both")

    @property
    def columns(self) -> Columns:
        sizes = [
            0 if self.bias is None else self.bias.size,
            0 if self.scale is None else self.scale.size,
            1 if self.has_gradient else 0,
            2 * len(self.reference.harmonic_orders),
            0 if self.bias is None else self.bias.discrepancy_size,
            0 if self.scale is None else self.scale.discrepancy_size,
        ]
        ends = np.cumsum([0, *sizes]).tolist()
        return Columns(*(slice(a, b) for a, b in itertools.pairwise(ends)), count=ends[-1])

    def prior_rows(self) -> Float[Array, "q p"]:
        """Whitened rows of everything known beforehand: stacked over the data's rows they make the posterior."""
        columns = self.columns
        rows: list[Array] = []

        def add(where: slice, block: Array | np.ndarray) -> None:
            rows.append(jnp.zeros((block.shape[0], columns.count)).at[:, where].set(block))

        if self.bias is not None:
            if self.bias.has_prior:
                add(columns.bias, _prior_of_bias(self.bias, self.turn_on_std))
            if self.bias.has_smoothness:
                add(columns.bias, jnp.asarray(self.bias.differences()) / self.bias.smoothness_std)
            if self.bias.discrepancy_size:
                add(columns.bias_discrepancy, jnp.eye(self.bias.discrepancy_size) / self.bias.discrepancy_std)
        if self.scale is not None:
            if self.scale.has_prior:
                add(columns.scale, jnp.asarray(self.scale.to_reported) / self.scale.prior_std)
            if self.scale.has_smoothness:
                add(columns.scale, jnp.asarray(self.scale.differences()) / self.scale.smoothness_std)
            if self.scale.discrepancy_size:
                add(columns.scale_discrepancy, jnp.eye(self.scale.discrepancy_size) / self.scale.discrepancy_std)
        if self.has_gradient and self.has_gradient_prior:
            add(columns.gradient, jnp.reshape(1.0 / self.gradient_std, (1, 1)))
        if self.reference.harmonic_orders:
            add(columns.harmonics, jnp.diag(1.0 / jnp.repeat(self.reference.harmonic_amplitudes, 2)))
        return jnp.concatenate(rows) if rows else jnp.zeros((0, columns.count))


def _prior_of_bias(bias: Map, turn_on_std: Float[Array | np.ndarray, ""]) -> Float[Array, "size size"]:
    """Rows of the prior `diag(σ²) + σ_on² v vᵀ` on the reported coefficients, `v` being the constant function's.

    A rank-one update of the identity has the square root `1 − γ v vᵀ`, so no factorisation is needed:
    `(1 + c v vᵀ)^(-1/2) = 1 − (1 − 1/√(1 + c|v|²)) v vᵀ/|v|²`.
    """
    reported = jnp.asarray(bias.to_reported)
    v = reported @ jnp.asarray(bias.constant)
    square = v @ v
    shrink = 1.0 - 1.0 / jnp.sqrt(1.0 + (turn_on_std / bias.prior_std) ** 2 * square)
    whiten = jnp.eye(bias.size) - shrink * jnp.outer(v, v) / square
    return whiten @ reported / bias.prior_std
