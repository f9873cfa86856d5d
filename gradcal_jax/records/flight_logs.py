"""Logs of flight controllers -> `Log`, without a column map: PX4's ULog by pyulog, ArduPilot's DataFlash by pymavlink.

PX4 (PX4-Autopilot, `msg/`):

sensor_gyro         one sample (or the mean of a FIFO's) of a gyro, rotated to the vehicle's axes, otherwise as it came
                    from the sensor: rad/s, `temperature` in °C, `device_id`, `timestamp_sample` in µs
sensor_accel        the same of an accelerometer, m/s²; beside the gyro whose `device_id` it has, at its own stamps
sensor_combined     not the sensor: offsets, thermal calibration and the estimator's bias are taken off
vehicle_imu_status  `gyro_rate_hz`, at which sensor_gyro of `gyro_device_id` is published: the logger keeps every n-th.
                    Without it, rows below 90 Hz are single samples of an unknown rate: PX4 publishes no gyro as slowly

ArduPilot (`libraries/AP_InertialSensor/AP_InertialSensor_Backend.cpp`): IMU has TimeUS, I (which one), GyrX …
in rad/s, AccX … in m/s², T in °C; PARM the parameters at the start, and whenever one changes. Off the
gyros are taken INS_GYRnOFFS_*, off the accelerometers INS_ACCnOFFS_*, which are then multiplied by INS_ACCnSCAL_*, and
all are turned by the board's orientation. That is undone here, with the parameters in force at each sample; a thermal
calibration (INS_TCALn_ENABLE = 1) is not.
"""

import contextlib
from collections.abc import Callable, Iterator, Mapping
from dataclasses import replace
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


def is_vehicle_log(path: Path) -> bool:
    """Whether `read_vehicle_log` reads files of this ending."""
    return path.suffix.lower() in _READERS | _REFUSED


def read_vehicle_log(path: str | Path, *, unit: str | None = None, rows: tuple[int, int | None] | None = None) -> Log:
    """The log of one IMU in a vehicle's log, axes x, y, z in rad/s: of the `unit` (PX4's device id, ArduPilot's
    "IMU0"), by default the first; others are named in a finding. Otherwise as `read_vehicle_logs`."""
    logs = {log.units[0]: log for log in read_vehicle_logs(path, rows=rows)}
    if unit is not None and unit not in logs:
        raise LogError(f"{path}: there is no IMU '{unit}' in this log; it has {', '.join(logs)}")
    chosen = logs[unit or next(iter(logs))]
    if not (others := [name for name in logs if name != chosen.units[0]]):
        return chosen
    text = f"the log also has other IMUs: {', '.join(others)}; choose one with --unit"
    return replace(chosen, findings=(Finding("other units", text), *chosen.findings))


def read_vehicle_logs(path: str | Path, *, rows: tuple[int, int | None] | None = None) -> list[Log]:
    """The logs of all IMUs of a vehicle's log, examined as any recording is; `rows` cuts a part, the last row not
    included.

    **Raises:** `LogError` with a sentence, for files that are not what their ending says, for logs without a raw gyro,
    and where the library that reads them is not installed.
    """
    path = Path(path)
    kind = path.suffix.lower()
    with naming(path):
        if kind in _REFUSED:
            raise LogError(_REFUSED[kind])
        words, reader = _READERS[kind]
        with quietly(words):
            imus = [one for one in reader(path) if one.rows > 1]
        if not imus:
            raise LogError("the log has no samples of a gyro")
        logs = list[Log]()
        for raw in imus:
            raw.provenance["source"] = path.name
            logs.append(examine(raw if rows is None else raw.part(rows)))
        return logs


def _raw(name: str, time_s: Floats, vectors: Mapping[str, Floats | None], warm: Floats | None) -> Columns:
    """The columns of an IMU from its `vectors` `(samples, 3)`, gyro and accelerometer."""
    values = {"time": time_s}
    for kind, vector in vectors.items():
        if vector is not None:
            values |= {f"{kind} {axis}": vector[:, k] for k, axis in enumerate("xyz")}
    if warm is not None and np.isfinite(warm).any():
        values["temperature"] = warm
    return Columns(name, values)


def _px4(path: Path) -> Iterator[Columns]:
    """Every gyro by its device id, in the order of topics."""
    reader: Any = library("pyulog", "pyulog")
    wanted = ["sensor_gyro", "sensor_accel", "sensor_combined", "vehicle_imu_status"]
    with path.open("rb") as opened:
        log = reader.ULog(opened, wanted)
    start_s = float(log.start_timestamp) * 1e-6
    topics = {name: [data for data in log.data_list if data.name == name] for name in wanted}
    gyros, forces = ({_device(data): data for data in topics[name]} for name in wanted[:2])
    if not gyros:
        only = "only sensor_combined, from which calibration and bias are already subtracted"
        raise LogError(
            f"the log has {only if topics['sensor_combined'] else 'no gyro'}: make PX4 log sensor_gyro with the "
            "thermal calibration bit (4) of SDLOG_PROFILE"
        )
    published = _published(topics["vehicle_imu_status"])
    for device, data in gyros.items():
        time, rate = _samples(data, start_s)
        warm = data.data["temperature"].astype(np.float64) if "temperature" in data.data else None
        force = None
        if device in forces:
            at, each = _samples(forces[device], start_s)
            force = np.stack([interpolated(one, at, time) for one in each.T], axis=1)
        raw = _raw(device, time, {"gyro": rate, "accelerometer": force}, warm)
        own_hz = (len(time) - 1) / max(float(np.ptp(time)), 1e-9)
        # (More than every sample cannot be logged: a tenth is the rate's own error.)
        if published.get(device, own_hz) > 1.1 * own_hz:
            raw.provenance[SENSOR_RATE] = f"{published[device]:.6g} Hz"
        elif device not in published and own_hz < 90.0:
            raw.provenance[SENSOR_RATE] = "unknown"
        yield raw


def _device(data: Any) -> str:
    ids = np.unique(data.data["device_id"])
    if len(ids) != 1:
        raise LogError(f"{data.name} {data.multi_id} has data of several devices: {', '.join(map(str, ids))}")
    return str(int(ids[0]))


def _samples(data: Any, start_s: float) -> tuple[Floats, Floats]:
    """The times of the samples (of the message, where the driver gave none), and x, y, z."""
    sent: Any = data.data["timestamp"]
    taken: Any = data.data.get("timestamp_sample", sent)
    time = np.asarray(np.where(taken == 0, sent, taken), np.float64)
    return time * 1e-6 - start_s, np.stack([data.data[axis] for axis in "xyz"], axis=1).astype(np.float64)


def _published(topics: list[Any]) -> dict[str, float]:
    """By device id the rate at which it is published, Hz, by the last status."""
    rates = dict[str, float]()
    for data in topics:
        devices, hertz = data.data.get("gyro_device_id", ()), data.data.get("gyro_rate_hz", ())
        rates |= {str(int(one)): float(rate) for one, rate in zip(devices, hertz, strict=False) if rate > 0.0}
    return rates


def _ardupilot(path: Path) -> Iterator[Columns]:
    """Every IMU of the log by its number ("IMU0"), offsets and board rotation undone."""
    reader: Any = library("pymavlink.DFReader", "pymavlink")
    log = reader.DFReader_binary.__new__(reader.DFReader_binary)
    log.init_clock = lambda: None  # the calendar, for which it would parse every message
    try:
        log.__init__(str(path))  # what it opens stays open where this fails, and is closed below
        parameters, table = _table(log, "PARM"), _table(log, "IMU")
    finally:
        for name in ("filehandle", "data_map"):
            # A reader that failed may still look at the map; it goes with the reader then.
            with contextlib.suppress(AttributeError, BufferError):
                getattr(log, name).close()
    if len(table) == 0:
        raise LogError("the log has no IMU messages: set the IMU bit of LOG_BITMASK")
    if len(parameters) == 0:
        raise LogError(
            "the log has no parameters (PARM), so the offsets that ArduPilot has applied to its IMU data cannot be "
            "removed"
        )
    in_force = _parameters(parameters)
    which = table["I"] if "I" in table.dtype.names else np.zeros(len(table), np.int64)
    for one in np.unique(which).tolist():
        yield _undone(one, table[which == one], in_force)


def _undone(number: int, table: Any, in_force: Callable[[str, Floats, float], Floats]) -> Columns:
    time = table["TimeUS"].astype(np.float64) * 1e-6
    n = number + 1
    if np.any(in_force(f"INS_TCAL{n}_ENABLE", time, 0.0) == 1.0):
        raise LogError(
            f"ArduPilot has applied a thermal calibration to IMU{number} (INS_TCAL{n}_ENABLE = 1): set it to 0 (2 "
            "becomes 1 when ArduPilot has learnt), and log again"
        )
    board = in_force("AHRS_ORIENTATION", time, 0.0)
    if np.ptp(board) > 0.0:
        raise LogError("AHRS_ORIENTATION changes within the log")
    turned = _to_sensor(int(board[0])).T

    def of_sensor(kind: str, parameter: str) -> Floats:
        values = np.stack([table[f"{kind}{axis}"] for axis in "XYZ"], axis=1).astype(np.float64) @ turned
        named = f"INS_{parameter}{n if n > 1 else ''}"
        for k, axis in enumerate("XYZ"):
            values[:, k] /= in_force(f"{named}SCAL_{axis}", time, 1.0)
            values[:, k] += in_force(f"{named}OFFS_{axis}", time, 0.0)
        return values

    names = table.dtype.names
    vectors = {"gyro": of_sensor("Gyr", "GYR")} | (
        {"accelerometer": of_sensor("Acc", "ACC")} if "AccX" in names else {}
    )
    return _raw(f"IMU{number}", time, vectors, table["T"].astype(np.float64) if "T" in names else None)


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


_READERS: Final[dict[str, tuple[str, Callable[[Path], Iterator[Columns]]]]] = {
    ".ulg": ("ULog", _px4),
    ".ulog": ("ULog", _px4),
    ".bin": ("DataFlash", _ardupilot),
}
