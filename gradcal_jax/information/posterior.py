"""Square-root information of the parameters, from the regressors of a plan, and the posterior covariance.

`rows` are whitened regressors stacked over whitened priors. Their columns are scaled to unit length before one
triangular factor is taken, so that nothing depends on the units of the parameters:

    rows = A diag(scale),   AᵀA = RᵀR,   covariance C = diag(scale)⁻¹ (RᵀR)⁻¹ diag(scale)⁻¹

The design differentiates `SquareRootInformation`; results are reported from `Posterior`, in which the unobservable
combinations are separate.
"""

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
from jaxtyping import Bool, Float

from gradcal_jax.arrays import AnyArray, fixed, namespace
from gradcal_jax.information.noise_steps import NoisePart, NoiseSteps
from gradcal_jax.linalg import column_norms, solve_transposed, triangular_factor
from gradcal_jax.tables.display import summary

# Singular values of unit-length columns below this share of the largest are rounding, not information.
OBSERVABLE = 1e-11
# Number of steps whose responses are kept together.
_TOGETHER = 1024


class SquareRootInformation(NamedTuple):
    """`information = diag(scale) RᵀR diag(scale)`, R upper triangular; `inverse`: of RᵀR, if computed."""

    factor: Float[AnyArray, "p p"]
    scale: Float[AnyArray, " p"]
    inverse: Float[AnyArray, "p p"] | None = None

    def covariance(self) -> Float[AnyArray, "p p"]:
        """Covariance of all parameters; not finite for unobservable ones."""
        inverse, xp = self.inverse, namespace(self.factor)
        if inverse is None:
            half = solve_transposed(self.factor, xp.eye(len(self.scale)))
            inverse = half.T @ half
        return inverse / (self.scale[:, None] * self.scale[None, :])

    def root(self) -> Float[AnyArray, "p p"]:
        """A root of the covariance, `C = root rootᵀ`; not finite for unobservable parameters."""
        half = solve_transposed(self.factor, namespace(self.factor).eye(len(self.scale)))
        return half.T / self.scale[:, None]

    def without(self, count: int) -> "SquareRootInformation":
        """The information about all parameters but the first `count`."""
        inverse = None if self.inverse is None else self.inverse[count:, count:]
        return SquareRootInformation(self.factor[count:, count:], self.scale[count:], inverse)

    def deviations(self, contrasts: Float[AnyArray, "g p"]) -> Float[AnyArray, " g"]:
        """Standard deviation of each linear combination of the parameters; differentiable, for observable ones."""
        solved = solve_transposed(self.factor, (contrasts / self.scale[None, :]).T)
        xp = namespace(solved)
        return xp.sqrt(xp.sum(solved * solved, axis=0))


def square_root(rows: Float[AnyArray, "rows p"]) -> SquareRootInformation:
    """One triangular factor of rows whose columns are first scaled to unit length."""
    scale = fixed(column_norms(rows))
    return SquareRootInformation(triangular_factor(rows / scale[None, :]), scale)


class Posterior(NamedTuple):
    """The posterior after a plan: covariance `C = spread spreadᵀ`, and the unobservable directions `hidden`.

    `spread` is `(p, r)`, `hidden` `(p, k)` with `r + k = p`, directions in parameter space.
    """

    spread: np.ndarray
    hidden: np.ndarray

    __repr__ = summary

    def deviations(self, contrasts: np.ndarray) -> np.ndarray:
        """Standard deviation of each row of `contrasts` `(g, p)`; `inf` for one with a hidden component."""
        values = np.sqrt(np.sum((contrasts @ self.spread) ** 2, axis=1))
        if self.hidden.shape[1]:
            size = np.sqrt(np.sum(contrasts**2, axis=1, keepdims=True))
            part = np.max(np.abs(contrasts @ self.hidden), axis=1) / np.where(size[:, 0] > 0, size[:, 0], 1.0)
            values = np.where(part > 1e-7, np.inf, values)
        return values

    def covariance(self, contrasts: np.ndarray) -> np.ndarray:
        """Covariance of the rows of `contrasts`, without their hidden components."""
        half = contrasts @ self.spread
        return half @ half.T


def posterior(info: SquareRootInformation) -> Posterior:
    """The posterior of the parameters (SI).

    The singular values of the scaled factor separate the unobservable directions, `(p, p) -> (p, r), (p, k)`.
    """
    _, singular, directions = np.linalg.svd(np.asarray(info.factor))
    return known_of(singular, directions, np.asarray(info.scale))


def known_of(
    singular: Float[np.ndarray, " k"], directions: Float[np.ndarray, "p p"], scale: Float[np.ndarray, " p"]
) -> Posterior:
    """The posterior of variance one by singular values and right directions of rows with columns of length one."""
    rank = int(np.count_nonzero(singular > OBSERVABLE * np.max(singular, initial=0.0)))
    hidden = directions[rank:].T / scale[:, None]
    hidden = hidden / np.maximum(np.linalg.norm(hidden, axis=0), np.finfo(float).tiny)
    return Posterior((directions[:rank].T / singular[:rank]) / scale[:, None], hidden)


class LeastSquares(NamedTuple):
    """Ordinary least squares on a standard plan's mean rate errors: `β̂ = back weightsᵀ y` of the integrated errors y.

    `weights` `(N, r)` are orthonormal but for the points' times; `hidden` `(p, p − r)`: unobservable directions.
    """

    weights: np.ndarray
    back: np.ndarray
    hidden: np.ndarray


def least_squares_of_means(
    columns: Float[np.ndarray, "N p"], used: Bool[np.ndarray, " N"], duration: Float[np.ndarray, " N"]
) -> LeastSquares:
    """Of integrals over `duration` s, whose means all have the same weight; priors are not used."""
    lasting = duration[used][:, None]
    rows = columns[used] / lasting
    scale = np.where((norm := np.linalg.norm(rows, axis=0)) > 0, norm, 1.0)
    left, singular, directions = np.linalg.svd(rows / scale)
    back, hidden = known_of(singular, directions, scale)
    weights = np.zeros((len(used), back.shape[1]))
    weights[used] = left[:, : back.shape[1]] / lasting
    return LeastSquares(weights, back, hidden)


def spread_of(estimator: LeastSquares, noise: Float[np.ndarray, "r r"]) -> Posterior:
    """Covariance of an estimate, from that of its weighted sums."""
    values, vectors = np.linalg.eigh(noise)
    return Posterior(estimator.back @ (vectors * np.sqrt(np.maximum(values, 0.0))), estimator.hidden)


def noise_of_sums(
    steps: NoiseSteps, weights: Float[np.ndarray, "N m"], parts: Sequence[NoisePart]
) -> list[Float[np.ndarray, "m m"]]:
    """`weightsᵀ V weights`, the covariance of m weighted sums of all readings, for each part V of the noise of `steps`,
    whose readings have none of their own.

    With the adjoint `ρ_k = H_k w_k + F_k₊₁ᵀ ρ_k₊₁`, backwards, it is a sum over the steps' noises and the start.
    """
    count, n = steps.observation.shape
    totals = [np.zeros((weights.shape[1],) * 2) for _ in parts]
    later = np.zeros((n, weights.shape[1]))
    moves = steps.moves()
    number = np.cumsum(moves) - 1
    for begin in reversed(range(0, count, _TOGETHER)):
        at = np.arange(begin, min(begin + _TOGETHER, count))
        responses = np.asarray(steps.observation)[at, :, None] * weights[at, None, :]
        for k in reversed(at):
            responses[k - begin] += later
            later = np.asarray(steps.transition[k]).T @ responses[k - begin] if moves[k] else responses[k - begin]
        responses, at = responses[moves[at]], number[at[moves[at]]]
        for total, part in zip(totals, parts, strict=True):
            # A source acts on few of the states.
            noise = np.asarray(part.covariance[at])
            driven = np.flatnonzero(np.any(noise, axis=(0, 1)))
            own, noise = responses[:, driven], noise[:, driven[:, None], driven]
            total += np.reshape(own, (-1, own.shape[2])).T @ np.reshape(noise @ own, (-1, own.shape[2]))
    return [total + later.T @ np.asarray(part.initial) @ later for total, part in zip(totals, parts, strict=True)]
