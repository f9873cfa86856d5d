"""Logs of flight controllers -> `Log`, without a column map: PX4's ULog by pyulog, ArduPilot's DataFlash by pymavlink.

PX4 (PX4-Autopilot, `msg/`):

sensor_gyro         one sample (or the mean of a FIFO's) of a gyro, rotated to the vehicle's axes, otherwise as it came
                    from the sensor: rad/s, `temperature` in °C, `device_id`, `timestamp_sample` in µs
sensor_gyro_fifo    the FIFO itself: `samples` of x, y, z as counts times `scale`, `dt` µs apart, the last one at
                    `timestamp_sample`; no temperature
sensor_accel        the same of an accelerometer, m/s²; beside the gyro whose `device_id` it has, at its own stamps
sensor_combined     not the sensor: offsets, thermal calibration and the estimator's bias are taken off
vehicle_imu_status  `gyro_rate_hz`, at which sensor_gyro of `gyro_device_id` is published: the logger keeps every n-th.
                    Without it, rows below 90 Hz are single samples of an unknown rate: PX4 publishes no gyro as slowly

ArduPilot (`libraries/AP_InertialSensor/AP_InertialSensor_Backend.cpp`, `_rotate_and_correct_gyro`, and
`AP_InertialSensor_tempcal.cpp`): IMU has TimeUS, I (which one; IMU2 and IMU3 in old logs), GyrX … in rad/s, AccX … in
m/s², T in °C; PARM the parameters at the start, and whenever one changes. What is logged of gyros is after, in this
order and in the sensor's frame,

    P(T_cal − 35 °C) − P(T − 35 °C)    with P(d) = 1e-6 (c₁ d + c₂ d² + c₃ d³), c from INS_TCALn_GYRk_*, both
                                       temperatures kept within TMIN and TMAX; where INS_TCALn_ENABLE is 1 (2 learns,
                                       nothing is applied) and INS_GYRn_CALTEMP is not below −80 °C
    − INS_GYRnOFFS_*                   the offset at T_cal

and then turned by the board's orientation. Accelerometers likewise (ACC in the place of GYR), and times INS_ACCnSCAL_*
before they are turned. All of it is undone here, with the parameters in force at each sample.
"""

import contextlib
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any, Final

import numpy as np

from gradcal_jax.records.examination import Columns, examine, interpolated
from gradcal_jax.records.log import SENSOR_RATE, Finding, Floats, Log, LogError, library, naming, quietly

_BAG: Final = (
    "is a ROS bag: read its sensor_msgs/Imu with the package rosbags, and give the arrays to gradcal_jax.log_from "
    "(docs/how-to/recording.md has the lines)"
)
_REFUSED: Final = {
    ".tlog": "has MAVLink messages. Their HIGHRES_IMU, as PX4 sends it, is not the output of the sensor: the gyro bias "
    "of PX4's estimator is subtracted, and the temperature is that of the barometer. A calibration needs the log of "
    "the flight controller itself: PX4's .ulg with sensor_gyro, or ArduPilot's .bin",
    **dict.fromkeys((".bag", ".db3", ".mcap"), _BAG),
}
_LETTERS: Final = (
    "a:S64 b:i1 B:u1 h:<i2 H:<u2 i:<i4 I:<u4 f:<f4 d:<f8 g:<f2 n:S4 N:S16 Z:S64 c:<i2 C:<u2 e:<i4 E:<u4 L:<i4 M:u1 "
    "q:<i8 Q:<u8"
)
_STRUCT: Final = {one[0]: one[2:] for one in _LETTERS.split()}
"""DataFlash's letters as NumPy's types; the scaled ones (c, C, e, E, L) are not among the fields used here."""


@dataclass(frozen=True)
class GyroStream:
    """One IMU: rates `(samples, 3)` about x, y, z in rad/s and forces (m/s²) at `time_s`, which counts from the log's
    own zero; `temperature_c` `(samples,)`."""

    name: str
    time_s: Floats
    rate: Floats
    temperature_c: Floats | None
    note: str = ""
    """A property of this source that matters for a calibration."""
    sensor_rate: str | None = None
    """The sensor's own sample rate, in the words of `records.log.SENSOR_RATE`."""
    force: Floats | None = None


def is_vehicle_log(path: Path) -> bool:
    """Whether `read_vehicle_log` reads files of this ending."""
    return path.suffix.lower() in _READERS | _REFUSED


def read_vehicle_log(path: str | Path, *, unit: str | None = None, rows: tuple[int, int | None] | None = None) -> Log:
    """The log of one or several gyros in a vehicle's log, axes x, y, z in rad/s, examined as any recording is. Gyros
    with common stamps are its units; those with other clocks are named in a finding.

    `unit` names the gyro where several run at clocks of their own; `rows` cuts a part, the last row not included.

    **Raises:** `LogError` with a sentence, for files that are not what their ending says, for logs without a raw gyro,
    and where the library that reads them is not installed.
    """
    logs = read_vehicle_logs(path, rows=rows, unit=unit)
    others = [name for log in logs[1:] for name in log.units]
    if not others:
        return logs[0]
    text = f"the log also has other gyros, with clocks of their own: {', '.join(others)}; choose one with --unit"
    return replace(logs[0], findings=(Finding("other units", "keep", 0, text), *logs[0].findings))


def read_vehicle_logs(
    path: str | Path, *, rows: tuple[int, int | None] | None = None, unit: str | None = None
) -> list[Log]:
    """All gyros of a vehicle's log: a log for each clock, that of the `unit` first; otherwise as `read_vehicle_log`."""
    path = Path(path)
    kind = path.suffix.lower()
    if path.is_dir() or not path.exists():
        raise LogError(f"{path} {'is a directory' if path.is_dir() else 'does not exist'}")
    if kind in _REFUSED:
        raise LogError(f"{path} {_REFUSED[kind]}")
    firmware, words, reader = _READERS[kind]
    with naming(path):
        with quietly(words):
            streams = [stream for stream in reader(path) if len(stream.time_s) > 1]
        clocks = dict[tuple[str | None, bytes], list[GyroStream]]()
        for stream in streams:
            clocks.setdefault((stream.sensor_rate, stream.time_s.tobytes()), []).append(stream)
        if not clocks:
            raise LogError("the log has no samples of a gyro")
        names = [stream.name for stream in streams]
        if unit is not None and unit not in names:
            raise LogError(f"there is no IMU '{unit}' in this log; it has {', '.join(names)}")
        first = sorted(clocks.values(), key=lambda of: unit not in [stream.name for stream in of])
        return [_log(of, {"source": path.name, "firmware": firmware}, rows) for of in first]


def _log(streams: Sequence[GyroStream], provenance: dict[str, str], rows: tuple[int, int | None] | None) -> Log:
    """The log of gyros with common stamps."""
    time, rate = streams[0].time_s, streams[0].sensor_rate
    nothing = np.full(len(time), np.nan)
    values = {f"gyro {axis}": np.stack([one.rate[:, k] for one in streams]) for k, axis in enumerate("xyz")}
    forces = [one.force for one in streams if one.force is not None]
    if len(forces) == len(streams):
        values |= {f"accelerometer {axis}": np.stack([of[:, k] for of in forces]) for k, axis in enumerate("xyz")}
    warm = np.stack([nothing if one.temperature_c is None else one.temperature_c for one in streams])
    if np.isfinite(warm).any():
        values["temperature"] = warm
    values["time"] = time
    if rate is not None:
        provenance = provenance | {SENSOR_RATE: rate}
    columns = Columns(tuple(one.name for one in streams), values, provenance=provenance)
    log = examine(columns if rows is None else columns.part(rows))
    notes = [Finding("source", "keep", 0, stream.note) for stream in streams if stream.note]
    return replace(log, findings=(*notes, *log.findings))


def _px4(path: Path) -> Iterator[GyroStream]:
    """Every gyro by its device id, in the order of topics; the FIFO's samples where there are some."""
    reader: Any = library("pyulog", "pyulog")
    wanted = ["sensor_gyro", "sensor_gyro_fifo", "sensor_accel", "sensor_combined", "vehicle_imu_status"]
    with path.open("rb") as opened:
        log = reader.ULog(opened, wanted)
    start_s = float(log.start_timestamp) * 1e-6
    topics = {name: [data for data in log.data_list if data.name == name] for name in wanted}
    singles = {_device(data): data for data in topics["sensor_gyro"]}
    fifos = {_device(data): data for data in topics["sensor_gyro_fifo"]}
    forces = {_device(data): data for data in topics["sensor_accel"]}
    if not singles and not fifos:
        only = "only sensor_combined, from which calibration and bias are already subtracted"
        raise LogError(
            f"the log has {only if topics['sensor_combined'] else 'no gyro'}: make PX4 log sensor_gyro with the "
            "thermal calibration bit (4) of SDLOG_PROFILE"
        )
    published = _published(topics["vehicle_imu_status"])
    for device in singles | fifos:
        single, fifo, beside = singles.get(device), fifos.get(device), forces.get(device)
        time, rate = _samples(single) if fifo is None else _unrolled(fifo)
        time = time * 1e-6 - start_s
        warm = sensor_rate = force = None
        if single is not None and "temperature" in single.data:
            warm = interpolated(single.data["temperature"].astype(np.float64), _stamps(single) * 1e-6 - start_s, time)
        if fifo is None and len(time) > 2:
            own = (len(time) - 1) / max(float(time[-1] - time[0]), 1e-9)
            sensor_rate = "unknown" if own < 90.0 else None
            if device in published:
                # (More than every sample cannot be logged: a tenth is the rate's own error.)
                sensor_rate = f"{published[device]:.6g} Hz" if published[device] > 1.1 * own else None
        if beside is not None:
            at, each = _samples(beside)
            force = np.stack([interpolated(one, at * 1e-6 - start_s, time) for one in each.T], axis=1)
        yield GyroStream(device, time, rate, warm, sensor_rate=sensor_rate, force=force)


def _device(data: Any) -> str:
    ids = np.unique(data.data["device_id"])
    if len(ids) != 1:
        raise LogError(f"{data.name} {data.multi_id} has data of several devices: {', '.join(map(str, ids))}")
    return str(int(ids[0]))


def _stamps(data: Any) -> Any:
    """Of the samples, µs; of the message, where the driver gave none."""
    stamps = data.data.get("timestamp_sample", data.data["timestamp"])
    return np.asarray(np.where(stamps == 0, data.data["timestamp"], stamps), np.int64)


def _samples(data: Any) -> tuple[Any, Floats]:
    return _stamps(data), np.stack([data.data[axis].astype(np.float64) for axis in "xyz"], axis=1)


def _unrolled(data: Any) -> tuple[Any, Floats]:
    """The stamps and rates of the samples of a FIFO."""
    fields = data.data
    count = fields["samples"].astype(np.int64)[:, None]
    place = np.arange(sum(name.startswith("x[") for name in fields))
    inside = place < count
    scale = fields["scale"][:, None].astype(float)
    counts = [np.stack([fields[f"{axis}[{k}]"] for k in place], axis=1) for axis in "xyz"]
    rate = np.stack([(one * scale)[inside] for one in counts], axis=1)
    before = (place - count + 1) * fields["dt"].astype(np.float64)[:, None]
    return (_stamps(data)[:, None] + before)[inside], rate


def _published(topics: Sequence[Any]) -> dict[str, float]:
    """By device id the rate at which it is published, Hz, by the last status."""
    rates = dict[str, float]()
    for data in topics:
        devices, hertz = data.data.get("gyro_device_id", ()), data.data.get("gyro_rate_hz", ())
        rates |= {str(int(one)): float(rate) for one, rate in zip(devices, hertz, strict=False) if rate > 0.0}
    return rates


def _ardupilot(path: Path) -> Iterator[GyroStream]:
    """Every IMU of the log by its number (0, 1, 2), thermal correction, offsets and board rotation undone."""
    reader: Any = library("pymavlink.DFReader", "pymavlink")
    log = reader.DFReader_binary.__new__(reader.DFReader_binary)
    log.init_clock = lambda: None  # the calendar, for which it would parse every message
    try:
        log.__init__(str(path))  # what it opens stays open where this fails, and is closed below
        tables = {name: _table(log, name) for name in ("PARM", "IMU", "IMU2", "IMU3")}
    finally:
        for name in ("filehandle", "data_map"):
            # A reader that failed may still look at the map; it goes with the reader then.
            with contextlib.suppress(AttributeError, BufferError):
                getattr(log, name).close()
    parameters = tables.pop("PARM")
    if not any(len(table) for table in tables.values()):
        raise LogError("the log has no IMU messages: set the IMU bit of LOG_BITMASK")
    if len(parameters) == 0:
        raise LogError(
            "the log has no parameters (PARM), so the offsets and the thermal calibration that ArduPilot has applied "
            "to its IMU data cannot be removed"
        )
    in_force = _parameters(parameters)
    for number, table in enumerate(tables.values()):
        if not len(table):
            continue
        which = table["I"] if "I" in table.dtype.names else np.full(len(table), number)
        for one in np.unique(which).tolist():
            yield _undone(one, table[which == one], in_force)


def _undone(number: int, table: Any, in_force: Callable[[str, Floats, float], Floats]) -> GyroStream:
    time = table["TimeUS"].astype(np.float64) * 1e-6
    names = table.dtype.names
    warm = table["T"].astype(np.float64) if "T" in names else np.full(len(table), np.nan)
    board = in_force("AHRS_ORIENTATION", time, 0.0)
    if np.ptp(board) > 0.0:
        raise LogError("AHRS_ORIENTATION changes within the log")
    n, turned = number + 1, _to_sensor(int(board[0])).T
    learning = in_force(f"INS_TCAL{n}_ENABLE", time, 0.0)
    low, high = in_force(f"INS_TCAL{n}_TMIN", time, -100.0), in_force(f"INS_TCAL{n}_TMAX", time, -100.0)
    now = np.clip(warm, low, high) - 35.0
    undone = dict[str, Floats]()
    thermal = False

    def of_axes(name: str, otherwise: float) -> Floats:
        return np.stack([in_force(f"{name}_{axis}", time, otherwise) for axis in "XYZ"], axis=1)

    for kind in ("GYR", "ACC") if "AccX" in names else ("GYR",):
        values = np.stack([table[f"{kind.capitalize()}{axis}"].astype(np.float64) for axis in "XYZ"], axis=1) @ turned
        place = f"INS_{kind}{n if n > 1 else ''}"
        at = in_force(f"INS_{kind}{n}_CALTEMP", time, -300.0)
        corrected = (learning == 1.0) & (at >= -80.0) & np.isfinite(warm)
        thermal |= bool(corrected.any())
        then = np.clip(at, low, high) - 35.0
        if kind == "ACC":
            values /= of_axes(f"{place}SCAL", 1.0)
        for power in (1, 2, 3):
            change = np.where(corrected, now**power - then**power, 0.0)[:, None]
            values += 1e-6 * of_axes(f"INS_TCAL{n}_{kind}{power}", 0.0) * change
        undone[kind] = values + of_axes(f"{place}OFFS", 0.0)
    note = f"IMU{number}: ArduPilot's offsets{' and thermal calibration' * thermal} have been removed from the data"
    return GyroStream(f"IMU{number}", time, undone["GYR"], warm, note, force=undone.get("ACC"))


def _to_sensor(orientation: int) -> Floats:
    """The rotation from the vehicle's axes to those of the sensor."""
    vector: Any = library("pymavlink.rotmat", "pymavlink").Vector3
    columns = [vector(*row).rotate_by_inverse_id(orientation) for row in np.eye(3).tolist()]
    if any(column is None for column in columns):
        raise LogError(
            f"the orientation of the board, AHRS_ORIENTATION = {orientation}, is not known to this program, so the "
            "board's rotation cannot be removed"
        )
    return np.array([[column.x, column.y, column.z] for column in columns]).T


def _parameters(table: Any) -> Callable[[str, Floats, float], Floats]:
    """The value of a parameter at each time: the last one written, or before any the first."""
    times = table["TimeUS"].astype(np.float64) * 1e-6
    names = np.char.decode(table["Name"], "ascii", "replace")

    def in_force(name: str, time: Floats, otherwise: float) -> Floats:
        rows = np.flatnonzero(names == name)
        if not len(rows):
            return np.full(len(time), otherwise)
        values = table["Value"][rows].astype(np.float64)
        return values[np.maximum(np.searchsorted(times[rows], time, side="right") - 1, 0)]

    return in_force


def _table(log: Any, name: str) -> Any:
    """All messages of a name as a structured array."""
    fmt = next((fmt for fmt in log.formats.values() if fmt.name == name), None)
    if fmt is None:
        return np.empty(0)
    kinds = [_STRUCT[letter] for letter in fmt.format]
    layout = np.dtype({"names": list(fmt.columns), "formats": kinds, "itemsize": fmt.len - 3})
    at = np.asarray(log.offsets[fmt.type], np.int64) + 3
    content = np.frombuffer(bytes(log.data_map), np.uint8)  # a view would keep the map from being closed
    at = at[at + layout.itemsize <= len(content)]
    if not len(at):
        return np.empty(0, layout)
    return content[at[:, None] + np.arange(layout.itemsize)].reshape(-1).view(layout)


_READERS: Final[dict[str, tuple[str, str, Callable[[Path], Iterator[GyroStream]]]]] = {
    ".ulg": ("px4", "ULog", _px4),
    ".ulog": ("px4", "ULog", _px4),
    ".bin": ("ardupilot", "DataFlash", _ardupilot),
}
