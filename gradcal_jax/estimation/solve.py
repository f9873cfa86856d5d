"""The estimate: the whitening and least squares of the prediction, applied to data.

Readings of the integrated error, with the regressors and the noise steps of a prediction: `N` steps (one for each piece
of a trajectory, some without a reading), `p` parameters of the model, `U` units on one table. `y_k = Φ_k β + noise` is
the integrated rate of the sensor less the angle of the reference since the angle's origin, with the regressors of
`information.at_readings` and the noise of `information.noise_steps`.

The readings are whitened as columns beside the regressors; with the priors' rows below them

    A = [Φ̃; P],  z = [ỹ; 0],     β̂ = argmin |z − A β|²,     C = (AᵀA)⁻¹

so `C` is the covariance of `information.posterior` for the same timeline, to rounding. The whitened
residuals `r = ỹ − Φ̃ β̂` are the normalised innovations of the noise's Kalman filter: independent with variance 1 where
the model is true.
"""

from typing import NamedTuple

import numpy as np

from gradcal_jax.information import Posterior, SquareRootInformation, posterior
from gradcal_jax.information.posterior import OBSERVABLE


class Whitened(NamedTuple):
    """Rows of variance one, of the steps that have a reading: `rows` `(U or 1, n, p)`, `data` `(U, n)`.

    `prior` `(q, p)`: whitened rows of the prior, whose data are zero.
    """

    rows: np.ndarray
    data: np.ndarray
    prior: np.ndarray

    def rows_of(self, unit: int) -> np.ndarray:
        return self.rows[unit if len(self.rows) > 1 else 0]

    def of_unit(self, unit: int) -> "Whitened":
        """One unit alone."""
        return Whitened(self.rows_of(unit)[None], self.data[unit : unit + 1], self.prior)

    def only(self, subset: np.ndarray) -> "Whitened":
        """A subset of the readings `(n,)`: whitened rows are independent, so any subset is an experiment of its own."""
        return Whitened(self.rows[:, subset], self.data[:, subset], self.prior)

    def without(self, own: slice | np.ndarray) -> "Whitened":
        """The rows without the columns `own` (a slice, or a mask) and the priors that concern them."""
        kept = ~np.any(self.prior[:, own] != 0.0, axis=1)
        return Whitened(np.delete(self.rows, own, axis=2), self.data, np.delete(self.prior[kept], own, axis=1))

    def condensed(self) -> "Whitened":
        """p + 1 rows with the same least squares and χ², also joined with those of the complement of a subset."""
        rows, data = [], []
        for unit in range(len(self.data)):
            both = np.concatenate([self.rows_of(unit), self.data[unit][:, None]], axis=1)
            triangle = np.asarray(np.linalg.qr(both, mode="r"))
            rows.append(triangle[:, :-1])
            data.append(triangle[:, -1])
        return Whitened(np.stack(rows), np.stack(data), self.prior)

    def joined(self, other: "Whitened") -> "Whitened":
        """The readings of both."""
        rows, data = ((self.rows, other.rows), (self.data, other.data))
        return Whitened(np.concatenate(rows, axis=1), np.concatenate(data, axis=1), self.prior)


class Estimate(NamedTuple):
    """Of `U` units. `parameters` `(U, p)`, in the engine's coordinates; `known`: posterior of each
    unit (the same object where the units share their columns).

    `residuals` `(U, n)`: whitened, of the readings used; `chi_squared` `(U,)` counts the priors' rows too and has
    `degrees` degrees of freedom.
    """

    parameters: np.ndarray
    known: tuple[Posterior, ...]
    residuals: np.ndarray
    chi_squared: np.ndarray
    degrees: np.ndarray


def solve(white: Whitened) -> Estimate:
    """Least squares of every unit, with minimal norm in the unobservable directions (`known.hidden`)."""
    units, priors = len(white.data), len(white.prior)
    parameters, known, squares, degrees = [], [], [], []
    for rows, members in (
        [(white.rows[0], range(units))] if len(white.rows) == 1 else [(white.rows[u], [u]) for u in range(units)]
    ):
        design = np.concatenate([rows, white.prior])
        data = np.concatenate([white.data[list(members)], np.zeros((len(members), priors))], axis=1).T
        factor, rotated, scale = _factor(design, data)
        one = posterior(SquareRootInformation(factor, scale))  # pyright: ignore[reportArgumentType]
        solution, _, rank, _ = np.linalg.lstsq(factor, rotated, rcond=OBSERVABLE)
        coefficients = solution / scale[:, None]
        parameters += list(coefficients.T)
        squares += list(np.sum((data - design @ coefficients) ** 2, axis=0))
        known += [one] * len(members)
        degrees += [len(design) - int(rank)] * len(members)
    beta = np.array(parameters)
    residuals = np.stack([white.data[u] - white.rows_of(u) @ beta[u] for u in range(units)])
    return Estimate(beta, tuple(known), residuals, np.array(squares), np.array(degrees))


def _factor(design: np.ndarray, data: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """`R` `(p, p)` of the design with columns of length one, `Qᵀ data`, and the columns' lengths.

    As `information.square_root`, but by NumPy's QR, since shapes vary and nothing is differentiated.
    """
    norm = np.linalg.norm(design, axis=0)
    scale = np.where(norm > 0.0, norm, 1.0)
    rows = design / scale
    if missing := max(0, rows.shape[1] - len(rows)):
        rows, data = np.pad(rows, ((0, missing), (0, 0))), np.pad(data, ((0, missing), (0, 0)))
    orthogonal, factor = np.linalg.qr(rows)
    return factor, orthogonal.T @ data, scale
