"""Criteria of a design: residual statistics, smooth while searching, exact when reported.

With `s_ij` the residual at temperature i and rate j, and a sharpness k, the maximum over temperature is replaced by a
norm

    max_i s_ij  ≤  (Σ_i s_ij^k)^(1/k)  ≤  n_T^(1/k) · max_i s_ij

which tends to it as k grows; an infinite sharpness is the exact statistic.

The classical optimality criteria of the covariance C of p parameters are standard deviations: A is `√(tr C/p)`, D is
`(det C)^(1/2p)`, E is the root of C's largest eigenvalue.
"""

from typing import Literal

import equinox as eqx
import numpy as np
from jaxtyping import Float

from gradcal_jax.arrays import AnyArray, fixed, namespace
from gradcal_jax.information import SquareRootInformation
from gradcal_jax.information.residual import Quantity, Statistic, contrasts
from gradcal_jax.linalg import solve_transposed
from gradcal_jax.model import SensorModel
from gradcal_jax.motion import lagrange

EXACT = np.asarray(np.inf)
"""Value of `sharpness` for which a criterion equals the statistic."""


class Criterion(eqx.Module):
    """A named statistic of a residual map on a box; the value is in SI (1 for the scale factor, rad/s for the bias).

    `rows`, `alone`, `beyond`: see `information.contrasts`; `alone` is None without a discrepancy. `between`: matrices
    that interpolate the variance from the grid of the rows to the grid of `shape`; see `polynomial_grid`.
    """

    rows: Float[AnyArray, "g p"]
    alone: Float[AnyArray, "g p"] | None
    beyond: Float[AnyArray, " g"]
    shape: tuple[int, int] = eqx.field(static=True)
    statistic: Statistic = eqx.field(static=True)
    between: tuple[Float[AnyArray, "n_T a"], Float[AnyArray, "n_w b"]] | None = None

    def map(self, info: SquareRootInformation) -> Float[AnyArray, "n_T n_w"]:
        """The residual on the box; differentiable, for a plan that observes everything."""
        xp = namespace(info.factor, self.rows)
        if self.alone is None:
            variance = info.deviations(self.rows) ** 2 + self.beyond
        else:
            # cᵀCc − αᵀCα = (c − α)ᵀC(c + α): one product instead of two triangular solves for many rows.
            half = (self.rows - self.alone) @ info.covariance()
            variance = xp.sum(half * (self.rows + self.alone), axis=1) + self.beyond
        if self.between is not None:
            of_temperature, of_rate = self.between
            variance = of_temperature @ xp.reshape(variance, (of_temperature.shape[1], -1)) @ of_rate.T
        return xp.reshape(xp.sqrt(variance), self.shape)

    def __call__(self, info: SquareRootInformation, sharpness: Float[AnyArray, ""] | float = EXACT):
        """The statistic: exact for an infinite sharpness, from above otherwise."""
        return smooth_statistic(self.statistic, self.map(info), sharpness)


class Optimality(eqx.Module):
    """A-, D- or E-optimality of the covariance of `rows` (p combinations of the parameters, in one unit)."""

    rows: Float[AnyArray, "q p"]
    kind: Literal["A", "D", "E"] = eqx.field(static=True)

    def __call__(self, info: SquareRootInformation, sharpness: Float[AnyArray, ""] | float = EXACT):
        """The value in the parameters' unit; smooth except for E at equal eigenvalues."""
        del sharpness
        return self.of_root(solve_transposed(info.factor, (self.rows / info.scale[None, :]).T))

    def of_root(self, half: Float[AnyArray, "p q"]):
        """The same of a root of the covariance, `halfᵀ half`."""
        count, xp = self.rows.shape[0], namespace(half)
        if self.kind == "A":
            return xp.sqrt(xp.sum(half**2) / count)
        covariance = half.T @ half
        if self.kind == "E":
            return xp.sqrt(xp.linalg.eigvalsh(covariance)[-1])
        return xp.exp(xp.linalg.slogdet(covariance)[1] / (2 * count))


def polynomial_grid(at: Float[np.ndarray, " n"], degree: int) -> tuple[Float[np.ndarray, " m"], np.ndarray]:
    """A few nodes, and the matrix `(n, m)` that maps a polynomial's values at the nodes to those `at` all points.

    The variance of a polynomial of a degree is a polynomial of twice that degree, so `2·degree + 1` Chebyshev nodes
    determine it everywhere.
    """
    count = 2 * degree + 1
    if count >= len(at):
        return at, np.eye(len(at))
    low, high = np.min(at), np.max(at)
    nodes = np.cos(np.pi * (np.arange(count) + 0.5) / count)
    return 0.5 * (low + high) + 0.5 * (high - low) * nodes, lagrange(nodes, (2.0 * at - low - high) / (high - low))


def criterion(
    model: SensorModel, quantity: Quantity, temperature: np.ndarray, rate: np.ndarray, statistic: Statistic
) -> Criterion:
    """A criterion on a grid of temperatures (°C) and rates (rad/s).

    Errors: `ValueError` when the model does not estimate the quantity.
    """
    grid_t, grid_w = np.meshgrid(temperature, rate, indexing="ij")
    rows, alone, beyond = contrasts(model, quantity, grid_t.ravel(), grid_w.ravel())
    shape = (len(temperature), len(rate))
    return Criterion(rows, alone if np.any(alone) else None, beyond, shape, statistic)


def smooth_statistic(name: Statistic, values: Float[AnyArray, "n_T n_w"], sharpness):
    """A statistic of a map: exact for an infinite sharpness, from above otherwise."""
    xp = namespace(values)
    if name == "mean":
        return xp.mean(values)
    if name == "rms":
        return xp.sqrt(xp.mean(values**2))
    if name == "max":
        return largest(xp.reshape(values, (-1, 1)), sharpness)[0]
    return xp.mean(largest(values, sharpness))


def largest(values: Float[AnyArray, "n m"], sharpness) -> Float[AnyArray, " m"]:
    """Maximum along the first axis, exact for an infinite sharpness, or from above."""
    xp = namespace(values, sharpness)
    peak = xp.max(values, axis=0)
    soft = xp.isfinite(sharpness)
    k = xp.where(soft, sharpness, 1.0)
    scale = fixed(peak)
    norm = scale * xp.sum((values / scale[None]) ** k, axis=0) ** (1.0 / k)
    return xp.where(soft, norm, peak)
