"""PX4's ULog. Read by pyulog (https://github.com/PX4/pyulog); what the topics are: PX4-Autopilot, `msg/`.

sensor_gyro         one sample (or the mean of a FIFO's) of a gyro, rotated to the vehicle's axes, otherwise as it
                    came from the sensor: rad/s, `temperature` in °C, `device_id`, `timestamp_sample` in µs
sensor_gyro_fifo    the FIFO itself: `samples` of x, y, z as counts times `scale`, `dt` µs apart, the last one at
                    `timestamp_sample`; no temperature
sensor_accel        the same of an accelerometer, m/s²; beside the gyro whose `device_id` it has, at its own stamps
sensor_combined     not the sensor: offsets, thermal calibration and the estimator's bias are taken off
vehicle_imu_status  `gyro_rate_hz`, at which sensor_gyro of `gyro_device_id` is published: the logger keeps every n-th

Without the last, rows of sensor_gyro below 90 Hz are single samples of a rate that the log does not tell: PX4 publishes
no gyro as slowly.
"""

from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any, Final

import numpy as np

from gradcal_jax.records.log import LogError, library
from gradcal_jax.records.vehicle.streams import GyroStream, interpolated

_RAW: Final = ("sensor_gyro", "sensor_gyro_fifo")
_FORCES: Final = "sensor_accel"
_SLOWEST_HZ: Final = 90.0
_THINNED: Final = 1.1
"""If the published rate exceeds the rate of the rows by more than this factor, rows are missing."""


def gyros(path: Path) -> Sequence[GyroStream]:
    """Every gyro by its device id, in the order of topics; the FIFO's samples where there are some."""
    reader: Any = library("pyulog", "pyulog")
    # Names alone are looked at of what is in sensor_combined.
    with path.open("rb") as opened:
        log = reader.ULog(opened, [*_RAW, _FORCES, "sensor_combined", "vehicle_imu_status"])
    topics = [data for data in log.data_list if data.name in _RAW]
    names = {data.name for data in log.data_list} - {_FORCES, "vehicle_imu_status"}
    start_s = float(log.start_timestamp) * 1e-6
    if not topics:
        only = "only sensor_combined, from which calibration and bias are already subtracted" if names else "no gyro"
        raise LogError(
            f"the log has {only}: make PX4 log sensor_gyro with the thermal calibration bit (4) of SDLOG_PROFILE"
        )
    published = _published(log.data_list)
    singles = {_device(data): _single(data, start_s, published) for data in topics if data.name == "sensor_gyro"}
    whole = {_device(data): _fifo(data, start_s) for data in topics if data.name == "sensor_gyro_fifo"}
    for name, stream in whole.items():
        thermometer = singles.get(name)
        if thermometer is not None and thermometer.temperature_c is not None:
            at = interpolated(stream.time_s, thermometer.time_s, thermometer.temperature_c)
            stream = GyroStream(name, stream.time_s, stream.rate_rad_per_s, at)
        singles[name] = stream
    forces = {_device(data): data for data in log.data_list if data.name == _FORCES}
    return [_with_forces(s, forces[s.name], start_s) if s.name in forces else s for s in singles.values()]


def _with_forces(stream: GyroStream, data: Any, start_s: float) -> GyroStream:
    """A gyro with the accelerometers of its chip, interpolated to its stamps where they have others."""
    time = _stamps(data) * 1e-6 - start_s
    each = [interpolated(stream.time_s, time, data.data[axis].astype(np.float64)) for axis in "xyz"]
    return replace(stream, force_m_per_s2=np.stack(each, axis=1))


def _device(data: Any) -> str:
    ids = np.unique(data.data["device_id"])
    if len(ids) != 1:
        raise LogError(f"{data.name} {data.multi_id} has data of several devices: {', '.join(map(str, ids))}")
    return str(int(ids[0]))


def _stamps(data: Any) -> Any:
    """Of the samples, µs; of the message, where the driver gave none."""
    stamps = data.data.get("timestamp_sample", data.data["timestamp"])
    return np.asarray(np.where(stamps == 0, data.data["timestamp"], stamps), np.int64)


def _published(topics: Any) -> dict[str, float]:
    """By device id the rate at which it is published, Hz, by the last status."""
    rates = dict[str, float]()
    for data in topics:
        if data.name == "vehicle_imu_status" and {"gyro_device_id", "gyro_rate_hz"} <= set(data.data):
            known = data.data["gyro_rate_hz"] > 0.0
            for device, rate in zip(data.data["gyro_device_id"][known], data.data["gyro_rate_hz"][known], strict=True):
                rates[str(int(device))] = float(rate)
    return rates


def _sensor_rate(device: str, time_s: Any, published: dict[str, float]) -> str | None:
    own = (len(time_s) - 1) / float(time_s[-1] - time_s[0]) if len(time_s) > 2 and time_s[-1] > time_s[0] else np.inf
    if device in published:
        return f"{published[device]:.6g} Hz" if published[device] > _THINNED * own else None
    return "unknown" if own < _SLOWEST_HZ else None


def _single(data: Any, start_s: float, published: dict[str, float]) -> GyroStream:
    rate = np.stack([data.data[axis].astype(np.float64) for axis in "xyz"], axis=1)
    temperature = data.data["temperature"].astype(np.float64) if "temperature" in data.data else None
    if temperature is not None and not np.isfinite(temperature).any():
        temperature = None
    device, time = _device(data), _stamps(data) * 1e-6 - start_s
    return GyroStream(device, time, rate, temperature, sensor_rate=_sensor_rate(device, time, published))


def _fifo(data: Any, start_s: float) -> GyroStream:
    fields = data.data
    counts = fields["samples"].astype(np.int64)
    size = sum(1 for name in fields if name.startswith("x["))
    inside = np.arange(size) < counts[:, None]
    rate = np.stack(
        [
            (np.stack([fields[f"{axis}[{k}]"] for k in range(size)], axis=1) * fields["scale"][:, None].astype(float))[
                inside
            ]
            for axis in "xyz"
        ],
        axis=1,
    )
    before = (np.arange(size) - counts[:, None] + 1) * fields["dt"].astype(np.float64)[:, None]
    time = (_stamps(data)[:, None] + before)[inside] * 1e-6 - start_s
    return GyroStream(_device(data), time, rate, None)
