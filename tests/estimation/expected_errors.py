"""What errors of an estimate must be where the model is true."""

from typing import NamedTuple

import numpy as np
from scipy import special

from gradcal_jax.estimation import Whitened
from gradcal_jax.estimation.imu_solve import factored
from gradcal_jax.information import Posterior


def nees_band(runs, parameters, confidence=0.99):
    """Within which the mean of `runs` squared normalised errors, divided by the number of parameters, must lie."""
    tail = (1.0 - confidence) / 2.0
    degrees = runs * parameters
    return float(special.chdtri(degrees, 1.0 - tail) / degrees), float(special.chdtri(degrees, tail) / degrees)


class Solved(NamedTuple):
    parameters: np.ndarray
    known: Posterior
    residuals: np.ndarray
    chi_squared: np.ndarray
    degrees: int


def solve(white: Whitened) -> Solved:
    """Least squares of `U` sensors with the same rows, data `(n, U)`, with minimal norm in what is not observable."""
    design = np.concatenate([white.rows, white.prior])
    data = np.concatenate([white.data, np.zeros((len(white.prior), *white.data.shape[1:]))])
    of = factored(design)
    beta = of.fit(data)
    squares = np.sum((data - design @ beta) ** 2, axis=0)
    return Solved(beta, of.known, white.data - white.rows @ beta, squares, len(design) - len(of.singular))
