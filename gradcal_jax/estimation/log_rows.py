"""How a log is estimated, what it says of its rows, and the rows as an estimate takes them: readings of the table,
clocks, temperatures and their branches, and which rows may be used."""

import itertools
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from typing import Any, Literal, NamedTuple

import numpy as np

from gradcal_jax import estimation
from gradcal_jax.estimation import ImuRows
from gradcal_jax.model import SECOND
from gradcal_jax.model.build import BuiltImu
from gradcal_jax.records.log import Log, LogError, ReadingKind
from gradcal_jax.spec.absent import absent_lever_arm
from gradcal_jax.spec.changes import changed
from gradcal_jax.spec.plan import StandardPlan
from gradcal_jax.spec.schedule import StandardSchedule
from gradcal_jax.spec.sensor import HOST_CLOCK
from gradcal_jax.spec.spec_sections import Spec
from gradcal_jax.tables.quantity import Quantity


@dataclass(frozen=True)
class Options:
    """Options of an estimate; `estimation.log_flow.estimate` explains each."""

    lag: float | Literal["auto", "fit"] = "auto"
    """Lag of the maps behind the measured temperature, s; "fit": estimated; "auto": estimated, and used if the data
    show one."""
    clock: Literal["sensor", "host"] | None = None
    """None: the spec's clock; if the spec states none and the log has both clocks, the computer's clock."""
    clock_doubt: float = 0.0
    """A further uncertainty of the clock, a ratio; at least what the log's clocks are apart, unless someone chose."""
    temperature_c: float | None = None
    """Temperature of a log without a thermometer, °C."""
    progress: Callable[[str], None] = lambda _: None
    """Called with what is being done."""


# A comparison of clocks that is no better than this, a ratio, is worth less than a quartz.
_POOR_CLOCK = 2e-5
# A clock without a stated error, a ratio, and the number of standard deviations by which two clocks contradict.
_QUARTZ, _APART = 2e-5, 2.0
# From this number on the difference counts as the uncertainty of either clock: nothing tells which of them is wrong.
_DOUBTED = 3.0
# Parts of a log in each of which the ratio of two clocks is compared with its mean: the shortest, s, the fewest rows,
# the most of them, and the number of standard deviations from which on a ratio differs.
_PART_S, _PART_ROWS, _PARTS, _BENT = 120.0, 50, 16, 5.0
# A comparison this near to the computer's own error adds nothing to it.
_AS_COUNTED = 1.1
# Stamps this near to each other are one, s.
_SAME_STAMP_S = 1e-6
_CLOCK_MEND = '[sensor] clock = "sensor" gives the prediction for such a log'


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


class ClockFit(NamedTuple):
    """A log's two clocks: a second of the sensor is `slope` seconds of the computer, to `std` (a ratio; None: the log
    does not say). `since`: how that is known, in words."""

    slope: float
    std: float | None
    since: str

    @property
    def sentence(self) -> str:
        """The comparison in words."""
        known = f"1σ {self.std * 1e6:.2g} ppm" if self.std is not None else "the log does not state its uncertainty"
        return f"one second of the sensor's clock is {self.slope:.9f} s of the computer's clock ({known}{self.since})"


def time_of(log: Log, options: Options) -> tuple[np.ndarray, list[str]]:
    """The times (s) over which rates are integrated, by the chosen clock, and messages on that clock."""
    if (options.clock or default_clock(log)) != "host":
        return log.time_s, []
    time, sentence = host_time(log)
    return time, [sentence]


def host_time(log: Log) -> tuple[np.ndarray, str]:
    """The sensor's time stamps in seconds of the host clock, and a sentence on the comparison of the clocks."""
    fit = clock_fit(log)
    time = log.time_s[0] + fit.slope * (log.time_s - log.time_s[0])
    return time, f"{fit.sentence}; rates are integrated over the time of the computer's clock"


def default_clock(log: Log) -> Literal["sensor", "host"]:
    """The computer's clock, where the log has both and they can be compared better than a quartz is good."""
    try:
        fit = clock_fit(log)
    except LogError:
        return "sensor"
    if fit.std is None:
        # Equal columns are one clock; others that lie on a line to the last digit are two.
        return "sensor" if fit.slope == 1.0 else "host"
    return "host" if fit.std < _POOR_CLOCK else "sensor"


def clock_fit(log: Log) -> ClockFit:
    """The comparison of a log's clocks, by straight lines of one slope. Raises `LogError` without a host time.

    Each unbroken stretch has an offset of its own: at a break the sensor's clock may have been set to the host's.
    """
    if log.host_time_s is None:
        raise LogError(
            "the log has no host time to compare the sensor's clock with: --clock sensor uses the time stamps unchanged"
        )
    starts, stds = _clock_fits(log)
    sensor, host = _centred(log.time_s, starts), _centred(log.host_time_s, starts)
    levers = np.add.reduceat(sensor * sensor, starts)
    if not levers.any():
        raise LogError(
            "no two consecutive rows of the log are usable, so the sensor's clock cannot be compared with another"
        )
    if stds is None:
        slope = float(sensor @ host / levers.sum())
        spread = float(np.std(host - slope * sensor))
        exact = spread <= np.spacing(max(np.abs(log.time_s).max(), np.abs(log.host_time_s).max()))
        if exact:
            return ClockFit(slope, None, "")
        return ClockFit(slope, spread / float(levers.sum()) ** 0.5, " from the scatter of the time stamps")
    slopes = np.add.reduceat(sensor * host, starts) / levers
    slope = float(np.average(slopes, weights=stds**-2.0))
    return ClockFit(slope, float(np.sum(stds**-2.0)) ** -0.5, " from the arrival times of its samples")


def _bend(log: Log, fit: ClockFit) -> float:
    """How far the ratio of the clocks between parts of a log is from its mean, at most, beyond chance and beyond the
    computer's own error. (The log of a run has a line in the place of the computer's stamps.)"""
    starts, stds = _clock_fits(log)
    if log.host_time_s is None or stds is not None or fit.std is None:
        return 0.0
    time, largest = _centred(log.time_s, starts), HOST_CLOCK
    late = _centred(log.host_time_s, starts) - fit.slope * time
    for first, end in itertools.pairwise([*starts.tolist(), len(time)]):
        count = min(int((time[end - 1] - time[first]) / _PART_S), (end - first) // _PART_ROWS, _PARTS)
        if count < 2:
            continue
        edges = np.linspace(first, end, count + 1).astype(int)
        rows = np.diff(edges)
        at, mean = (np.add.reduceat(of[first:end], edges[:-1] - first) / rows for of in (time, late))
        # Of differences of neighbours, which a bend does not change.
        square = np.add.reduceat(np.diff(late[first:end], append=late[end - 1]) ** 2, edges[:-1] - first) / (2.0 * rows)
        slope, std = np.diff(mean) / np.diff(at), np.sqrt((square / rows)[1:] + (square / rows)[:-1]) / np.diff(at)
        largest = max(largest, float(np.max(np.abs(slope), initial=0.0, where=np.abs(slope) > _BENT * std)))
    return largest if largest > HOST_CLOCK else 0.0


def with_options(spec: Spec, logs: Sequence[Log], options: Options) -> tuple[Spec, Options, list[str]]:
    """The spec and the options of an estimate, each with what the other says of the clock; and sentences on a clock
    that contradicts the computer's. A lever arm of gyros that matters and is not in the spec is estimated, too.

    Where rates are integrated over the computer's clock, the clock's error is that of the comparison and of the
    computer's own clock. A rate of the Earth that an option gives is no omitted term of the spec.
    """
    clock, error, said = options.clock or spec.sensor.clock, spec.sensor.sample_clock_error, list[str]()
    both = clock is None and all(default_clock(log) == "host" for log in logs)
    compared = both or clock == "host"
    stamped = [log for log in logs if compared or (log.host_time_s is not None and len(log.time_s) > 1)]
    fits = [clock_fit(log) for log in stamped]
    apart = [fit for fit in fits if abs(fit.slope - 1.0) > _APART * _clocks_differ_by(fit, error)]
    if clock is None:
        # The better of the two, unless the sensor's is contradicted.
        better = error is None or spec.sensor.takes_host_clock or apart
        clock = "host" if both and better else "sensor"
        if clock == "sensor" and spec.sensor.takes_host_clock:
            said.append(
                f"the log does not compare the sensor's clock with the computer's: the estimate assumes a clock error "
                f"of {error}, but a prediction from the spec assumes {HOST_CLOCK * 1e6:g} ppm; {_CLOCK_MEND}"
            )
    if clock == "sensor" and not stamped and float(error or 0.0) > 0.0 and not said:
        said.append(
            "the log does not compare the sensor's clock with the computer's, so it cannot show a clock error beyond "
            f"the stated {error}: such an error is a scale-factor error of the same size, also where it depends on "
            f"temperature, as of a crystal without compensation (some 70 ppm at -20 degC). Log the computer's time, too"
        )
    # Who states which clock counts answers for it.
    chosen = options.clock or spec.sensor.clock
    doubted = [] if chosen else [f for f in apart if abs(f.slope - 1.0) > _DOUBTED * _clocks_differ_by(f, error)]
    bend = max(map(_bend, stamped, fits), default=0.0)
    doubt = max([options.clock_doubt, bend, *(abs(fit.slope - 1.0) for fit in doubted)])
    # Every log has a slope of its own to the host's clock; the error that they share is at most the largest.
    std = max((float(np.hypot(fit.std or 0.0, HOST_CLOCK)) for fit in fits), default=np.inf)
    omitted = spec.sensor.clock is None and error is None
    if not (omitted and clock == "host" and std < _AS_COUNTED * HOST_CLOCK):
        # Otherwise the computer's clock counts as in a prediction: as a term that the spec omits.
        counted: dict[str, object] = {"clock": "sensor"}
        if clock == "host":
            counted["sample_clock_error"] = Quantity.of(std, "ppm")
        spec = spec.model_copy(update={"sensor": spec.sensor.model_copy(update=counted)})
    for fit in apart:
        ending = "" if clock == "host" else "; --clock host uses the computer's clock"
        said.append(
            f"the log's two clocks contradict each other: they differ by {abs(fit.slope - 1.0) * 1e6:.4g} ppm, more "
            f"than {_APART:g} times the uncertainty of the sensor's clock; the "
            f"{'computer' if clock == 'host' else 'sensor'}'s clock is used{ending}"
        )
    if doubted:
        said.append(
            "this difference of the clocks counts as uncertainty of the scale factors, since the computer's clock may "
            "be the wrong one: if the sensor's is as poor, state this as sample_clock_error, or state the clock"
        )
    if bend:
        said.append(
            f"the log's two clocks do not keep one ratio: in parts of the log it differs by up to {bend * 1e6:.3g} ppm "
            "from its mean, which counts as uncertainty of the scale factors: was the computer's clock set during the "
            "log, or does the sensor's depend on temperature?"
        )
    if (arm := absent_lever_arm(spec)) is not None:
        spec = changed(spec, {arm.key: arm.value})
        said.append(
            f"rotation causes a specific force that the g-sensitivity of the gyros turns into a bias; the spec states "
            f"no lever arm, so it is estimated with the prior {arm.key} = {arm.value} (1σ; {arm.source})"
        )
    return spec, replace(options, clock=clock, clock_doubt=doubt), said


def _clocks_differ_by(fit: ClockFit, error: Quantity | None) -> float:
    """Standard deviation of the difference of two clocks, a ratio, by what is stated of them."""
    return float(np.hypot(np.hypot(fit.std or 0.0, HOST_CLOCK), float(error or _QUARTZ)))


def _clock_fits(log: Log) -> tuple[np.ndarray, np.ndarray | None]:
    """The rows at which lines begin, and the standard deviations of their slopes.

    The provenance of a run's log has the lines that were fitted to its host times. Other logs have one line for each
    stretch, and the standard deviations (None) follow from the stamps.
    """
    rows = [int(word) for word in log.provenance.get("clock_from_row", "0").split(", ")]
    stds = np.array([float(word) for word in log.provenance.get("clock_rate_std", "").split(", ") if word])
    if len(rows) != len(stds) or not np.all(stds > 0.0):
        return log.stretch_starts, None
    return np.array(rows), stds


def _centred(values: np.ndarray, starts: np.ndarray) -> np.ndarray:
    """Values less the mean of their stretch."""
    counts = np.diff(starts, append=len(values))
    # Less the stretch's first value first: the mean of a computer's stamps, seconds since 1970, is rounded.
    above = values - np.repeat(values[starts], counts)
    return above - np.repeat(np.add.reduceat(above, starts) / counts, counts)


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
            f"the spec calibrates {', '.join(missing)}, but the log has {', '.join(has)}. Log axes are named x, y, z"
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
            f"the log marks no standstills: {int(standstill.max()) + 1} were detected where the rates are steady"
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
            _table_rate(built, log),
        )
    elif built.spec.rig.table.by_gravity:
        # Whatever the log says of angles is where the table was meant to go.
        angles, at_a_stop = np.full((len(time), len(built.spec.rig.table.axis)), np.nan), np.zeros(len(time), bool)
    elif read_by_events(built.spec):
        known = log.table_axes and (log.readings is not None or log.table_angle_rad is not None)
        place = _places_of(built, log)[0] if known else None
        if not known:
            messages.append(
                "the log has no table angle: the estimate uses only the gyro rates at rest, and the scale factor "
                "is not observable"
            )
        noise = float(built.model.encoder.reading[0])
        read, standing = table_readings(log, place, standing, _spacing(built), messages, noise)
        at_a_stop, worth, at_end = np.zeros(len(time), bool), np.ones(len(time)), np.zeros(len(time), bool)
        at_a_stop[read.rows], worth[read.rows], at_end[read.rows] = True, read.worth, read.at_end
        angles = np.full((len(time), 1), np.nan)
        angles[read.rows, 0] = read.angle
    else:
        angles, at_a_stop = _table_angles(built, log)
    if (second := log.bridged_temperature(number, second=True)) is not None:
        second = estimation.smoothed_temperature(time, second, **over)
    elif any(of.name == SECOND for of in built.model.others):
        raise LogError(
            'the spec has a term by "T2 - T", but the log has no second temperature (in a column map, the '
            "key is second_temperature)"
        )
    return ImuRows(
        time, rates, force, smooth, angles, standing, usable, mounting, at_a_stop, worth, rate, at_end, second
    ), messages


def _spacing(built: BuiltImu) -> float:
    """The spacing of readings at rest, s."""
    every = float(built.model.encoder.every[0])
    return every if np.isfinite(every) else _READ_EVERY_S


def read_by_events(spec: Spec) -> bool:
    """Whether the only axis of a table is read while it stands, each reading being a reference."""
    return len(spec.rig.table.axis) == 1 and spec.rig.table.standing == "read"


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


def _table_angles(built: BuiltImu, log: Log) -> tuple[np.ndarray, np.ndarray]:
    """The table's angles `(n, L)` about the spec's axes, in its order, NaN where not read, and whether a row's are
    readings of standing axes."""
    count = len(log.time_s)
    if log.table_angle_rad is None and log.readings is None:
        names = ", ".join(axis.name for axis in built.spec.rig.table.axis)
        raise LogError(f"the log has no table angles ({names}), but the table angles are the reference")
    places = _places_of(built, log)
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
