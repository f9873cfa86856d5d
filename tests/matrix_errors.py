"""The errors of an IMU's calibration in its own covariance, and what the data say of the truth."""

import re
from collections.abc import Sequence

import numpy as np

from gradcal_jax.api.fit_of_log import Fit
from gradcal_jax.information import segments_of, whiten

# Steps of Gauss and Newton for what is no part of a calibration: the second one changes χ² by 1e-3.
_STEPS = 3


def nees_of(names: Sequence[str], values: np.ndarray, truth: np.ndarray, covariance: np.ndarray) -> float:
    """The normalised square of the errors of coefficients (`gyro_x.m_y`, SI) by a covariance `(n, n)`.

    A plan may tell the element (1 + M) m of a sensor's matrix, a polynomial in temperature, far better than M and m:
    the errors of its coefficients, no sums of theirs where both are large, are taken in the place of those of m.
    """
    errors, slopes = values - truth, np.eye(len(names))
    where = {name: k for k, name in enumerate(names)}
    for k, name in enumerate(names):
        channel, _, symbol = name.partition(".")
        if (of := re.fullmatch(r"(m_[xyz])(\d?)", symbol)) is None:
            continue
        degree = int(of[2] or 0)
        for lower in range(degree + 1):
            known = (f"{channel}.{s}" for s in (f"b{degree - lower}0", f"s{degree - lower}", "s" * (lower == degree)))
            scale = next((where[s] for s in known if s in where), None)
            m = where.get(f"{channel}.{of[1]}{lower if of[2] else ''}")
            if scale is not None and m is not None:
                errors[k] += values[scale] * values[m] - truth[scale] * truth[m]
                slopes[k, m] += values[scale]
                slopes[k, scale] += values[m]
    covariance = slopes @ covariance @ slopes.T
    # Scaled, since coefficients have many units.
    size = np.sqrt(np.diag(covariance))
    return float((errors / size) @ np.linalg.solve(covariance / np.outer(size, size), errors / size))


def squares_above(fit: Fit, truth: dict[str, float]) -> float:
    """The weighted squares of data and priors at the true coefficients (by name, SI) above those of the estimate:
    χ² of as many degrees of freedom as there are coefficients. It says nothing of the estimate's covariance.

    What is no part of a calibration (the table's own errors) is fitted anew at the truth. Where it is poorly known its
    products with misalignments exceed what the data tell, so that the errors in a linear covariance are no χ².
    """
    readings, estimate = fit.readings, fit.solution.parameters
    model = readings.model
    priors, calibrated = np.asarray(model.prior_rows()), model.calibrated
    steps, _ = readings.linear(estimate)
    used = segments_of(readings.done.motion, model).used
    of_steps = readings.by_steps(np.asarray(used))

    def white(rows: np.ndarray) -> np.ndarray:
        return np.asarray(whiten(steps, np.where(of_steps[:, None], rows, 0.0)))[of_steps]

    def left(parameters: np.ndarray) -> np.ndarray:
        apart = readings.by_steps(np.where(used, readings.observed - readings.expected(parameters), 0.0))
        return np.concatenate([white(apart[:, None])[:, 0], -priors @ parameters])

    values = np.asarray(model.to_reported) @ estimate
    values[:calibrated] = [truth[name] for name in model.names()[:calibrated]]
    here = np.linalg.solve(np.asarray(model.to_reported), values)
    for _ in range(_STEPS if calibrated < model.size else 0):
        columns = np.concatenate([white(readings.linear(here)[1]), priors])[:, calibrated:]
        size = np.sqrt(np.sum(columns**2, axis=0))
        here[calibrated:] += np.linalg.lstsq(columns / size, left(here), rcond=None)[0] / size
    return float(np.sum(left(here) ** 2) - np.sum(left(estimate) ** 2))
