"""The gyros of a vehicle's log, each with its own stamps and thermometer, and the `Log` of them.

Gyros with common stamps are units of one log. Gyros with their own clocks cannot share rows: the first is used, or the
requested one, and the others are named. Temperatures of another topic are interpolated to the gyro's stamps.
"""

import importlib
from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Final

import numpy as np

from gradcal_jax.records.log import SENSOR_RATE, Finding, Floats, Log, LogError, naming, quietly
from gradcal_jax.records.log_faults import Columns, examine

KINDS: Final = {
    ".ulg": "ulog",
    ".ulog": "ulog",
    ".bin": "dataflash",
}
"""File name endings, each with the module that reads such files."""
_FIRMWARE: Final = {"ulog": "px4", "dataflash": "ardupilot"}
_FROM_MAVLINK: Final = (
    "has MAVLink messages. Their HIGHRES_IMU, as PX4 sends it, is not the output of the sensor: the gyro bias of "
    "PX4's estimator is subtracted, and the temperature is that of the barometer. A calibration needs the log of "
    "the flight controller itself: PX4's .ulg with sensor_gyro, or ArduPilot's .bin"
)
_BAG: Final = (
    "is a ROS bag: read its sensor_msgs/Imu with the package rosbags, and give the arrays to gradcal_jax.log_from "
    "(docs/how-to/recording.md has the lines)"
)
_REFUSED: Final = {".tlog": _FROM_MAVLINK, ".bag": _BAG, ".db3": _BAG, ".mcap": _BAG}


@dataclass(frozen=True)
class GyroStream:
    """One gyro: `rate_rad_per_s` `(samples, 3)` about x, y, z at `time_s`, which counts from the log's own zero."""

    name: str
    time_s: Floats
    rate_rad_per_s: Floats
    temperature_c: Floats | None
    """Temperature of the gyro at the same time stamps."""
    notes: tuple[str, ...] = ()
    """Properties of this source that matter for a calibration, in sentences."""
    sensor_rate: str | None = None
    """The sensor's own sample rate, in the words of `records.log.SENSOR_RATE`."""
    force_m_per_s2: Floats | None = None
    """`(samples, 3)` of the accelerometers beside it, at the same time stamps."""


def is_vehicle_log(path: Path) -> bool:
    """Whether `read_vehicle_log` reads files of this ending."""
    return path.suffix.lower() in KINDS | _REFUSED


def read_vehicle_log(path: str | Path, *, unit: str | None = None, rows: tuple[int, int | None] | None = None) -> Log:
    """The log of one or several gyros in a vehicle's log, axes x, y, z in rad/s, examined as any recording is.

    `unit` names the gyro where several run at clocks of their own; `rows` cuts a part, the last row not included.

    **Raises:** `LogError` with a sentence, for files that are not what their ending says, for logs without a raw gyro,
    and where the library that reads them is not installed.
    """
    path = Path(path)
    clocks = _clocks(path)
    names = [stream.name for streams in clocks for stream in streams]
    with naming(path):
        if unit is not None and unit not in names:
            raise LogError(f"there is no IMU '{unit}' in this log; it has {', '.join(names)}")
        chosen = next(of for of in clocks if unit is None or unit in [stream.name for stream in of])
        log = _log(chosen, path, rows)
    others = [name for name in names if name not in log.units]
    if not others:
        return log
    text = f"the log also has other gyros, with clocks of their own: {', '.join(others)}; choose one with --unit"
    return replace(log, findings=(Finding("other units", "keep", 0, text), *log.findings))


def read_vehicle_logs(path: str | Path, *, rows: tuple[int, int | None] | None = None) -> list[Log]:
    """All gyros of a vehicle's log: a log for each clock, otherwise as `read_vehicle_log`."""
    path = Path(path)
    clocks = _clocks(path)
    with naming(path):
        return [_log(streams, path, rows) for streams in clocks]


def _clocks(path: Path) -> list[list[GyroStream]]:
    """The gyros of a log, those with common stamps together."""
    if not path.exists():
        raise LogError(f"{path} does not exist")
    if path.is_dir():
        raise LogError(f"{path} is a directory")
    if why := _REFUSED.get(path.suffix.lower()):
        raise LogError(f"{path} {why}")
    kind = KINDS[path.suffix.lower()]
    reader = importlib.import_module(f"gradcal_jax.records.vehicle.{kind}")
    with naming(path):
        with quietly({"ulog": "ULog", "dataflash": "DataFlash"}[kind]):
            gyros: Sequence[GyroStream] = reader.gyros(path)
        clocks = dict[tuple[str | None, bytes], list[GyroStream]]()
        for stream in gyros:
            if len(stream.time_s) > 1:
                clocks.setdefault((stream.sensor_rate, stream.time_s.tobytes()), []).append(stream)
        if not clocks:
            raise LogError("the log has no samples of a gyro")
        return list(clocks.values())


def _log(streams: Sequence[GyroStream], path: Path, rows: tuple[int, int | None] | None) -> Log:
    """The log of gyros with common stamps."""
    first = streams[0]
    provenance = {"source": path.name, "firmware": _FIRMWARE[KINDS[path.suffix.lower()]]}
    if first.sensor_rate is not None:
        provenance[SENSOR_RATE] = first.sensor_rate
    nothing = np.full(len(first.time_s), np.nan)
    warm = [nothing if stream.temperature_c is None else stream.temperature_c for stream in streams]
    forces = [stream.force_m_per_s2 for stream in streams if stream.force_m_per_s2 is not None]
    columns = Columns(
        rate_rad_per_s=np.stack([stream.rate_rad_per_s for stream in streams]),
        units=tuple(stream.name for stream in streams),
        axes=("x", "y", "z"),
        time_s=first.time_s,
        specific_force_m_per_s2=np.stack(forces) if len(forces) == len(streams) else None,
        force_axes=("x", "y", "z") if len(forces) == len(streams) else (),
        temperature_c=np.stack(warm) if np.isfinite(warm).any() else None,
        provenance=provenance,
    )
    log = examine(columns if rows is None else columns.part(rows))
    notes = [Finding("source", "keep", 0, note) for stream in streams for note in stream.notes]
    return replace(log, findings=(*notes, *log.findings))


def interpolated(time_s: Floats, of_time_s: Floats, values: Floats) -> Floats:
    """Readings of a slower thermometer at a gyro's stamps; NaN farther outside than two of its intervals."""
    kept = np.isfinite(of_time_s) & np.isfinite(values)
    order = np.argsort(of_time_s[kept], kind="stable")
    x, y = of_time_s[kept][order], values[kept][order]
    if len(x) == 0:
        return np.full(len(time_s), np.nan)
    beyond = 2 * float(np.median(np.diff(x))) if len(x) > 1 else 0.0
    result = np.interp(time_s, x, y)
    result[(time_s < x[0] - beyond) | (time_s > x[-1] + beyond)] = np.nan
    return result
