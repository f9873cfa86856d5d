"""Simulated lots: IMUs whose gyro bias is read at many temperatures, and a polynomial of each by least squares.

A map is what springs and glue do to a bias, drawn as sums of powers of the temperature; nothing here is of the package
but the class of the calibration file. Numbers are deg/h and K about 20 °C over 50 K.
"""

import numpy as np

from gradcal_jax.calibration import CalibratedChannel, CalibratedTerm, Calibration, Covariance

HOUR = np.pi / 180.0 / 3600.0
CENTRE, SCALE = 20.0, 50.0
MEAN = np.array([12.0, -8.0, 5.0, 3.0])
# Bimetal, glass transition of a glue, and the drive's frequency, as powers.
SHAPES = np.array([[1.0, 6.0, -2.0, 0.5], [4.0, -1.0, 3.0, -2.0], [0.5, 1.0, 2.0, 3.5]])


def drawn_maps(rng: np.random.Generator, count: int, kind: str) -> np.ndarray:
    """`(count, 4)`: true powers of IMUs that vary in "one", "three" or "no" repeating shapes."""
    if kind == "no":
        # Every IMU for itself.
        return MEAN + rng.standard_normal((count, 4)) * np.array([9.0, 8.0, 7.0, 6.0])
    shapes = SHAPES[: {"alike": 0, "one": 1, "three": 3}[kind]]
    return MEAN + rng.standard_normal((count, len(shapes))) @ shapes


def spread_at(kind: str, powers: np.ndarray) -> np.ndarray:
    """The true standard deviation of the type where powers of the temperature are `(g, 4)`."""
    if kind == "no":
        return np.sqrt((powers**2) @ np.array([9.0, 8.0, 7.0, 6.0]) ** 2)
    return np.sqrt(np.sum((powers @ SHAPES[: {"alike": 0, "one": 1, "three": 3}[kind]].T) ** 2, axis=1))


def read_maps(rng: np.random.Generator, maps: np.ndarray, noise: float = 1.0) -> tuple[np.ndarray, np.ndarray]:
    """Least-squares powers `(n, 4)` and covariances `(n, 4, 4)` of readings with `noise` of 12 to 60 temperatures."""
    values, covariances = [], []
    for powers in maps:
        at = rng.uniform(-1.0, 1.0, rng.integers(12, 60))
        design = np.stack([at**k for k in range(4)], axis=1)
        readings = design @ powers + noise * rng.standard_normal(len(at))
        values.append(np.linalg.lstsq(design, readings, rcond=None)[0])
        covariances.append(noise**2 * np.linalg.inv(design.T @ design))
    return np.array(values), np.array(covariances)


def calibrations(values: np.ndarray, covariances: np.ndarray, **others) -> list[Calibration]:
    """A calibration of a gyro for each of the powers (deg/h)."""
    basis = {"basis": "polynomial", "degree": values.shape[1] - 1, "scale": f"{SCALE} K"}
    made = []
    for k, (value, covariance) in enumerate(zip(values * HOUR, covariances * HOUR**2, strict=True)):
        names = [f"a{j}" for j in range(len(value))]
        bias = {"name": "bias", "unit": "rad/s", "temperature": basis}
        term = CalibratedTerm(**bias, coefficients=dict(zip(names, value.tolist(), strict=True)))
        box = {"valid_temperature": ("-30 degC", "70 degC"), "valid_rate": ("0 deg/s", "0 deg/s")}
        channel = CalibratedChannel(kind="gyro", axis="x", term=(term,), **box)
        known = Covariance(names=tuple(f"gyro_x.{n}" for n in names), matrix=tuple(map(tuple, covariance.tolist())))
        fields = {"format": "gradcal-calibration/3", "serial_number": f"no. {k + 1}", "simulated": True}
        fields |= {"frame": "case", "order": "subtract", "channel": (channel,), "covariance": known}
        made.append(Calibration(**(fields | others)))
    return made
