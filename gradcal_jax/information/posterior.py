"""Square-root information of the parameters, and what it leaves uncertain.

`rows` are whitened regressors stacked over whitened priors. Their columns are scaled to unit length before one
triangular factor is taken, so that nothing depends on the units of the parameters:

    rows = A diag(scale),   AᵀA = RᵀR,   covariance C = diag(scale)⁻¹ (RᵀR)⁻¹ diag(scale)⁻¹

`SquareRootInformation` is what the design differentiates; `Posterior` is what is reported, after the combinations
that the plan cannot observe have been set apart.
"""

from typing import NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from gradcal_jax.errormodel import GyroModel
from gradcal_jax.information.adjoint import whitened_factor
from gradcal_jax.information.noise_steps import noise_steps
from gradcal_jax.information.regressors import at_readings
from gradcal_jax.information.whitening import whiten
from gradcal_jax.linalg import column_norms, solve_transposed, triangular_factor
from gradcal_jax.plans import Timeline

# Singular values of unit-length columns below this share of the largest are rounding, not information.
OBSERVABLE = 1e-11


class SquareRootInformation(NamedTuple):
    """`information = diag(scale) RᵀR diag(scale)`, R upper triangular."""

    factor: Float[Array, "p p"]
    scale: Float[Array, " p"]

    def deviations(self, contrasts: Float[Array, "g p"]) -> Float[Array, " g"]:
        """Standard deviation of each linear combination of the parameters; differentiable, for observable ones."""
        solved = solve_transposed(self.factor, (contrasts / self.scale[None, :]).T)
        return jnp.sqrt(jnp.sum(solved * solved, axis=0))


def information(timeline: Timeline, model: GyroModel) -> SquareRootInformation:
    """Everything that the plan's readings and the priors say of the model's parameters.

    Errors: `ValueError` in single precision, which cannot carry a covariance that is reported; for a search that
    needs only a direction, call `whitened_factor` yourself.
    """
    steps, columns = noise_steps(timeline, model), at_readings(timeline, model)
    if columns.dtype != jnp.float64:
        raise ValueError(
            "a covariance in single precision is not reported: call jax.config.update('jax_enable_x64', True) before "
            "the first JAX array is made"
        )
    return SquareRootInformation(*whitened_factor(steps, columns, model.prior_rows()))


def whitened_rows(timeline: Timeline, model: GyroModel) -> Float[Array, "rows p"]:
    """Whitened regressors of all readings, with the rows of the priors below them."""
    rows = whiten(noise_steps(timeline, model), at_readings(timeline, model))
    return jnp.concatenate([rows, model.prior_rows()])


def square_root(rows: Float[Array, "rows p"]) -> SquareRootInformation:
    """One triangular factor of rows whose columns are first scaled to unit length."""
    scale = jax.lax.stop_gradient(column_norms(rows))
    return SquareRootInformation(triangular_factor(rows / scale[None, :]), scale)


class Posterior(eqx.Module):
    """What is known after the plan: `C = spread spreadᵀ` on what can be observed, and `hidden`, what cannot.

    `spread` is `(p, r)`, `hidden` `(p, k)` with `r + k = p`: directions in parameter space of which the plan says
    nothing.
    """

    spread: np.ndarray
    hidden: np.ndarray

    def deviations(self, contrasts: np.ndarray) -> np.ndarray:
        """Standard deviation of each row of `contrasts` `(g, p)`; `inf` where a hidden direction takes part."""
        values = np.sqrt(np.sum((contrasts @ self.spread) ** 2, axis=1))
        if self.hidden.shape[1]:
            size = np.sqrt(np.sum(contrasts**2, axis=1, keepdims=True))
            part = np.max(np.abs(contrasts @ self.hidden), axis=1) / np.where(size[:, 0] > 0, size[:, 0], 1.0)
            values = np.where(part > 1e-7, np.inf, values)
        return values

    def covariance(self, contrasts: np.ndarray) -> np.ndarray:
        """Covariance of the rows of `contrasts`, on what can be observed."""
        half = contrasts @ self.spread
        return half @ half.T


def posterior(info: SquareRootInformation) -> Posterior:
    """What is known of the parameters (SI) after a plan, from `information.information(timeline, model)`.

    What cannot be observed is set apart by the singular values of the scaled factor, `(p, p) -> (p, r), (p, k)`.
    Errors: none here; `information` refuses single precision with a `ValueError`.
    """
    scale = np.asarray(info.scale)
    _, singular, directions = np.linalg.svd(np.asarray(info.factor))
    seen = singular > OBSERVABLE * (singular[0] if len(singular) else 1.0)
    spread = (directions[seen].T / singular[seen]) / scale[:, None]
    hidden = directions[~seen].T / scale[:, None]
    return Posterior(spread, hidden / np.maximum(np.linalg.norm(hidden, axis=0), np.finfo(float).tiny))


def unweighted(timeline: Timeline, model: GyroModel) -> Posterior:
    """Covariance of ordinary least squares on the *rate* errors of a standard plan (the paper's Figure 6).

    Every point's mean rate error counts alike, whatever its variance; priors are not used. Errors: `ValueError` for a
    gradient plan, whose readings are angles.
    """
    if not timeline.rate_reference:
        raise ValueError("unweighted least squares on rates is for the standard method: a gradient plan reads angles")
    steps = noise_steps(timeline, model)
    duration = np.asarray(timeline.duration)
    variance = np.asarray(steps.covariance[:, 0, 0] + steps.reading_variance) / duration**2
    rows = np.asarray(at_readings(timeline, model)) / duration[:, None]
    scale = np.where((norm := np.linalg.norm(rows, axis=0)) > 0, norm, 1.0)
    left, singular, directions = np.linalg.svd(rows / scale, full_matrices=False)
    seen = singular > OBSERVABLE * singular[0]
    # β̂ = rows⁺ y, so C = rows⁺ V rows⁺ᵀ, whose root is rows⁺ V^½.
    spread = (directions[seen].T / singular[seen]) @ (left[:, seen].T * np.sqrt(variance)) / scale[:, None]
    full = np.linalg.svd(rows / scale)[2]
    hidden = full[int(seen.sum()) :].T / scale[:, None]
    return Posterior(spread, hidden / np.maximum(np.linalg.norm(hidden, axis=0), np.finfo(float).tiny))
