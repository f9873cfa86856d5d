"""ArduPilot's DataFlash (.bin). Indexed by pymavlink's DFReader; the samples are then taken out all at once.

    IMU     TimeUS, I (which one; IMU2 and IMU3 in old logs), GyrX, GyrY, GyrZ in rad/s, AccX, AccY, AccZ in m/s²,
            T in °C
    PARM    TimeUS, Name, Value: the parameters at the start, and whenever one changes

Sources: ArduPilot, `libraries/AP_InertialSensor/AP_InertialSensor_Backend.cpp` (`_rotate_and_correct_gyro`) and
`AP_InertialSensor_tempcal.cpp`. What is logged of gyros is after, in this order and in the sensor's frame,

    P(T_cal − 35 °C) − P(T − 35 °C)    with P(d) = 1e-6 (c₁ d + c₂ d² + c₃ d³), c from INS_TCALn_GYRk_*, both
                                       temperatures kept within TMIN and TMAX; where INS_TCALn_ENABLE is 1 (2 learns,
                                       nothing is applied) and INS_GYRn_CALTEMP is not below −80 °C
    − INS_GYRnOFFS_*                   the offset at T_cal

and then turned by the board's orientation. Accelerometers likewise (ACC in the place of GYR), and times INS_ACCnSCAL_*
before they are turned. All of it is undone here, with the parameters in force at each sample.
"""

import contextlib
import re
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any, Final

import numpy as np

from gradcal_jax.records.log import Floats, LogError, library
from gradcal_jax.records.vehicle.streams import GyroStream

_REFERENCE_C: Final = 35.0
_UNSET_BELOW_C: Final = -80.0
_STRUCT: Final = {
    "a": "S64", "b": "i1", "B": "u1", "h": "<i2", "H": "<u2", "i": "<i4", "I": "<u4", "f": "<f4", "d": "<f8",
    "g": "<f2", "n": "S4", "N": "S16", "Z": "S64", "c": "<i2", "C": "<u2", "e": "<i4", "E": "<u4", "L": "<i4",
    "M": "u1", "q": "<i8", "Q": "<u8",
}  # fmt: skip
"""DataFlash's letters as NumPy's types; the scaled ones (c, C, e, E, L) are not among the fields used here."""


def gyros(path: Path) -> Sequence[GyroStream]:
    """Every IMU of the log by its number (0, 1, 2), thermal correction, offsets and board rotation undone."""
    reader: Any = library("pymavlink.DFReader", "pymavlink")
    log = reader.DFReader_binary.__new__(reader.DFReader_binary)
    log.init_clock = lambda: None  # the calendar, for which it would parse every message
    try:
        log.__init__(str(path))  # what it opens stays open where this fails, and is closed below
        names = {fmt.name for fmt in log.formats.values()}
        parameters = _table(log, "PARM") if "PARM" in names else ()
        tables = [_table(log, name) for name in ("IMU", "IMU2", "IMU3") if name in names]
    finally:
        for name in ("filehandle", "data_map"):
            # A reader that failed may still look at the map; it goes with the reader then.
            with contextlib.suppress(AttributeError, BufferError):
                getattr(log, name).close()
    if not any(len(table) for table in tables):
        raise LogError("the log has no IMU messages: set the IMU bit of LOG_BITMASK")
    if len(parameters) == 0:
        raise LogError(
            "the log has no parameters (PARM), so the offsets and the thermal calibration that ArduPilot has "
            "applied to its IMU data cannot be removed"
        )
    in_force = _parameters(parameters)
    streams: list[GyroStream] = []
    for number, table in enumerate(tables):
        which = table["I"] if "I" in (table.dtype.names or ()) else np.full(len(table), number, np.uint8)
        streams += [_undone(int(one), table[which == one], in_force) for one in np.unique(which)]
    return streams


def _undone(number: int, table: Any, in_force: Callable[[str, Floats, float], Floats]) -> GyroStream:
    time = table["TimeUS"].astype(np.float64) * 1e-6
    names = table.dtype.names
    temperature = table["T"].astype(np.float64) if "T" in names else np.full(len(table), np.nan)
    orientation = in_force("AHRS_ORIENTATION", time, 0.0)
    if np.ptp(orientation) > 0.0:
        raise LogError("AHRS_ORIENTATION changes within the log")
    n, turned = number + 1, _to_sensor(int(orientation[0])).T
    learning = in_force(f"INS_TCAL{n}_ENABLE", time, 0.0)
    low, high = in_force(f"INS_TCAL{n}_TMIN", time, -100.0), in_force(f"INS_TCAL{n}_TMAX", time, -100.0)
    now = np.clip(temperature, low, high) - _REFERENCE_C
    anything_corrected = False

    def raw(kind: str) -> Floats:
        nonlocal anything_corrected
        logged = np.stack([table[f"{kind.capitalize()}{axis}"].astype(np.float64) for axis in "XYZ"], axis=1)
        values = logged @ turned
        place = f"{kind}{n if n > 1 else ''}"
        caltemp = in_force(f"INS_{kind}{n}_CALTEMP", time, -300.0)
        corrected = (learning == 1.0) & (caltemp >= _UNSET_BELOW_C) & np.isfinite(temperature)
        anything_corrected |= bool(corrected.any())
        then = np.clip(caltemp, low, high) - _REFERENCE_C
        for axis, letter in enumerate("XYZ"):
            thermal = np.zeros(len(time))
            for power in (1, 2, 3):
                coefficient = in_force(f"INS_TCAL{n}_{kind}{power}_{letter}", time, 0.0)
                thermal += 1e-6 * coefficient * (now**power - then**power)
            if kind == "ACC":
                values[:, axis] /= in_force(f"INS_{place}SCAL_{letter}", time, 1.0)
            values[:, axis] += np.where(corrected, thermal, 0.0)
            values[:, axis] += in_force(f"INS_{place}OFFS_{letter}", time, 0.0)
        return values

    rate = raw("GYR")
    force = raw("ACC") if {"AccX", "AccY", "AccZ"} <= set(names) else None
    note = "offsets" + (" and thermal calibration" if anything_corrected else "")
    if orientation[0]:
        note += f" and the board's orientation ({int(orientation[0])})"
    known = temperature if np.isfinite(temperature).any() else None
    note = f"IMU{number}: ArduPilot's {note} have been removed from the data with the parameters in the log"
    return GyroStream(f"IMU{number}", time, rate, known, notes=(note,), force_m_per_s2=force)


def _to_sensor(orientation: int) -> Floats:
    """From the vehicle's frame back to the sensor's."""
    if orientation == 0:
        return np.eye(3)
    vector = library("pymavlink.rotmat", "pymavlink").Vector3
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
    where: dict[str, list[int]] = {}
    for row, name in enumerate(table["Name"].tolist()):
        text = name.decode("ascii", "replace")
        if re.match(r"INS_|AHRS_ORIENTATION", text):
            where.setdefault(text, []).append(row)

    def in_force(name: str, time: Floats, otherwise: float) -> Floats:
        rows = where.get(name)
        if rows is None:
            return np.full(len(time), otherwise)
        values = table["Value"][rows].astype(np.float64)
        return values[np.maximum(np.searchsorted(times[rows], time, side="right") - 1, 0)]

    return in_force


def _table(log: Any, name: str) -> Any:
    """All messages of a name as a structured array."""
    fmt = next(fmt for fmt in log.formats.values() if fmt.name == name)
    kinds = [_STRUCT[letter] for letter in fmt.format]
    layout = np.dtype({"names": list(fmt.columns), "formats": kinds, "itemsize": fmt.len - 3})
    at = np.asarray(log.offsets[fmt.type], np.int64) + 3
    content = np.frombuffer(bytes(log.data_map), np.uint8)  # a view would keep the map from being closed
    at = at[at + layout.itemsize <= len(content)]
    return (
        content[at[:, None] + np.arange(layout.itemsize)].reshape(-1).view(layout) if len(at) else np.empty(0, layout)
    )
