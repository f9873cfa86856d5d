"""Terms that follow the temperature late, against masses that are stepped sample by sample: dT/dt by a lag, a second
thermometer, maps with lags of their own."""

from typing import Any

import numpy as np
import pytest

from gradcal_jax.api.imu_build import BuiltImu, build_imu
from gradcal_jax.files.spec import spec_of
from gradcal_jax.files.spec_sections import Spec

HOUR = np.pi / 180.0 / 3600.0
LINEAR = {"basis": "polynomial", "degree": 1, "centre": "20 degC", "scale": "30 K"}
BY_RATE = {"basis": "polynomial", "degree": 0, "centre": "0 deg/s", "scale": "100 deg/s"}
LAGS, SECOND_S, BIAS_S, SCALE_S = (70.0, 500.0), 120.0, 200.0, 90.0
PATH: dict[str, Any] = {
    "late_temperature_gradient": [
        {"time_constant": f"{lag:g} s", "prior": "3 deg/h/(K/min)"} for lag in LAGS
    ],
    "scale_factor_late_temperature_gradient": [{"time_constant": "500 s", "prior": "20 ppm/(K/min)"}],
    "thermometer_difference": {"prior": "5 deg/h/K"},
    "scale_factor_thermometer_difference": {"prior": "20 ppm/K"},
}  # fmt: skip
GYRO: dict[str, Any] = {
    "axes": ["z"], "angle_random_walk": "0.3 deg/sqrt(h)", **PATH,
    "bias": {"temperature": LINEAR, "prior": "100 deg/h", "lag": f"{BIAS_S} s"},
    "scale_factor": {"temperature": LINEAR, "rate": BY_RATE, "prior": "5000 ppm", "lag": f"{SCALE_S} s"},
}  # fmt: skip
FORCE: dict[str, Any] = {
    "axes": ["z"], "velocity_random_walk": "0.05 m/s/sqrt(h)",
    "bias": {"temperature": LINEAR, "prior": "2 mg", "lag": f"{BIAS_S} s"}, "scale_factor": {"prior": "500 ppm"},
    "late_temperature_gradient": [{"time_constant": "500 s", "prior": "50 ug/(K/min)"}],
    "thermometer_difference": {"prior": "100 ug/K"},
}  # fmt: skip
SENSOR = {"clock": "sensor", "second_thermometer": {"lag": f"{SECOND_S} s"}, "gyro": GYRO, "accelerometer": FORCE}
MOVES = [{"rest": "37 s"}, {"turn": "180 deg"}, {"rest": "53 s"}, {"turn": "-180 deg"}]
COURSE = [
    {"soak": "3 min", "at": "10 degC", "used": True},
    {"ramp_to": "36 degC", "rate": "2 K/min"},
    {"ramp_to": "30 degC", "rate": "3 K/min", "used": False},
    {"ramp_to": "33 degC", "rate": "1.5 K/min"},
    {"ramp_to": "12 degC", "rate": "2 K/min"},
]


def spec_with(sensor: dict[str, Any], programme: list[dict[str, Any]] | None = None, **more: Any) -> Spec:
    axis = {"name": "turn", "direction": [1.0, 0.0, 0.0], "max_rate": "400 deg/s", "max_acceleration": "400 deg/s^2"}
    angle = {"reading_noise": "5 arcsec", "standstill_offset": "5 arcsec", "read_every": "5 s"}
    mounting = {"x": "+z", "y": "+y", "z": "-x"}
    return spec_of({
        "format": "gradcal-spec/1", "sensor": sensor,
        "rig": {
            "site": {"latitude": "40 deg", "gravity": "9.8 m/s^2"},
            "table": {"axis": [axis | {"angle": angle}], "mounting": mounting, "standing": "held"},
            "chamber": {"range": ["-40 degC", "85 degC"], "max_heating": "5 K/min", "max_cooling": "5 K/min"},
        },
        "plan": {"method": "gradient", "programme": programme or COURSE, "cycle": {"moves": MOVES}},
        **more,
    })  # fmt: skip


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
    line, parts = built.motion.line, 800
    v = (np.arange(parts) + 0.5) / parts
    places = np.broadcast_to(v, (line.piece_count, parts))
    temperature, rate = line.temperature(places), line.rate(places)
    time, weight = line.start[:, None] + places * line.duration[:, None], line.duration[:, None] / parts
    begin, _ = line.ends()
    moments, course = np.append(line.start[0], time.ravel()), np.append(begin[0], temperature.ravel())

    def late(lag: float) -> np.ndarray:
        return lagging(moments, course, lag)[1:].reshape(temperature.shape)

    earth = np.zeros_like(rate)
    for g in built.body_nodes().groups:
        earth[g.pieces] = g.earth[g.kind, 0, 2][:, None]
    drive = earth - np.where(built.motion.axis[:, None] == 0, rate, 0.0)
    result = {f"late_temperature_gradient_{lag:g}s": (temperature - late(lag)) / lag for lag in LAGS}
    result["thermometer_difference"] = late(SECOND_S) - temperature
    result["a1"] = (late(BIAS_S) - 20.0) / 30.0
    if channel == "gyro_z":
        slow = (temperature - late(LAGS[1])) / LAGS[1]
        result[f"scale_factor_late_temperature_gradient_{LAGS[1]:g}s"] = slow * drive
        result["scale_factor_thermometer_difference"] = (late(SECOND_S) - temperature) * drive
        result["b01"] = (late(SCALE_S) - 20.0) / 30.0 * drive
    return {name: np.sum(of * weight, axis=1) for name, of in result.items()}


@pytest.mark.parametrize("lag", [None, "200 s", "120 s"])
def test_columns_are_the_integrals_of_the_definition(lag):
    """Also behind the chamber, with the same and with another time constant as that of the second thermometer."""
    built = build_imu(spec_with(SENSOR | ({} if lag is None else {"thermal_lag": lag})))
    compared = 0
    for c, columns in zip(built.model.channels, built.model.own_columns(built.body_nodes()), strict=True):
        names = c.model.names()
        own_terms = {name: of for name, of in dense_columns(built, c.name).items() if name in names}
        # Over moves accelerometers are not read.
        kept = ~built.motion.line.gap & ((built.motion.axis < 0) | (c.kind == "gyro"))
        for name, dense in own_terms.items():
            own = columns[kept, names.index(name)]
            size = np.max(np.abs(dense))
            assert size > 0.0, name
            assert own == pytest.approx(dense[kept], rel=1e-5, abs=1e-6 * size), name
            compared += 1
    assert compared == 10
