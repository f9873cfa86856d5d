"""A recorded thermal cycle of a MEMS gyro triad at rest, −17 … 74 °C, as an IMU: heating and cooling differ.

The record (`shared/data`, see `tests/identify/test_recorded_thermal_cycle.py` for its units) begins with a cooling leg
from 52 °C, goes up to 74 °C, and cools again. The drift is that which the first two legs show. Widths of the plays are
two a decade. The law matters: 2, 5, 10, 20 and 40 K predict x better (rms 150 deg/h, not 800) and z worse (490, not
270, half of its bins); a single play of 20 K fails in x and z. Without plays x is off by 2100 deg/h rms.
"""

import os
from functools import lru_cache
from pathlib import Path

import numpy as np
import pytest

from gradcal_jax.estimation.estimate import SensorEstimate, estimate_sensors
from gradcal_jax.records.log import Log
from gradcal_jax.spec.spec import spec_of
from gradcal_jax.spec.spec_sections import Spec

FOLDER = Path(os.environ.get("GRADCAL_DATA", Path(__file__).parents[3] / "shared" / "data"))
RECORD = FOLDER / "tofupilot_imu_thermal_cycle.npz"
pytestmark = pytest.mark.skipif(not RECORD.exists(), reason="the recorded data are not here: set GRADCAL_DATA")

HOUR = np.pi / 180.0 / 3600.0
WIDTHS = (3, 10, 30)
DRIFT, EVERY_S = 250.0, 30.0


@lru_cache
def recorded() -> tuple[np.ndarray, np.ndarray, np.ndarray, tuple[int, int]]:
    """Times (s), temperatures (°C), rates (rad/s), and the rows of the coldest and of the warmest temperature."""
    with np.load(RECORD) as data:
        stamps, temperature, rate = (data[key][1:] for key in ("timestamp_raw", "temperature_C", "gyro"))
    time = (stamps - stamps[0]) * 1e-6
    temperature = temperature.astype(float)
    return time, temperature, rate.astype(float), (int(temperature.argmin()), int(temperature.argmax()))


def log_of(first: int, end: int) -> Log:
    """The rows as a log of two standstills; the row between them is lost."""
    time, temperature, rate, _ = recorded()
    half, kept = (end - first) // 2, rate[first:end].copy()
    kept[half] = np.nan
    standstill = (np.arange(end - first) >= half).astype(int)
    at = temperature[first:end][None]
    table = ("turn",), np.zeros((end - first, 1))
    return Log(time[first:end] - time[first], kept[None], ("unit",), ("x", "y", "z"), at, *table, None, standstill)


def spec_with(*, plays: bool, branch: str = "both") -> Spec:
    plain = {"degree": 3, "centre": "30 degC", "scale": "50 K"}
    gyro = {
        "angle_random_walk": "0.6 deg/sqrt(h)", "rate_random_walk": "0 deg/h/sqrt(h)", "turn_on_bias": "0 deg/h",
        "drift": [{"standard_deviation": f"{DRIFT} deg/h", "correlation_time": "20 min"}],
        "temperature_error": {"standard_deviation": "0 K"}, "bias_temperature_gradient": "0 deg/h/(K/min)",
        "bias": {"temperature": plain, "prior": "5000 deg/h"},
    }  # fmt: skip
    if plays:
        gyro["hysteresis"] = [{"width": f"{w} K", "prior": "60 deg/h/K"} for w in WIDTHS]
    axis = {
        "name": "turn", "direction": [0, 0, 1], "max_rate": "100 deg/s", "max_acceleration": "100 deg/s^2",
        "angle": {
            "reading_noise": "1 arcsec", "standstill_offset": "0 arcsec", "read_every": f"{EVERY_S} s", "harmonics": []
        },
    }  # fmt: skip
    return spec_of({
        "format": "gradcal-spec/1",
        "sensor": {"temperature_offset": "0 K", "temperature_lag": "0 s", "gyro": gyro},
        "rig": {
            "site": {"latitude": "45 deg", "gravity": "9.8 m/s^2"},
            "table": {"axis": [axis], "standing": "read", "tilt": "0 deg", "azimuth": "0 deg"},
            "chamber": {"range": ["-40 degC", "90 degC"], "max_heating": "10 K/min", "max_cooling": "10 K/min"},
        },
        "requirement": [
            {
                "name": "bias", "quantity": "gyro_bias", "temperature": ["-15 degC", "72 degC"], "branch": branch,
                "target": "800 deg/h", "coverage": 2.0,
            }
        ],
        "plan": {
            "method": "gradient",
            "programme": [
                {"soak": "1 min", "at": "52 degC"},
                {"ramp_to": "-17 degC", "rate": "3 K/min"},
                {"ramp_to": "74 degC", "rate": "3 K/min"},
            ],
        },
    })  # fmt: skip


@lru_cache
def estimated(first: int, end: int, *, plays: bool) -> SensorEstimate:
    (report,) = estimate_sensors(spec_with(plays=plays), [log_of(first, end)])
    return report


def test_without_the_term_heating_and_cooling_disagree():
    _, _, _, (_, warmest) = recorded()
    report = estimated(0, warmest, plays=False)
    assert "heating against cooling" in report.calibration.contradicted
    (row,) = report.requirements
    assert row.verdict == "not valid"
    assert any(m.startswith("heating and cooling disagree") for m in report.messages)
