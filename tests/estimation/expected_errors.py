"""What errors of an estimate must be where the model is true, and readings on a plan's own trajectory."""

import numpy as np
from scipy import special

from gradcal_jax.estimation import Observations
from gradcal_jax.information import at_readings, noise_steps


def nees_band(runs, parameters, confidence=0.99):
    """Within which the mean of `runs` squared normalised errors, divided by the number of parameters, must lie."""
    tail = (1.0 - confidence) / 2.0
    degrees = runs * parameters
    return float(special.chdtri(degrees, 1.0 - tail) / degrees), float(special.chdtri(degrees, tail) / degrees)


def normalised_errors(found, truth):
    """`(U,)`: squared errors of each unit's parameters, normalised by its covariance (NEES); truth `(U, p)` or `(p,)`.

    With s Sᵀ the covariance's root, `|S⁺(β̂ − β)|²`. Errors: `ValueError` where something is unobservable.
    """
    result = np.empty(len(found.parameters))
    for unit, known in enumerate(found.known):
        if known.hidden.shape[1]:
            raise ValueError("some parameters are not observable, so no error of theirs can be normalised")
        error = found.parameters[unit] - (truth if truth.ndim == 1 else truth[unit])
        white = np.linalg.lstsq(known.spread, error, rcond=None)[0]
        result[unit] = float(white @ white)
    return result


def on_trajectory(line, model, readings):
    """Readings `(N, U)` taken on a plan's own trajectory: the regressors and steps are those of its prediction."""
    turned = line.turned()
    return Observations(
        noise_steps(line, model),
        at_readings(line, model),
        readings,
        line.start + line.duration,
        line.temperature(np.full((line.piece_count, 1), 0.5))[:, 0],
        np.divide(turned, line.duration, out=np.zeros_like(turned), where=line.duration > 0),
    )
