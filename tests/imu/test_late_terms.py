"""Terms that follow the temperature late, against masses that are stepped sample by sample: a second thermometer, maps
with lags of their own."""

from dataclasses import replace
from functools import lru_cache
from typing import Any

import numpy as np
import pytest
from loop_scene import recorded
from loop_scene import spec_of as spec_of_loop
from path_scene import LEVEL, MOVES, fine, spec_of_table

import gradcal_jax as gj
from gradcal_jax.calibration import read_calibration, write_calibration
from gradcal_jax.calibration.correction import apply
from gradcal_jax.calibration.exports import export
from gradcal_jax.estimation.estimate import SensorEstimate, estimate_sensors
from gradcal_jax.hardware.simulate.draws import draw_truth
from gradcal_jax.hardware.simulate.imu import ImuTruth
from gradcal_jax.information.imu_residual import quantity_of
from gradcal_jax.model.build import BuiltImu, build_imu
from gradcal_jax.records.log import Log, LogError
from gradcal_jax.spec.spec_sections import Spec

HOUR = np.pi / 180.0 / 3600.0
LINEAR = {"degree": 1, "centre": "20 degC", "scale": "30 K"}
BY_RATE = {"degree": 0, "centre": "0 deg/s", "scale": "100 deg/s"}
SECOND_S = 120.0
PATH: dict[str, Any] = {
    "term": [{"name": "thermometer_difference", "factors": ["T2 - T"], "prior": "5 deg/h/K"}],
}  # fmt: skip
GYRO: dict[str, Any] = {
    "axes": ["z"], "angle_random_walk": "0.3 deg/sqrt(h)", **PATH,
    "bias": {"temperature": LINEAR, "prior": "100 deg/h"},
    "scale_factor": {"temperature": LINEAR, "rate": BY_RATE, "prior": "5000 ppm"},
}  # fmt: skip
FORCE: dict[str, Any] = {
    "axes": ["z"], "velocity_random_walk": "0.05 m/s/sqrt(h)",
    "bias": {"temperature": LINEAR, "prior": "2 mg"}, "scale_factor": {"prior": "500 ppm"},
    "term": [{"name": "thermometer_difference", "factors": ["T2 - T"], "prior": "100 ug/K"}],
}  # fmt: skip
SENSOR = {"clock": "sensor", "second_thermometer": {"lag": f"{SECOND_S} s"}, "gyro": GYRO, "accelerometer": FORCE}
COURSE = [
    {"soak": "3 min", "at": "10 degC", "used": True},
    {"ramp_to": "36 degC", "rate": "2 K/min"},
    {"ramp_to": "30 degC", "rate": "3 K/min", "used": False},
    {"ramp_to": "33 degC", "rate": "1.5 K/min"},
    {"ramp_to": "12 degC", "rate": "2 K/min"},
]


def spec_with(sensor: dict[str, Any], requirement: tuple[dict[str, Any], ...] = ()) -> Spec:
    course = {"method": "gradient", "programme": COURSE, "cycle": {"moves": MOVES}}
    return spec_of_table(sensor, course, requirement, standing="held", **LEVEL)


def lagging(time: np.ndarray, temperature: np.ndarray, lag: float) -> np.ndarray:
    """A first-order lag from sample to sample, of a temperature that is linear in between."""
    result = np.empty_like(temperature)
    now = result[0] = temperature[0]
    for k in range(1, len(time)):
        step = max(time[k] - time[k - 1], 1e-12)
        slope, keep = (temperature[k] - temperature[k - 1]) / step, np.exp(-step / lag)
        # The steady state is behind by lag·slope.
        now = temperature[k] - lag * slope + (now - temperature[k - 1] + lag * slope) * keep
        result[k] = now
    return result


def dense_columns(built: BuiltImu, channel: str) -> dict[str, np.ndarray]:
    """Columns of a channel over each piece, by sums over fine steps of the motion."""
    steps, (begin, _) = fine(built, 800), built.motion.line.ends()
    temperature, drive = steps.temperature, steps.rate
    moments = np.append(built.motion.line.start[0], steps.time.ravel())
    course = np.append(begin[0], temperature.ravel())

    def late(lag: float) -> np.ndarray:
        return lagging(moments, course, lag)[1:].reshape(temperature.shape)

    result = {"thermometer_difference": late(SECOND_S) - temperature}
    if channel == "gyro_z":
        result["b01"] = (temperature - 20.0) / 30.0 * drive
    return {name: np.sum(of * steps.weight, axis=1) for name, of in result.items()}


@pytest.mark.parametrize("lag", [None, "200 s", "120 s"])
def test_columns_are_the_integrals_of_the_definition(lag):
    """Also behind the chamber, with the same and with another time constant as that of the second thermometer."""
    built = build_imu(spec_with(SENSOR | ({} if lag is None else {"thermal_lag": lag})))
    compared = 0
    for c, columns in zip(built.model.channels, built.model.own_columns(built.body_nodes()), strict=True):
        names = c.names()
        own_terms = {name: of for name, of in dense_columns(built, c.name).items() if name in names}
        # Over moves accelerometers are not read.
        kept = ~built.motion.line.gap & ((built.motion.axis < 0) | (c.kind == "gyro"))
        for name, dense in own_terms.items():
            own = columns[kept, names.index(name)]
            size = np.max(np.abs(dense))
            assert size > 0.0, name
            assert own == pytest.approx(dense[kept], rel=1e-5, abs=1e-6 * size), name
            compared += 1
    assert compared == 3


def test_a_requirement_counts_the_slope_of_the_service():
    """At a constant dT/dt the function is minus the lag of the second thermometer times it."""
    sensor = {key: SENSOR[key] for key in ("clock", "second_thermometer", "gyro")}
    of = {"name": "b", "quantity": "gyro_bias", "temperature": ["15 degC", "30 degC"], "branch": "heating", "grid": [2]}
    built = build_imu(spec_with(sensor, requirement=(of | {"slope": ["1 K/min", "1 K/min"]},)))
    (element,) = quantity_of(built, built.spec.requirement[0]).elements
    names = np.array(built.model.channels[0].names())[element.where]
    own = dict(zip(names, element.rows[0, 0], strict=True))
    assert own["thermometer_difference"] == pytest.approx(-SECOND_S / 60.0)


FOLLOWED = {
    "sensor.second_thermometer": {"lag": "4 min"},
    "sensor.gyro.hysteresis": [],
    "sensor.gyro.term": [{"name": "thermometer_difference", "factors": ["T2 - T"], "prior": "4 deg/h/K"}],
}


@lru_cache
def followed(number: int) -> tuple[SensorEstimate, ImuTruth, Log]:
    """An IMU at rest on a chamber that goes up and down, with masses that follow late, and its estimate."""
    spec = gj.changed(spec_of_loop(ways=2), FOLLOWED)
    truth = draw_truth(spec, 50, number)
    log = recorded(truth, spec, ways=2, seed=200 + number)
    (report,) = estimate_sensors(spec, [log])
    return report, truth, log


def test_estimates_have_the_drawn_masses_of_simulated_sensors():
    """The second thermometer's lag is another than the plan expects: the log has its readings."""
    standardised = []
    for number in range(6):
        report, truth, _ = followed(number)
        assert abs(truth.second_lag_s - 240.0) > 1.0
        for one in report.calibration.path:
            true = truth.names[f"{one.channel}.{one.name}"]
            standardised.append((one.value - true) / one.standard_deviation)
    standardised = np.array(standardised).reshape(6, -1)
    # Three gyros, of each dT/dt and the difference.
    assert standardised.shape[1] == 6
    assert 0.55 < np.mean(standardised**2) < 1.6
    assert sum(bool(followed(number)[0].calibration.contradicted) for number in range(6)) <= 1


def test_a_calibration_takes_off_what_follows_late_and_names_the_rest(tmp_path):
    report, _, log = followed(1)
    write_calibration(report.calibration, tmp_path / "calibration.toml")
    calibration = read_calibration(tmp_path / "calibration.toml")
    assert calibration.path == report.calibration.path
    kept = [f"{one.channel}.{one.name}" for one in calibration.path if one.second_thermometer]
    assert len(kept) == 3
    assert apply(calibration, log).left_in == tuple(kept)
    with pytest.raises(LogError, match="no second temperature"):
        estimate_sensors(report.built.spec, [replace(log, second_temperature_c=None)])
    done = export(calibration, "px4")
    assert sum(note.endswith("is lost") for note in done.notes) == len(calibration.path)
