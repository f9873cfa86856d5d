"""The estimate: the whitening and least squares of the prediction, applied to data.

Readings of the integrated error, with the regressors and the noise steps of a prediction: `N` steps (some without a
reading), `p` parameters of the model. `y_k = Φ_k β + noise` is the integrated output of the sensor less the reference.

The readings are whitened as columns beside the regressors; with the priors' rows below them

    A = [Φ̃; P],  z = [ỹ; 0],     β̂ = argmin |z − A β|²,     C = (AᵀA)⁻¹

so `C` is the covariance of `information.posterior` for the same timeline, to rounding. The whitened
residuals `r = ỹ − Φ̃ β̂` are the normalised innovations of the noise's Kalman filter: independent with variance 1 where
the model is true.
"""

from typing import NamedTuple

import numpy as np

from gradcal_jax.information import Posterior
from gradcal_jax.information.posterior import known_of


class Whitened(NamedTuple):
    """Rows of variance one, of the steps that have a reading: `rows` `(n, p)`, `data` `(n,)`. `prior` `(q, p)`:
    whitened rows of the prior, whose data are zero."""

    rows: np.ndarray
    data: np.ndarray
    prior: np.ndarray

    def without(self, own: slice | np.ndarray) -> "Whitened":
        """The rows without the columns `own` (a slice, or a mask) and the priors that concern them."""
        kept = ~np.any(self.prior[:, own] != 0.0, axis=1)
        return Whitened(np.delete(self.rows, own, axis=1), self.data, np.delete(self.prior[kept], own, axis=1))


class Estimate(NamedTuple):
    """`parameters` `(p,)`, in the engine's coordinates, with their posterior; `residuals` `(n,)`: whitened, of the
    readings used; `chi_squared` counts the priors' rows too and has `degrees` degrees of freedom."""

    parameters: np.ndarray
    known: Posterior
    residuals: np.ndarray
    chi_squared: np.ndarray
    degrees: int


class Factored(NamedTuple):
    """A design `(n, p)` with columns of length one, Q L diag(singular) directions: `known`, the posterior of variance
    one, and `basis` `(n, r)`, orthonormal, of what its columns span."""

    orthogonal: np.ndarray
    left: np.ndarray
    singular: np.ndarray
    directions: np.ndarray
    scale: np.ndarray
    known: Posterior

    @property
    def basis(self) -> np.ndarray:
        return self.orthogonal @ self.left

    def fit(self, data: np.ndarray) -> np.ndarray:
        """The parameters of minimal norm for data `(n,)` or `(n, U)`."""
        rotated = self.left.T @ (self.orthogonal.T @ data)
        return ((self.directions.T @ (rotated.T / self.singular).T).T / self.scale).T


def factored(design: np.ndarray) -> Factored:
    """The factors of a design, whose unobservable directions are `known.hidden`.

    As `information.square_root` and `posterior`, but by NumPy's QR, since shapes vary and nothing is differentiated.
    """
    norm = np.linalg.norm(design, axis=0)
    scale = np.where(norm > 0.0, norm, 1.0)
    orthogonal, triangle = np.linalg.qr(design / scale)
    left, singular, directions = np.linalg.svd(triangle)
    known = known_of(singular, directions, scale)
    rank = known.spread.shape[1]
    return Factored(orthogonal, left[:, :rank], singular[:rank], directions[:rank], scale, known)
