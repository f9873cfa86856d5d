"""The core's bases on plain NumPy arrays: the same formulas, for samples by the million."""

import jax.numpy as jnp
import numpy as np

from gradcal_jax import formulas
from gradcal_jax.errormodel import Basis, Bins, BSpline, Map, Polynomial


def basis_values(basis: Basis, x: np.ndarray) -> np.ndarray:
    """The engine's functions at `x`, `(n,) -> (n, size)`."""
    if isinstance(basis, Polynomial):
        family = formulas.legendre if basis.internal == "legendre" else formulas.chebyshev
        return family((x - basis.centre) / basis.scale, basis.degree)
    if isinstance(basis, BSpline):
        return formulas.b_spline(x, basis.knots, basis.degree)
    if isinstance(basis, Bins):
        return formulas.bins(x, basis.edges)
    return np.asarray(basis(jnp.asarray(x)))


def beyond(of: Map, temperature: np.ndarray, rate: np.ndarray) -> np.ndarray:
    """The functions that a map's structure leaves out, `(n, extra)`."""
    if not of.discrepancy_size:
        return np.zeros((len(temperature), 0))
    return np.asarray(of.discrepancy_values(jnp.asarray(temperature), jnp.asarray(rate)))
