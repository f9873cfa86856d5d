"""What errors of an estimate must be where the model is true."""

from typing import NamedTuple

import numpy as np
from scipy import special

from gradcal_jax.estimation import Estimate, Whitened
from gradcal_jax.estimation.solve import factored
from gradcal_jax.information import NoiseSteps, whiten
from gradcal_jax.model import ImuModel


class Observations(NamedTuple):
    """Readings `(N, U)` of `U` units on one trajectory, rad, with their noise steps and regressors `(N, p)`."""

    steps: NoiseSteps
    columns: np.ndarray
    readings: np.ndarray


def whitened(observations: Observations, model: ImuModel) -> Whitened:
    """The rows of all units together, of the steps that have a reading."""
    steps, columns = observations.steps, observations.columns
    rows = whiten(steps, np.concatenate([columns, observations.readings], axis=1))[steps.used]
    return Whitened(rows[:, : columns.shape[1]], rows[:, columns.shape[1] :], model.prior_rows())


def nees_band(runs, parameters, confidence=0.99):
    """Within which the mean of `runs` squared normalised errors, divided by the number of parameters, must lie."""
    tail = (1.0 - confidence) / 2.0
    degrees = runs * parameters
    return float(special.chdtri(degrees, 1.0 - tail) / degrees), float(special.chdtri(degrees, tail) / degrees)


def normalised_errors(found, truth):
    """`(U,)`: squared errors of each unit's parameters, normalised by the covariance (NEES); truth `(U, p)`.

    With s Sᵀ the covariance's root, `|S⁺(β̂ − β)|²`. Errors: `ValueError` where something is unobservable.
    """
    if found.known.hidden.shape[1]:
        raise ValueError("some parameters are not observable, so no error of theirs can be normalised")
    return np.sum(np.linalg.lstsq(found.known.spread, found.parameters - truth.T, rcond=None)[0] ** 2, axis=0)


def solve(white: Whitened) -> Estimate:
    """Least squares of `U` sensors with the same rows, data `(n, U)`, with minimal norm in what is not observable."""
    design = np.concatenate([white.rows, white.prior])
    data = np.concatenate([white.data, np.zeros((len(white.prior), *white.data.shape[1:]))])
    of = factored(design)
    beta = of.fit(data)
    squares = np.sum((data - design @ beta) ** 2, axis=0)
    return Estimate(beta, of.known, white.data - white.rows @ beta, squares, len(design) - len(of.singular))
