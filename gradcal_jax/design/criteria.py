"""What a design minimises: a residual statistic, smooth while searching, exact when reported.

With `s_ij` the residual at temperature i and rate j, and a sharpness k, the maximum over temperature is replaced by a
norm

    max_i s_ij  ≤  (Σ_i s_ij^k)^(1/k)  ≤  n_T^(1/k) · max_i s_ij

which tends to it as k grows. `None` is the exact statistic.

The classical optimalities of the covariance C of p parameters are given as standard deviations: A is `√(tr C/p)`, D is
`(det C)^(1/2p)`, E is the root of C's largest eigenvalue.
"""

from typing import Literal

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from gradcal_jax.errormodel import GyroModel
from gradcal_jax.information import SquareRootInformation
from gradcal_jax.information.residual import Quantity, Statistic, contrasts


class Criterion(eqx.Module):
    """A named statistic of a residual map on a box; the value is in SI (1 for the scale factor, rad/s for the bias)."""

    rows: Float[Array, "g p"]
    beyond: Float[Array, " g"]
    shape: tuple[int, int] = eqx.field(static=True)
    statistic: Statistic = eqx.field(static=True)

    def map(self, info: SquareRootInformation) -> Float[Array, "n_T n_w"]:
        """The residual on the box; differentiable, for a plan that observes everything."""
        return jnp.reshape(jnp.sqrt(info.deviations(self.rows) ** 2 + self.beyond), self.shape)

    def __call__(
        self, info: SquareRootInformation, sharpness: Float[Array, ""] | float | None = None
    ) -> Float[Array, ""]:
        """The statistic: exact for `sharpness` None, from above otherwise."""
        values = self.map(info)
        if self.statistic == "mean":
            return jnp.mean(values)
        if self.statistic == "rms":
            return jnp.sqrt(jnp.mean(values**2))
        if self.statistic == "max":
            return _largest(jnp.reshape(values, (-1, 1)), sharpness)[0]
        return jnp.mean(_largest(values, sharpness))


class Optimality(eqx.Module):
    """A, D or E of the covariance of `rows` (p combinations of the parameters, of one unit)."""

    rows: Float[Array, "q p"]
    kind: Literal["A", "D", "E"] = eqx.field(static=True)

    def __call__(self, info: SquareRootInformation, sharpness: Float[Array, ""] | float | None = None):
        """The value, in the parameters' unit; smooth but for E at equal eigenvalues."""
        del sharpness
        scaled = (self.rows / info.scale[None, :]).T
        half = jax.scipy.linalg.solve_triangular(info.factor, scaled, trans=1, lower=False)
        count = self.rows.shape[0]
        if self.kind == "A":
            return jnp.sqrt(jnp.sum(half**2) / count)
        covariance = half.T @ half
        if self.kind == "E":
            return jnp.sqrt(jnp.linalg.eigvalsh(covariance)[-1])
        return jnp.exp(jnp.linalg.slogdet(covariance)[1] / (2 * count))


def criterion(
    model: GyroModel, quantity: Quantity, temperature: np.ndarray, rate: np.ndarray, statistic: Statistic
) -> Criterion:
    """A criterion on a grid of temperatures (°C) and rates (rad/s).

    Errors: `ValueError` when the model does not estimate the quantity, or carries a discrepancy, whose prior the search
    does not see.
    """
    of = model.bias if quantity == "bias" else model.scale
    if of is not None and of.discrepancy_size:
        raise ValueError(
            "a design is searched without a model discrepancy: leave it out while optimising, then predict with it"
        )
    grid_t, grid_w = np.meshgrid(temperature, rate, indexing="ij")
    rows, beyond = contrasts(model, quantity, jnp.asarray(grid_t.ravel()), jnp.asarray(grid_w.ravel()))
    return Criterion(rows, beyond, (len(temperature), len(rate)), statistic)


def _largest(values: Float[Array, "n m"], sharpness) -> Float[Array, " m"]:
    """Maximum along the first axis, exact or from above."""
    peak = jnp.max(values, axis=0)
    if sharpness is None:
        return peak
    scale = jax.lax.stop_gradient(peak)
    return scale * jnp.exp(jax.scipy.special.logsumexp(sharpness * jnp.log(values / scale[None]), axis=0) / sharpness)
