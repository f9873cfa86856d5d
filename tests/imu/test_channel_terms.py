"""What every channel may have, against generalised least squares with covariances that are written out.

Turn-on bias, the thermometer's error, instabilities of the scale factor, a sensitivity to dT/dt; readings on the move
with an error of their time, and held rates. One table axis, at constant temperature or on a plain ramp.
"""

from typing import Any

import numpy as np
import pytest
from path_scene import spec_of_table

from gradcal_jax.formulas import EARTH_RATE
from gradcal_jax.information.plan_information import imu_posterior
from gradcal_jax.information.prediction import predict
from gradcal_jax.model.build import build_imu

DEG = np.pi / 180.0
G = 9.80665
FLAT = {"degree": 0, "centre": "20 degC", "scale": "50 K"}
THERMOMETER = {"standard_deviation": "0.5 K", "scale_factor_slope": "30 ppm/K"}
BY_RATE = FLAT | {"centre": "0 deg/s", "scale": "100 deg/s"}
READ = {
    "standing": "read",
    "angle": {
        "reading_noise": "0.02 deg",
        "standstill_offset": "0.03 deg",
        "timing_error": "5 ms",
        "read_every": "4 s",
    },
}


def held(rates: list[str], points: str = "one run") -> dict[str, Any]:
    return {
        "method": "standard", "temperatures": ["20 degC", "30 degC"], "soak": "5 min", "integration": "100 s",
        "rates": rates, "points": points,
    }  # fmt: skip


def covariance(columns: np.ndarray, noise: np.ndarray, priors: np.ndarray) -> np.ndarray:
    information = columns.T @ np.linalg.solve(noise, columns) + np.diag(1.0 / priors**2)
    return np.sqrt(np.diag(np.linalg.inv(information)))


def of_parameters(spec, *names: str) -> np.ndarray:
    stds = {p.name: p.std for p in predict(spec).parameters}
    return np.array([stds[name] for name in names], dtype=float)


def markov(sigma: float, tau: float, times: np.ndarray) -> np.ndarray:
    """Covariances of the integrals of a Gauss–Markov process between neighbouring `times` `(n + 1,)`, each weighted by
    its own value: the analytic double integral."""
    low, high = times[:-1], times[1:]
    apart = lambda t: tau**2 * np.exp(-np.abs(t) / tau) + tau * np.abs(t)  # noqa: E731
    ends = (
        (high[:, None], low[None]),
        (low[:, None], high[None]),
        (low[:, None], low[None]),
        (high[:, None], high[None]),
    )
    signs = (1.0, 1.0, -1.0, -1.0)
    return sigma**2 * sum(sign * apart(a - b) for sign, (a, b) in zip(signs, ends, strict=True))


@pytest.mark.parametrize("points", ["one run", "independent"])
def test_held_rates_with_every_error_of_a_gyro(points):
    rates = [0.0, 60.0, -200.0]
    gyro = {
        "axes": ["z"], "angle_random_walk": "0.3 deg/sqrt(h)", "turn_on_bias": "40 deg/h",
        "temperature_error": THERMOMETER | {"bias_slope": "20 deg/h/K"},
        "scale_factor_instability": [{"standard_deviation": "50 ppm", "correlation_time": "200 s"}],
        "bias": {"temperature": FLAT, "prior": "100 deg/h"},
        "scale_factor": {"temperature": FLAT, "rate": BY_RATE, "prior": "5000 ppm"},
    }  # fmt: skip
    sensor = {"sample_clock_error": "20 ppm", "gyro": gyro}
    spec = spec_of_table(sensor, held([f"{r:g} deg/s" for r in rates], points), rate_accuracy="100 ppm", **READ)
    rate = np.tile(np.array(rates) * DEG, 2)
    lasting, hour = 100.0, DEG / 3600.0
    starts = np.concatenate([300.0 + lasting * np.arange(3), 900.0 + lasting * np.arange(3)])
    columns = lasting * np.column_stack([np.ones(6), rate])
    through = lasting * (20.0 * hour + 30e-6 * rate)
    instability = np.empty((6, 6))
    for i in range(6):
        for j in range(6):
            times = np.array([starts[i], starts[i] + lasting, starts[j], starts[j] + lasting])
            instability[i, j] = markov(50e-6, 200.0, times)[0, 2] * rate[i] * rate[j]
    common = 0.5**2 * np.outer(through, through) + 20e-6**2 * lasting**2 * np.outer(rate, rate) + instability
    noise = np.where(np.eye(6) + (points == "one run"), common, 0.0)
    noise += np.diag((0.3 * DEG / 60.0) ** 2 * lasting + (100e-6 * rate * lasting) ** 2)
    expected = covariance(columns, noise, np.array([np.hypot(100.0, 40.0) * hour, 5000e-6]))
    assert of_parameters(spec, "gyro_z.a0", "gyro_z.b00") == pytest.approx(expected, rel=1e-9)


def test_readings_on_the_move_rests_that_are_not_read_and_two_gyros():
    """Two gyros see one encoder: x is known to lie along the axis, z against it."""
    gyro = {
        "axes": ["x", "z"], "angle_random_walk": "0.3 deg/sqrt(h)",
        "bias": {"temperature": FLAT, "prior": "100 deg/h"},
        "scale_factor": {"temperature": FLAT, "rate": BY_RATE, "prior": "5000 ppm"},
    }  # fmt: skip
    moves = [
        {"rest": "9 s"},
        {
            "shape": "linear ramps",
            "turn": "300 deg",
            "peak_rate": "37.5 deg/s",
            "duration": "10 s",
            "read_every": "5 s",
        },
        {"rest": "8 s", "read_every": "none"},
        {"turn": "-300 deg", "shape": "linear ramps", "peak_rate": "60 deg/s", "duration": "6 s"},
        {"rest": "7 s", "read_every": "rest"},
    ]
    plan = {
        "method": "gradient",
        "temperature": ["20 degC", "21 degC"],
        "gradient": "1.5 K/min",
        "cycle": {"moves": moves},
    }
    inclined = {"x": "+x", "y": "+y", "z": "+z", "rotation": ["0 deg", "40 deg", "0 deg"]}
    # At the pole the Earth turns about the table's axis, too.
    spec = spec_of_table({"gyro": gyro}, plan, latitude="90 deg", mounting=inclined, **READ)
    built = build_imu(spec)
    # Readings: the first; at 4, 8, 9 s; on the move at 14 s, at its end at 19 s; the next move's end at 33 s, after a
    # rest that is not read; at the end of the last rest at 40 s.
    times = np.array([0.0, 4.0, 8.0, 9.0, 14.0, 19.0, 33.0, 40.0])
    angle = np.array([0.0, 0.0, 0.0, 0.0, 150.0, 300.0, 0.0, 0.0]) * DEG
    stand = [0, 0, 0, 0, None, 1, 2, 2]
    error = np.diag(np.full(8, (0.02 * DEG) ** 2))
    for i, a in enumerate(stand):
        for j, b in enumerate(stand):
            error[i, j] += (0.03 * DEG) ** 2 * (a is not None and a == b)
    error[4, 4] += (300.0 / 8.0 * DEG * 0.005) ** 2
    change = np.diff(np.eye(8), axis=0)
    along = np.array([-np.sin(40.0 * DEG), np.cos(40.0 * DEG)])
    steps = np.diff(times)
    noise = np.kron(np.outer(along, along), change @ error @ change.T)
    noise += np.kron(np.eye(2), np.diag((0.3 * DEG / 60.0) ** 2 * steps))
    columns = np.zeros((14, 4))
    for k in range(2):
        columns[7 * k : 7 * k + 7, 2 * k] = steps
        columns[7 * k : 7 * k + 7, 2 * k + 1] = along[k] * (np.diff(angle) + EARTH_RATE * steps)
    expected = covariance(columns, noise, np.tile([100.0 * DEG / 3600.0, 5000e-6], 2))
    names = [f"gyro_{axis}.{name}" for axis in "xz" for name in ("a0", "b00")]
    found = imu_posterior(built)
    order = [built.model.names().index(name) for name in names]
    assert found.deviations(np.eye(built.model.size)[order]) == pytest.approx(expected, rel=1e-9)
