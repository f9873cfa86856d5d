"""The log of a gyro axis is estimated as that of an IMU of one gyro, to the same calibration as before.

`axis_estimator.json` has what an estimator of another construction gave: whitened readings of one axis, with sums of
samples as regressors, and maps and true rates in turn. Today it is Gauss-Newton through the finite geometry of a table.
"""

import json
import sys
from pathlib import Path

import numpy as np
import pytest

sys.path.append(str(Path(__file__).parents[1] / "estimation"))

from logs_zoo import GRADIENT, STANDARD, spec_of
from simulated_log import simulate_log

from gradcal_jax.estimation.estimate import estimate_log, estimate_sensors
from gradcal_jax.spec.changes import changed
from gradcal_jax.spec.spec_sections import Spec

STATIC = GRADIENT[: GRADIENT.index("[plan.cycle]")].replace('read_every = "1 s"', 'read_every = "2 s"')
BEFORE = json.loads((Path(__file__).parent / "axis_estimator.json").read_text(encoding="utf-8"))
CASES = {
    "moves without rests": GRADIENT,
    "unread rests": GRADIENT.replace('"5 s", read_every = "1 s"', '"5 s", read_every = "none"'),
    "standing": STATIC[: STATIC.index("[sensor.gyro.scale_factor]")] + STATIC[STATIC.index("[rig.table]") :],
    "standard": STANDARD,
}


def as_imu(spec: Spec) -> Spec:
    return spec


def text_of(name: str) -> str:
    text = CASES[name]
    if name == "standing":
        text = text.replace('[[requirement]]\nname = "map"', '[[requirement]]\nname = "other"')
        text = text.replace('quantity = "gyro_scale_factor"', 'quantity = "gyro_bias"').replace(
            'target = "2000 ppm"\n', ""
        )
        text = text.replace('rate = ["-300 deg/s", "300 deg/s"]\n', "")
    return text


@pytest.mark.parametrize("name", CASES)
def test_a_log_gives_the_calibration_that_the_estimator_of_an_axis_gave(name: str) -> None:
    spec, was = spec_of(text_of(name)), BEFORE[name]
    made = simulate_log(
        spec, units=1, sample_rate_hz=50.0, seed=3, readings=name != "standing" and "standard" not in name
    )
    (calibration,) = estimate_log(spec, [made.log]).calibrations
    std = dict(zip(calibration.covariance.names, np.sqrt(np.diag(calibration.covariance.matrix)), strict=True))
    assert set(std) == set(was["std"])
    values = calibration.values()
    for key, own in was["std"].items():
        assert std[key] == pytest.approx(own, rel=0.02)
        assert abs(values[key] - was["values"][key]) < 0.1 * own, key
    for (value, verdict), result in zip(was["results"], calibration.result, strict=True):
        assert result.value == pytest.approx(value, rel=0.02)
        assert result.verdict == verdict


@pytest.mark.long
@pytest.mark.parametrize("lag_s", [0.0, 40.0])
def test_the_lag_of_an_imus_maps_is_found(lag_s: float) -> None:
    both = 'temperature = ["0 degC", "40 degC"]\ngradient = "4 K/min"'
    legs = '{ soak = "1 min", at = "0 degC" }, { ramp_to = "40 degC", rate = "4 K/min" }'
    programme = f'programme = [{legs}, {{ ramp_to = "0 degC", rate = "4 K/min" }}]'
    spec = spec_of(GRADIENT.replace(both, programme))
    behind = changed(spec, {"sensor.thermal_lag": f"{lag_s} s"}) if lag_s else spec
    log = simulate_log(behind, sample_rate_hz=20.0, seed=8).log
    if lag_s:
        # What the log has is the air's temperature.
        times = np.array([s.start for s in spec.schedule.segments] + [spec.schedule.segments[-1].end])
        air = [s.temperature_start for s in spec.schedule.segments] + [spec.schedule.segments[-1].temperature_end]
        log.temperature_c[:] = np.interp(log.time_s, times, air)
    (report,) = estimate_sensors(as_imu(spec), [log])
    lag = report.calibration.channel[0].thermal_lag
    assert float(lag or 0.0) == pytest.approx(lag_s, abs=3.0)
    assert any("lag behind the measured temperature by" in m for m in report.messages) == (lag_s > 0.0)


def test_points_that_a_log_lacks_are_named() -> None:
    made = simulate_log(spec_of(STANDARD), sample_rate_hz=20.0, seed=4)
    longer = as_imu(spec_of(STANDARD.replace('"40 degC"]\nsoak', '"40 degC", "60 degC"]\nsoak')))
    (report,) = estimate_sensors(longer, [made.log])
    assert any("5 of the plan's points are not in the log, the first at 60 degC" in m for m in report.messages)
