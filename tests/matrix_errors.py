"""The errors of an IMU's calibration in its own covariance."""

from collections.abc import Sequence

import numpy as np


def nees_of(names: Sequence[str], values: np.ndarray, truth: np.ndarray, covariance: np.ndarray) -> float:
    """The normalised square of the errors of coefficients (`gyro_x.m_y`, SI) by a covariance `(n, n)`.

    A plan may tell the element (1 + M) m of a sensor's matrix far better than M and m: its error, no sum of theirs
    where both are large, is taken in the place of that of m.
    """
    errors, slopes = values - truth, np.eye(len(names))
    for k, name in enumerate(names):
        channel, _, symbol = name.partition(".")
        constant = next((f"{channel}.{s}" for s in ("b00", "s0", "s") if f"{channel}.{s}" in names), None)
        if symbol.startswith("m_") and constant is not None:
            of = names.index(constant)
            errors[k] = (1.0 + values[of]) * values[k] - (1.0 + truth[of]) * truth[k]
            slopes[k, k], slopes[k, of] = 1.0 + values[of], values[k]
    covariance = slopes @ covariance @ slopes.T
    # Scaled, since coefficients have many units.
    size = np.sqrt(np.diag(covariance))
    return float((errors / size) @ np.linalg.solve(covariance / np.outer(size, size), errors / size))
