"""The rows of a log as an estimate takes them: rates, forces, temperatures, and the readings of the table."""

from collections.abc import Sequence
from typing import Any

import numpy as np

from gradcal_jax import estimation
from gradcal_jax.api.estimate_options import Options
from gradcal_jax.api.imu_build import BuiltImu
from gradcal_jax.api.log_rows import bridged_temperature, table_readings, time_of, usable_rows
from gradcal_jax.estimation import ImuRows
from gradcal_jax.files.log import Log, LogError, ReadingKind
from gradcal_jax.files.plan import StandardPlan
from gradcal_jax.files.schedule import StandardSchedule
from gradcal_jax.files.spec_sections import Spec
from gradcal_jax.model import SECOND

# Assumed time between two recordings of one unit in different mountings, s: far longer than any drift lasts.
_REHUNG_S = 6 * 3600.0
# Time over which a temperature is smoothed that nobody controls, and that may turn at once, s.
_UNCONTROLLED_S = 16.0
# Spacing of the readings of a log with the angle at every row, if nothing says it, s.
_READ_EVERY_S = 1.0


def imu_rows(built: BuiltImu, logs: Sequence[Log], name: str, options: Options) -> tuple[ImuRows, tuple[str, ...]]:
    """The rows of one unit in all its logs, in order, and messages on what was inferred or left out."""
    parts, messages, end = [], [], None
    for k, log in enumerate(logs):
        part, notes = _rows_of_log(built, log, name, options)
        messages += notes
        begin = part.time_s[0] if end is None else end + _REHUNG_S
        shifted = part.time_s - part.time_s[0] + begin
        mounting = part.mounting if len(logs) == 1 else np.full(len(shifted), k)
        if (highest := int(mounting.max())) >= len(built.spec.rig.table.mounting):
            raise LogError(f"the log was recorded in mounting {highest + 1}, which the spec does not have")
        # A change of the mounting ends a standstill.
        part.standing[np.flatnonzero(np.diff(mounting, prepend=mounting[0] if k == 0 else -1))] = False
        parts.append(part._replace(time_s=shifted, mounting=mounting))
        end = shifted[-1]
    if len(logs) > 1 and built.model.knows_path:
        messages.append(
            "between the logs the course of the temperature is not known: plays go straight from one to the next, and "
            "power-on is at the beginning of the first"
        )
    fields = ([getattr(part, field) for part in parts] for field in ImuRows._fields)
    whole: Any = (None if any(x is None for x in field) else np.concatenate(field) for field in fields)
    whole = ImuRows(*whole)
    if built.spec.rig.table.by_gravity:
        try:
            found = estimation.angles_by_gravity(whole, built.motion.geometry, np.asarray(built.motion.start_angles))
        except ValueError as error:
            raise LogError(f"{name}: {error}") from None
        kept, messages = ~found.doubtful, [*messages, *found.messages]
        whole = whole._replace(angles=found.angles, standing=whole.standing & kept, usable=whole.usable & kept)
    return whole, tuple(dict.fromkeys(messages))


def _rows_of_log(built: BuiltImu, log: Log, name: str, options: Options) -> tuple[ImuRows, list[str]]:
    number, (time, messages) = log.unit_index(name), time_of(log, options)
    rates, force = log.triads(number)
    usable, gyros, missing = usable_rows(log, number), np.zeros(3, bool), []
    for c in built.model.channels:
        values = (rates if c.kind == "gyro" else force)[:, c.axis]
        known = np.isfinite(values)
        if not known.any():
            missing.append(c.name.replace("_", " "))
        usable &= known
        gyros[c.axis] |= c.kind == "gyro"
    if missing:
        has = [f"gyro {a}" for a in log.axes] + [f"accelerometer {a}" for a in log.force_axes]
        raise LogError(
            f"the log has no {', '.join(missing)}, which the spec calibrates; it has {', '.join(has)}. Log axes are "
            "named x, y, z"
        )
    rates[:, ~gyros] = np.nan
    temperature = bridged_temperature(log, number, options.temperature_c)
    standard = isinstance(built.spec.plan, StandardPlan)
    if log.standstill is not None:
        standing = log.standstill >= 0
        # One standstill directly follows another where a run was interrupted at rest and resumed at rest elsewhere.
        standing[1:] &= (np.diff(log.standstill) == 0) | ~standing[:-1]
    elif standard:
        # Its reference is the held rate: nothing is read where the table stands.
        standing = np.zeros(len(time), bool)
    elif gyros.any():
        # Also by gyros that are not calibrated: a turn about another axis is no rest.
        standstill = estimation.find_standstills(
            np.nan_to_num(log.rate_rad_per_s[number]),
            log.sample_interval_s,
            valid=usable,
            divide=built.spec.rig.table.by_gravity,
        )
        standing = standstill >= 0
        messages.append(
            f"the log marks no standstills: {int(standstill.max()) + 1} were found where the rates are quiet"
        )
    else:
        raise LogError("a log without gyros must mark its standstills (a column standstill in the column map)")
    if built.spec.rig.table.by_gravity and log.standstill is not None and gyros.any():
        # Nobody knows but the gyros when a hand, or a motor that was switched off, came to rest.
        quiet = estimation.find_standstills(
            np.nan_to_num(log.rate_rad_per_s[number]), log.sample_interval_s, valid=usable, divide=True
        )
        standing &= quiet >= 0
    over = {"over_s": _UNCONTROLLED_S} if built.spec.rig.chamber.control == "none" else {}
    smooth = estimation.smoothed_temperature(time, temperature, **over)
    mounting = np.zeros(len(time), int) if log.mounting is None else log.mounting
    worth = rate = at_end = None
    if standard:
        angles, at_a_stop, rate = (
            np.full((len(time), 1), np.nan),
            np.zeros(len(time), bool),
            _table_rate(built, log, options.table_axis),
        )
    elif built.spec.rig.table.by_gravity:
        # Whatever the log says of angles is where the table was meant to go.
        angles, at_a_stop = np.full((len(time), len(built.spec.rig.table.axis)), np.nan), np.zeros(len(time), bool)
    elif read_by_events(built.spec):
        known = log.table_axes and (log.readings is not None or log.table_angle_rad is not None)
        place = _places_of(built, log, options.table_axis)[0] if known or options.table_axis else None
        if not known:
            messages.append(
                "the log has no table angle: only rates at rest are used, and the scale factor is not observable"
            )
        noise = float(built.model.encoder.reading[0])
        read, standing = table_readings(log, place, standing, _spacing(built, options), messages, noise)
        at_a_stop, worth, at_end = np.zeros(len(time), bool), np.ones(len(time)), np.zeros(len(time), bool)
        at_a_stop[read.rows], worth[read.rows], at_end[read.rows] = True, read.worth, read.at_end
        angles = np.full((len(time), 1), np.nan)
        angles[read.rows, 0] = read.angle
    else:
        angles, at_a_stop = _table_angles(built, log, options.table_axis)
    if (second := log.bridged_temperature(number, second=True)) is not None:
        second = estimation.smoothed_temperature(time, second, **over)
    elif any(of.name == SECOND for of in built.model.others):
        raise LogError(
            "the log has no second temperature, on whose difference from the first the spec has a "
            "thermometer_difference; a column map gives it as second_temperature"
        )
    return ImuRows(
        time, rates, force, smooth, angles, standing, usable, mounting, at_a_stop, worth, rate, at_end, second
    ), messages


def _spacing(built: BuiltImu, options: Options) -> float:
    """The spacing of readings at rest, s."""
    every = float(built.model.encoder.every[0])
    return options.read_every or (every if np.isfinite(every) else _READ_EVERY_S)


def read_by_events(spec: Spec) -> bool:
    """Whether the only axis of a table is read while it stands, each reading being a reference."""
    return len(spec.rig.table.axis) == 1 and spec.rig.table.standing == "read"


def _table_rate(built: BuiltImu, log: Log, chosen: str | None) -> np.ndarray:
    """The rate held by the table's only axis, rad/s. Raises `LogError`."""
    place = _places_of(built, log, chosen)[0] if log.table_axes else None
    if place is not None and log.table_rate_rad_per_s is not None:
        return log.table_rate_rad_per_s[:, place]
    if place is not None and log.table_angle_rad is not None:
        return np.gradient(log.table_angle_rad[:, place], log.time_s)
    schedule = built.spec.schedule
    assert isinstance(schedule, StandardSchedule)
    if any(schedule.rates):
        raise LogError("the log has no table rate, which is the reference of the standard method")
    return np.zeros(len(log.time_s))


def _places_of(built: BuiltImu, log: Log, chosen: str | None) -> list[int]:
    """Where the axes of the spec's table stand among the log's; `chosen`: the log's name of the only one."""
    names = [axis.name for axis in built.spec.rig.table.axis]
    if chosen is not None:
        if len(names) > 1:
            raise LogError("--table-axis is for a table of one axis: name the axes alike in spec and log")
        names = [chosen]
    if missing := [name for name in names if name not in log.table_axes]:
        if chosen is not None or not len(names) == len(log.table_axes) == 1:
            raise LogError(
                f"the log has no table axis {', '.join(missing)}: it has {', '.join(log.table_axes) or 'none'}. Name "
                "the axes alike in the spec's [[rig.table.axis]] and in the log's column map"
            )
        names = list(log.table_axes)
    return [log.table_axes.index(name) for name in names]


def _table_angles(built: BuiltImu, log: Log, chosen: str | None) -> tuple[np.ndarray, np.ndarray]:
    """The table's angles `(n, L)` about the spec's axes, in its order, NaN where not read, and whether a row's are
    readings of standing axes."""
    count = len(log.time_s)
    if log.table_angle_rad is None and log.readings is None:
        names = ", ".join(axis.name for axis in built.spec.rig.table.axis)
        raise LogError(f"the log has no angles of the table ({names}), which are the reference")
    places = _places_of(built, log, chosen)
    if log.readings is None:
        assert log.table_angle_rad is not None
        return log.table_angle_rad[:, places], np.zeros(count, bool)
    angles = np.full((count, len(places)), np.nan)
    for k, place in enumerate(places):
        read = log.readings.of_axis(place, ReadingKind.PLANNED, ReadingKind.STANDING)
        # Where other axes may move an axis stops at the time of its reading, not where it has settled.
        stopped = np.clip(np.searchsorted(log.time_s, read.time_s), 1, count - 1)
        stopped -= read.time_s - log.time_s[stopped - 1] < log.time_s[stopped] - read.time_s
        alone = np.zeros(count, bool) if log.standstill is None else log.standstill >= 0
        rows, of_row = np.unique(np.where(alone[read.row], read.row, stopped), return_inverse=True)
        angles[rows, k] = np.bincount(of_row, read.angle_rad, len(rows)) / np.bincount(of_row, None, len(rows))
    return angles, np.isfinite(angles).sum(axis=1) > 0
