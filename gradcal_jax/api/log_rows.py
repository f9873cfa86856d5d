"""What a log says of its rows: readings of the table, clocks, temperatures, and which rows may be used."""

from collections.abc import Sequence
from dataclasses import replace
from typing import Literal, NamedTuple

import numpy as np

from gradcal_jax import estimation
from gradcal_jax.api.estimate_options import Options
from gradcal_jax.files.log import Log, LogError, ReadingKind
from gradcal_jax.files.quantity import Quantity
from gradcal_jax.files.sensor import HOST_CLOCK
from gradcal_jax.files.spec_sections import Spec

# A comparison of clocks that is no better than this, a ratio, is worth less than a quartz.
_POOR_CLOCK = 2e-5
# A clock without a stated error, a ratio, and the number of standard deviations by which two clocks contradict.
_QUARTZ, _APART = 2e-5, 2.0
# A comparison this near to the computer's own error adds nothing to it.
_AS_COUNTED = 1.1
# Stamps this near to each other are one, s.
_SAME_STAMP_S = 1e-6
_CLOCK_MEND = '[sensor] clock = "sensor" predicts what such a log gives'


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
            raise LogError("the table's angle is missing wherever it stands: it is the reference")
        if not known[standing].all():
            count = int(np.count_nonzero(standing & ~known))
            messages.append(f"{count} rows of rest without a table angle are no reference, and are not read")
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
        known = (
            f"1σ {self.std * 1e6:.2g} ppm" if self.std is not None else "how well that is known the log does not say"
        )
        return f"one second of the sensor's clock is {self.slope:.9f} s of the computer's ({known}{self.since})"


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
    return time, f"{fit.sentence}; rates are integrated over the computer's time"


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
            "the log has no host time, so the sensor's clock cannot be held against it: --clock sensor takes its "
            "stamps as they are"
        )
    starts, stds = _clock_fits(log)
    sensor, host = _centred(log.time_s, starts), _centred(log.host_time_s, starts)
    levers = np.add.reduceat(sensor * sensor, starts)
    if not levers.any():
        raise LogError("no two rows of the log belong together, so the sensor's clock cannot be held against another")
    if stds is None:
        slope = float(sensor @ host / levers.sum())
        spread = float(np.std(host - slope * sensor))
        exact = spread <= np.spacing(max(np.abs(log.time_s).max(), np.abs(log.host_time_s).max()))
        if exact:
            return ClockFit(slope, None, "")
        return ClockFit(slope, spread / float(levers.sum()) ** 0.5, " from the stamps' scatter")
    slopes = np.add.reduceat(sensor * host, starts) / levers
    slope = float(np.average(slopes, weights=stds**-2.0))
    return ClockFit(slope, float(np.sum(stds**-2.0)) ** -0.5, " from when its samples arrived")


def with_options(spec: Spec, logs: Sequence[Log], options: Options) -> tuple[Spec, Options, list[str]]:
    """The spec and the options of an estimate, each with what the other says of the clock; and sentences on a clock
    that contradicts the computer's.

    Where rates are integrated over the computer's time, the clock's error is that of the comparison and of the
    computer's own clock. A rate of the Earth that an option gives is no omitted term of the spec.
    """
    clock, error, said = options.clock or spec.sensor.clock, spec.sensor.sample_clock_error, list[str]()
    both = clock is None and all(default_clock(log) == "host" for log in logs)
    compared = both or clock == "host"
    fits = [clock_fit(log) for log in logs if compared or (log.host_time_s is not None and len(log.time_s) > 1)]
    apart = [fit for fit in fits if abs(fit.slope - 1.0) > _APART * _clocks_differ_by(fit, error)]
    if clock is None:
        # The better of the two, unless the sensor's is contradicted.
        better = error is None or spec.sensor.takes_host_clock or apart
        clock = "host" if both and better else "sensor"
        if clock == "sensor" and spec.sensor.takes_host_clock:
            said.append(
                f"the log does not compare the sensor's clock with the computer's: its {error} count, where a "
                f"prediction of the spec counts {HOST_CLOCK * 1e6:g} ppm; {_CLOCK_MEND}"
            )
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
        used = "the computer's is used" if clock == "host" else "the sensor's is used: --clock host takes the other"
        said.append(
            f"the log's two clocks contradict each other by {abs(fit.slope - 1.0) * 1e6:.4g} ppm, more than "
            f"{_APART:g} times what the sensor's clock is good to: {used}"
        )
    return spec, replace(options, clock=clock), said


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
            raise LogError('the log has no temperature: give that of the recording, such as --temperature "23 degC"')
        return np.full(len(log.time_s), constant_c)
    if constant_c is not None:
        raise LogError("--temperature is for logs without one: this log has its own")
    return values


def table_axis_of(log: Log, axis: str, named: str | None) -> int | None:
    """The table axis that turns a sensor axis; None for a log without table axes. Raises `LogError` where it is
    unclear."""
    if named is not None:
        if named not in log.table_axes:
            raise LogError(f"the log has no table axis '{named}': it has {', '.join(log.table_axes) or 'none'}")
        return log.table_axes.index(named)
    if axis in log.table_axes:
        return log.table_axes.index(axis)
    if len(log.table_axes) == 1:
        return 0
    if not log.table_axes:
        return None
    raise LogError(
        f"which of the table's axes ({', '.join(log.table_axes)}) turns the sensor about {axis}? Name it with "
        "--table-axis"
    )


def count_rows(log: Log, unit: int, used: np.ndarray) -> dict[str, int]:
    """Numbers of rows: ``used``, removed or masked by reason, and without a reference."""
    masked = log.counts(unit)
    usable = masked.pop("used")
    count = int(np.count_nonzero(used & log.usable(unit)))
    return {"used": count, "without a reference": usable - count, **masked}
