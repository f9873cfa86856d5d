"""The rows of a log as an estimate takes them: readings of the table, times, temperatures; which rows may be used."""

from collections.abc import Sequence
from typing import Any, NamedTuple

import numpy as np

from gradcal_jax import estimation
from gradcal_jax.estimation import ImuRows
from gradcal_jax.estimation.clocks import Options, clock_fit, time_of, with_clock
from gradcal_jax.model.build import BuiltImu
from gradcal_jax.records.log import Log, LogError, ReadingKind
from gradcal_jax.spec.absent import absent_lever_arm
from gradcal_jax.spec.changes import changed
from gradcal_jax.spec.plan import StandardPlan
from gradcal_jax.spec.schedule import StandardSchedule
from gradcal_jax.spec.spec_sections import Spec

__all__ = ["Options", "clock_fit", "imu_rows", "table_readings", "time_of", "with_options"]

# Stamps this near to each other are one, s.
_SAME_STAMP_S = 1e-6
# Assumed time between two recordings of one unit in different mountings, s: far longer than any drift lasts.
_REHUNG_S = 6 * 3600.0
# Time over which a temperature is smoothed that nobody controls, and that may turn at once, s.
_UNCONTROLLED_S = 16.0
# Spacing of the readings of a log with the angle at every row, if nothing says it, s.
_READ_EVERY_S = 1.0


class TableReadings(NamedTuple):
    """Rows with a reading of the table `(R,)`, its angle (rad; NaN: unknown), the readings of the spec's noise that it
    is worth, and whether it is stamped as the row's end is."""

    rows: np.ndarray
    angle: np.ndarray
    worth: np.ndarray
    at_end: np.ndarray

    def at_rows(self, count: int) -> tuple[np.ndarray | None, np.ndarray, np.ndarray]:
        """`(count,)`: the angle, interpolated between the readings (None: unknown), whether a row has a reading, and
        what it is worth."""
        reading, worth = np.zeros(count, bool), np.ones(count)
        reading[self.rows], worth[self.rows] = True, self.worth
        known = len(self.rows) > 0 and bool(np.isfinite(self.angle).all())
        return np.interp(np.arange(count), self.rows, self.angle) if known else None, reading, worth


def table_readings(
    log: Log,
    table: int | None,
    standing: np.ndarray,
    every: float,
    messages: list[str],
    noise: float = 0.0,
    *,
    every_kind: bool = False,
) -> tuple[TableReadings, np.ndarray]:
    """The readings of a table axis (its index; None: there is none), and the rows `(n,)` where it stands.

    The log's events that the recipe asked for (`every_kind`: all of the standing axis), of several in one row the mean;
    in a log with the angle at every row those `every` s apart. `noise`: standard deviation of a reading by the spec,
    rad. Raises `LogError` where the angle is missing at rest; adds to `messages` what is left out.
    """
    if table is not None and log.readings is not None:
        kinds = (ReadingKind.PLANNED, ReadingKind.STANDING) if every_kind else (ReadingKind.PLANNED,)
        events = log.readings.of_axis(table, *kinds)
        known = np.isfinite(events.standard_deviation_rad) & (noise > 0.0)
        own = np.where(known, noise / np.where(known, events.standard_deviation_rad, 1.0), 1.0) ** 2
        rows, place = np.unique(events.row, return_inverse=True)
        worth = np.bincount(place, own, len(rows))
        angle = np.bincount(place, own * events.angle_rad, len(rows)) / worth
        late = np.abs(events.time_s - log.time_s[events.row]) > _SAME_STAMP_S
        at_end = np.bincount(place, late, len(rows)) == 0
        return TableReadings(rows, angle, worth, at_end), estimation.standing_with(standing, rows, angle)
    column = None if table is None or log.table_angle_rad is None else log.table_angle_rad[:, table]
    if column is not None:
        known = np.isfinite(column)
        if standing.any() and not known[standing].any():
            raise LogError("the table's angle (the reference) is missing at every standstill")
        if not known[standing].all():
            count = int(np.count_nonzero(standing & ~known))
            messages.append(f"{count} rows at rest without a table angle cannot be a reference, and are not used")
            standing = standing & known
    rows = np.flatnonzero(estimation.column_readings(log.time_s, column, standing, every))
    angle = np.full(len(rows), np.nan) if column is None else column[rows]
    return TableReadings(rows, angle, np.ones(len(rows)), np.ones(len(rows), bool)), standing


def usable_rows(log: Log, unit: int) -> np.ndarray:
    """`(n,)`: whether a row's sample, over the time since the row before it, may be integrated."""
    usable = log.usable(unit).copy()
    usable[log.stretch_starts] = False  # what lay before the row was not recorded
    return usable


def with_options(spec: Spec, logs: Sequence[Log], options: Options) -> tuple[Spec, Options, list[str]]:
    """The spec and the options of an estimate, each with what the other says of the clock, and sentences on it. A lever
    arm of gyros that matters and is not in the spec is estimated, too."""
    spec, options, said = with_clock(spec, logs, options)
    if (arm := absent_lever_arm(spec)) is not None:
        spec = changed(spec, {arm.key: arm.value})
        said.append(
            f"rotation causes a specific force that the g-sensitivity of the gyros turns into a bias; the spec states "
            f"no lever arm, so it is estimated with the prior {arm.key} = {arm.value} (1σ; {arm.source})"
        )
    return spec, options, said


def bridged_temperature(log: Log, unit: int, constant_c: float | None) -> np.ndarray:
    """The thermometer's temperature with gaps interpolated, or `constant_c` (°C) for a log without one."""
    values = log.bridged_temperature(unit)
    if values is None:
        if constant_c is None:
            raise LogError('the log has no temperature: state it with --temperature, such as "23 degC"')
        return np.full(len(log.time_s), constant_c)
    if constant_c is not None:
        raise LogError("--temperature is for logs without temperatures, and this log has temperatures")
    return values


def table_axis_of(log: Log, axis: str) -> int | None:
    """The table axis that turns a sensor axis; None for a log without table axes. Raises `LogError` where it is
    unclear."""
    if axis in log.table_axes:
        return log.table_axes.index(axis)
    if len(log.table_axes) == 1:
        return 0
    if not log.table_axes:
        return None
    raise LogError(
        f"which of the table's axes ({', '.join(log.table_axes)}) turns the sensor about {axis}? Give it the "
        "same name in spec and log"
    )


def count_rows(log: Log, unit: int, used: np.ndarray) -> dict[str, int]:
    """Numbers of rows: ``used``, removed or masked by reason, and without a reference."""
    masked = log.counts(unit)
    usable = masked.pop("used")
    count = int(np.count_nonzero(used & log.usable(unit)))
    return {"used": count, "without a reference": usable - count, **masked}


def imu_rows(built: BuiltImu, logs: Sequence[Log], name: str, options: Options) -> tuple[ImuRows, tuple[str, ...]]:
    """The rows of one unit in all its logs, in order, and messages on what was inferred or left out."""
    parts, messages, end = list[ImuRows](), list[str](), None
    for k, log in enumerate(logs):
        part = _rows_of_log(built, log, name, options, messages)
        begin = part.time_s[0] if end is None else end + _REHUNG_S
        shifted = part.time_s - part.time_s[0] + begin
        mounting = part.mounting if len(logs) == 1 else np.full(len(shifted), k)
        if (highest := int(mounting.max())) >= len(built.spec.rig.table.mounting):
            raise LogError(f"the log was recorded in mounting {highest + 1}, but the spec has no such mounting")
        # A change of the mounting ends a standstill.
        part.standing[np.flatnonzero(np.diff(mounting, prepend=mounting[0] if k == 0 else -1))] = False
        parts.append(part._replace(time_s=shifted, mounting=mounting))
        end = shifted[-1]
    if len(logs) > 1 and built.model.knows_path:
        messages.append(
            "the temperature between the logs is not known: hysteresis terms assume a direct change from one log to "
            "the next, and power-on is assumed at the beginning of the first log"
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


def _rows_of_log(built: BuiltImu, log: Log, name: str, options: Options, messages: list[str]) -> ImuRows:
    number, (time, said) = log.unit_index(name), time_of(log, options)
    messages += said
    rates, force = log.triads(number)
    usable, gyros, missing = usable_rows(log, number), np.zeros(3, bool), []
    for c in built.model.channels:
        known = np.isfinite((rates if c.kind == "gyro" else force)[:, c.axis])
        if not known.any():
            missing.append(c.name.replace("_", " "))
        usable &= known
        gyros[c.axis] |= c.kind == "gyro"
    if missing:
        has = [f"gyro {a}" for a in log.axes] + [f"accelerometer {a}" for a in log.force_axes]
        raise LogError(
            f"the spec calibrates {', '.join(missing)}, but the log has {', '.join(has)}. Log axes are named x, y, z"
        )
    rates[:, ~gyros] = np.nan
    temperature = bridged_temperature(log, number, options.temperature_c)
    over = {"over_s": _UNCONTROLLED_S} if built.spec.rig.chamber.control == "none" else {}
    standing = _standing(built, log, number, usable, messages, has_gyros=bool(gyros.any()))
    rows = ImuRows(
        time_s=time,
        rates=rates,
        force=force,
        temperature_c=estimation.smoothed_temperature(time, temperature, **over),
        angles=np.full((len(time), len(built.spec.rig.table.axis)), np.nan),
        standing=standing,
        usable=usable,
        mounting=np.zeros(len(time), int) if log.mounting is None else log.mounting,
        at_a_stop=np.zeros(len(time), bool),
    )
    if isinstance(built.spec.plan, StandardPlan):
        return rows._replace(table_rate=_table_rate(built, log))
    if built.spec.rig.table.by_gravity:
        # Whatever the log says of angles is where the table was meant to go.
        return rows
    if read_by_events(built.spec):
        return _with_readings(built, log, rows, messages)
    return _with_angles(built, log, rows)


def _standing(
    built: BuiltImu, log: Log, number: int, usable: np.ndarray, messages: list[str], *, has_gyros: bool
) -> np.ndarray:
    """`(n,)`: whether the whole table stands, by the log or else by the gyros (also by those that are not calibrated: a
    turn about another axis is no rest)."""
    by_gravity = built.spec.rig.table.by_gravity
    if log.standstill is None and isinstance(built.spec.plan, StandardPlan):
        # Its reference is the held rate: nothing is read where the table stands.
        return np.zeros(len(log.time_s), bool)
    if log.standstill is None and not has_gyros:
        raise LogError("a log without gyros must mark its standstills (a column standstill in the column map)")
    standing = np.ones(len(log.time_s), bool)
    if log.standstill is not None:
        standing = log.standstill >= 0
        # One standstill directly follows another where a run was interrupted at rest and resumed at rest elsewhere.
        standing[1:] &= (np.diff(log.standstill) == 0) | ~standing[:-1]
    if log.standstill is None or (by_gravity and has_gyros):
        # Nobody knows but the gyros when a hand, or a motor that was switched off, came to rest.
        quiet = estimation.find_standstills(
            np.nan_to_num(log.rate_rad_per_s[number]), log.sample_interval_s, valid=usable, divide=by_gravity
        )
        standing = standing & (quiet >= 0)
        if log.standstill is None:
            count = int(quiet.max()) + 1
            messages.append(f"the log marks no standstills: {count} were detected where the rates are steady")
    return standing


def read_by_events(spec: Spec) -> bool:
    """Whether the only axis of a table is read while it stands, each reading being a reference."""
    return len(spec.rig.table.axis) == 1 and spec.rig.table.standing == "read"


def _with_readings(built: BuiltImu, log: Log, rows: ImuRows, messages: list[str]) -> ImuRows:
    """The rows with the readings of the only axis."""
    if not log.table_axes or (log.readings is None and log.table_angle_rad is None):
        raise LogError(
            "the log has no table angle, but it is the reference (without --spec, estimate gives the bias over "
            "temperature of a sensor at rest)"
        )
    place, encoder = _places_of(built, log)[0], built.model.encoder
    every = float(encoder.every[0]) if np.isfinite(encoder.every[0]) else _READ_EVERY_S
    read, standing = table_readings(log, place, rows.standing, every, messages, float(encoder.reading[0]))
    worth, at_end = np.ones(len(standing)), np.zeros(len(standing), bool)
    worth[read.rows], at_end[read.rows] = read.worth, read.at_end
    rows.angles[read.rows, 0], rows.at_a_stop[read.rows] = read.angle, True
    return rows._replace(standing=standing, worth=worth, at_end=at_end)


def _table_rate(built: BuiltImu, log: Log) -> np.ndarray:
    """The rate held by the table's only axis, rad/s. Raises `LogError`."""
    place = _places_of(built, log)[0] if log.table_axes else None
    if place is not None and log.table_rate_rad_per_s is not None:
        return log.table_rate_rad_per_s[:, place]
    if place is not None and log.table_angle_rad is not None:
        return np.gradient(log.table_angle_rad[:, place], log.time_s)
    schedule = built.spec.schedule
    assert isinstance(schedule, StandardSchedule)
    if any(schedule.rates):
        raise LogError("the log has no table rate, the reference of the standard method")
    return np.zeros(len(log.time_s))


def _places_of(built: BuiltImu, log: Log) -> list[int]:
    """Where the axes of the spec's table stand among the log's; the only one of both may have two names."""
    names = [axis.name for axis in built.spec.rig.table.axis]
    if len(names) == len(log.table_axes) == 1:
        return [0]
    if missing := [name for name in names if name not in log.table_axes]:
        raise LogError(
            f"the log has no table axis {', '.join(missing)}: it has {', '.join(log.table_axes) or 'none'}. "
            "Use the same names in the spec's [[rig.table.axis]] and in the log's column map"
        )
    return [log.table_axes.index(name) for name in names]


def _with_angles(built: BuiltImu, log: Log, rows: ImuRows) -> ImuRows:
    """The rows with the angles about the spec's axes, in its order, and whether they are readings of standing axes."""
    count = len(log.time_s)
    if log.table_angle_rad is None and log.readings is None:
        names = ", ".join(axis.name for axis in built.spec.rig.table.axis)
        raise LogError(f"the log has no table angles ({names}), but the table angles are the reference")
    places = _places_of(built, log)
    if log.readings is None:
        assert log.table_angle_rad is not None
        return rows._replace(angles=log.table_angle_rad[:, places])
    for k, place in enumerate(places):
        read = log.readings.of_axis(place, ReadingKind.PLANNED, ReadingKind.STANDING)
        # Where other axes may move an axis stops at the time of its reading, not where it has settled.
        stopped = np.clip(np.searchsorted(log.time_s, read.time_s), 1, count - 1)
        stopped -= read.time_s - log.time_s[stopped - 1] < log.time_s[stopped] - read.time_s
        alone = np.zeros(count, bool) if log.standstill is None else log.standstill >= 0
        at, of_row = np.unique(np.where(alone[read.row], read.row, stopped), return_inverse=True)
        rows.angles[at, k] = np.bincount(of_row, read.angle_rad, len(at)) / np.bincount(of_row, None, len(at))
    return rows._replace(at_a_stop=np.isfinite(rows.angles).any(axis=1))
