"""A recorded thermal cycle of a MEMS gyro triad at rest, −17 … 74 °C, as an IMU: heating and cooling differ.

The record (`shared/data`, see `tests/identify/test_recorded_thermal_cycle.py` for its units) begins with a cooling leg
from 52 °C, goes up to 74 °C, and cools again. The drift is that which the first two legs show.
"""

import os
from pathlib import Path

import numpy as np
import pytest
from loop_scene import spec_of

from gradcal_jax.estimation.estimate import estimate_sensors
from gradcal_jax.records.log import Log
from gradcal_jax.spec.changes import changed
from gradcal_jax.spec.spec_sections import Spec

FOLDER = Path(os.environ.get("GRADCAL_DATA", Path(__file__).parents[3] / "shared" / "data"))
RECORD = FOLDER / "tofupilot_imu_thermal_cycle.npz"
pytestmark = pytest.mark.skipif(not RECORD.exists(), reason="the recorded data are not here: set GRADCAL_DATA")


def log_until_warmest() -> Log:
    """The rows up to the warmest temperature as a log of two standstills; the row between them is lost."""
    with np.load(RECORD) as data:
        stamps, temperature, rate = (data[key][1:] for key in ("timestamp_raw", "temperature_C", "gyro"))
    end = int(temperature.argmax())
    time, kept = (stamps[:end] - stamps[0]) * 1e-6, rate[:end].astype(float)
    kept[end // 2] = np.nan
    standstill, at = (np.arange(end) >= end // 2).astype(int), temperature[:end].astype(float)[None]
    return Log(time, kept[None], ("unit",), ("x", "y", "z"), at, ("turn",), np.zeros((end, 1)), None, standstill)


def without_plays() -> Spec:
    cubic = {"degree": 3, "centre": "30 degC", "scale": "50 K"}
    of = {"name": "bias", "quantity": "gyro_bias", "temperature": ["-15 degC", "72 degC"], "branch": "both"}
    return changed(
        spec_of(ways=2, plays=False),
        {
            "sensor.gyro.angle_random_walk": "0.6 deg/sqrt(h)",
            "sensor.gyro.drift": [{"standard_deviation": "250 deg/h", "correlation_time": "20 min"}],
            "sensor.gyro.bias_temperature_gradient": "0 deg/h/(K/min)",
            "sensor.gyro.bias": {"temperature": cubic, "prior": "5000 deg/h"},
            "rig.table.axis[0].angle.reading_noise": "1 arcsec",
            "rig.chamber.range": ["-40 degC", "90 degC"],
            "requirement": [of | {"target": "800 deg/h", "coverage": 2.0}],
            "plan.programme": [
                {"soak": "1 min", "at": "52 degC"},
                {"ramp_to": "-17 degC", "rate": "3 K/min"},
                {"ramp_to": "74 degC", "rate": "3 K/min"},
            ],
        },
    )


def test_without_the_term_heating_and_cooling_disagree():
    (report,) = estimate_sensors(without_plays(), [log_until_warmest()])
    assert "heating against cooling" in report.calibration.contradicted
    (row,) = report.requirements
    assert row.verdict == "not valid"
    assert any(m.startswith("heating and cooling disagree") for m in report.messages)
