"""From raw columns to a log: faults of recordings, detected, named, and treated by a policy (`Policy` lists them)."""

from collections.abc import Iterator, Mapping
from dataclasses import dataclass, field, fields, replace
from typing import Any, Final, Literal

import numpy as np
from numpy.typing import NDArray

from gradcal_jax import formulas
from gradcal_jax.records.log import (
    Bools,
    Finding,
    Floats,
    Log,
    LogError,
    Reason,
    Whole,
    intervals_within,
    mean_interval,
    without_masked,
)
from gradcal_jax.records.signal_faults import (
    at_a_limit,
    frozen_temperature,
    jumped_temperature,
    quiet_windows,
    wrapped,
)
from gradcal_jax.records.uneven_stamps import (
    against_earlier,
    are_losses,
    changed_rate,
    even_clock,
    like_pauses,
    like_regular_losses,
    refuse_intervals,
    refuse_restart,
    stamps_ahead,
    wander,
)
from gradcal_jax.tables.section import Section

_FASTEST_RATE: Final = 90.0
"""rad/s, 5000 deg/s: a larger rate exceeds the full scale of every sensor that this program calibrates."""
_LARGEST_FORCE: Final = 500.0
"""m/s²: records for a calibration seldom have a larger specific force."""
_NOISIEST: Final = np.radians(300.0) / 60.0
"""rad/√s, 300 deg/√h: a hundred times the angle random walk of the coarsest MEMS gyros on sale."""
_GAP: Final = 1.6
"""Median intervals: a shorter interval between stamps is jitter, not a gap."""
_WINDOW: Final = 5
"""Number of rows on either side within which time stamps may compensate jitter."""
_SHORT, _OFTEN = 0.3, 0.05
"""An interval is short below `_SHORT` medians; if more than this share of them is short, stamps come in bursts."""
_UNEVEN: Final = 0.005
"""If more than this share of the intervals are gaps, they must be whole numbers of intervals."""
_MANY_ROWS: Final = 20
"""Least number of rows that counts as many."""
_COARSE: Final = 0.1
"""Above this fraction, rows with the stamp of another row make the stamps useless, and rows out of order are sorted."""
_SHUFFLED: Final = 0.01
"""If rows are out of order by more than this share of the record's span, the column mixes two clocks."""
_INTERVALS: Final = (2e-5, 1.5)
_LONGEST_S: Final = 14 * 86400.0
"""If the interval between time stamps is outside `_INTERVALS` (s), or the record is longer than `_LONGEST_S`, the unit
of the stamps is taken to be wrong."""
_DRIFT: Final = 50e-6
"""A clock error up to this value is possible with any crystal."""
_OTHER_RATE: Final = 0.2
"""If stamps differ from the stated rate by a larger share than this, a clock error cannot be the reason."""
_FACTORS: Final = (180 / np.pi, 60.0, 1e3, 3600.0)
"""Between units that are taken for one another: if a sensor measures so many times the rate of the table, or so small a
part of it, a unit is wrong."""
_TURNS, _IN_TURNS = 8, 3.0
"""Largest number of sensors whose rows may alternate; least ratio of differences, neighbours over rows of a sensor."""
_ABSURD: Final = 1e12
"""A number of this size or larger (time in s, rate or temperature) is not a reading."""
_WHOLE_ROWS: Final = np.uint16((Reason.LEFT_OUT | Reason.MARKED).value)


class Policy(Section):
    """What to do with faults of a recording."""

    rows: Literal["mask", "refuse"] = "mask"
    """Rows that are missing, unreadable, out of order, saturated, marked or frozen, and gaps: "mask" leaves them out
    and counts them, "refuse" makes them an error."""
    values: Literal["refuse", "keep"] = "refuse"
    """Signs of wrong units, of uneven or several clocks, and of several sensors in one column: "refuse" makes them an
    error, "keep" only reports them."""


_BY_UNIT: Final = ("rate_rad_per_s", "specific_force_m_per_s2", "temperature_c", "second_temperature_c", "marked")


@dataclass
class Columns:
    """The columns of a source in SI, unchecked; shapes as in `Log`."""

    rate_rad_per_s: Floats
    units: tuple[str, ...]
    axes: tuple[str, ...]
    time_s: Floats | None = None
    """`None`: evenly sampled at `sample_rate_hz`."""
    sample_rate_hz: float | None = None
    """The stated sample rate, if there is one."""
    full_scale_rad_per_s: float | None = None
    specific_force_m_per_s2: Floats | None = None
    force_axes: tuple[str, ...] = ()
    temperature_c: Floats | None = None
    second_temperature_c: Floats | None = None
    table_axes: tuple[str, ...] = ()
    table_angle_rad: Floats | None = None
    table_rate_rad_per_s: Floats | None = None
    standstill: Floats | None = None
    """As read: truth values (counted up run by run) or numbers, negative while moving."""
    host_time_s: Floats | None = None
    """Of any origin."""
    marked: Bools | None = None
    """[unit, time]; true if the device marks its output as bad."""
    left_out: Bools | None = None
    """[time]; rows left out on request."""
    rows_before: int = 0
    """Number of rows of the source before the first row here."""
    rows_after: int = 0
    simulated: bool = False
    provenance: Mapping[str, str] = field(default_factory=dict[str, str])

    def part(self, rows: tuple[int, int | None]) -> "Columns":
        """The rows between two numbers alone, the last not included. Raises `LogError` where there are none."""
        count = self.rate_rad_per_s.shape[1]
        first, last = rows[0], count if rows[1] is None else min(rows[1], count)
        if last - first < 2:
            raise LogError(f"the part from row {first} on has fewer than two rows; the log has {count} rows")
        return replace(self.of_rows(slice(first, last)), rows_before=first, rows_after=count - last)

    def of_rows(self, kept: slice | Bools | Whole) -> "Columns":
        """The same of some rows."""
        cut: dict[str, Any] = {}
        for field_ in fields(self):
            array: Any = getattr(self, field_.name)
            if isinstance(array, np.ndarray):
                cut[field_.name] = array[:, kept] if field_.name in _BY_UNIT else array[kept]
        return replace(self, **cut)


def at_rows_with_rates(columns: Columns) -> Columns:
    """The rows in which all rates are given, with the other channels interpolated to their stamps; farther from a
    channel's own rows than three of its intervals it is missing. Rows of one stamp, each of other channels, are one.
    Raises `LogError` where there are no two rows with all rates."""
    columns = _of_one_stamp(columns)
    rated: Bools = np.isfinite(columns.rate_rad_per_s).all(axis=(0, 2)).astype(bool)
    count = len(rated)
    if np.count_nonzero(rated) < 2:
        raise LogError(
            "interpolate: fewer than two rows have all rates; leave out channels with separate rows, or join the rows"
        )
    time = np.arange(count) * 1.0 if columns.time_s is None else columns.time_s

    def between(values: Floats) -> Floats:
        known = np.isfinite(values) & np.isfinite(time)
        x, order = time[known], np.argsort(time[known], kind="stable")
        if len(x) < 2:
            return values[rated]
        x, y, at = x[order], values[known][order], time[rated]
        near = np.searchsorted(x, at).clip(1, len(x) - 1)
        away = np.minimum(np.abs(at - x[near - 1]), np.abs(at - x[near]))
        return np.where(away <= 3.0 * np.median(np.diff(x)), np.interp(at, x, y), np.nan)

    def each(values: Floats | None, axis: int) -> Floats | None:
        return None if values is None else np.apply_along_axis(between, axis, values)

    joined = replace(
        columns.of_rows(rated),
        specific_force_m_per_s2=each(columns.specific_force_m_per_s2, 1),
        temperature_c=each(columns.temperature_c, 1),
        second_temperature_c=each(columns.second_temperature_c, 1),
        table_angle_rad=each(columns.table_angle_rad, 0),
        table_rate_rad_per_s=each(columns.table_rate_rad_per_s, 0),
    )
    return replace(joined, rows_after=count - int(np.count_nonzero(rated)))


def _of_one_stamp(columns: Columns) -> Columns:
    """Rates that stand in rows of their own joined where rows in succession have one stamp and no rate twice."""
    rate, time = columns.rate_rad_per_s.copy(), columns.time_s
    if time is None or np.isfinite(rate).all():
        return columns
    begins = np.flatnonzero(np.diff(time, prepend=np.nan) != 0.0)
    if np.any(np.add.reduceat(np.isfinite(rate), begins, axis=1, dtype=int) > 1):
        return columns
    rate[:, begins] = np.fmax.reduceat(rate, begins, axis=1)
    return replace(columns, rate_rad_per_s=rate)


def examine(columns: Columns, policy: Policy | None = None) -> Log:
    """The log of a source's columns, with every fault treated by the policy.

    Rows are removed only where their stamp is unusable; all others stay, masked unit by unit. Every row is counted: for
    every unit, used, masked and removed rows add up to the rows of the source.

    **Raises:** `LogError` where the policy refuses a fault, and where fewer than two rows are left.
    """
    policy, found, removed = policy or Policy(), _Findings(), dict[str, int]()
    outside = columns.rows_before + columns.rows_after
    if outside:
        removed[Reason.LEFT_OUT.words] = outside
    # Absurd numbers may overflow or divide by zero; the result is absurd too, and compared as such.
    with np.errstate(all="ignore"):
        kept, time = _in_order(_with_values(columns, found, removed), policy, found, removed)
        time, starts = _stretches(time, policy, found, removed)
        kept, status = _masked(kept, time, starts, policy, found)
        for question in _questions(kept, time, starts, status == 0):
            found.add("question", policy.values, 0, question)
        for text in _clock_drifts(kept, time, starts):
            found.add("clock drift", "keep", 0, text)
    of_log = {one.name for one in fields(Log)} & {one.name for one in fields(kept)}
    examined: dict[str, Any] = {name: getattr(kept, name) for name in of_log}
    examined |= {
        "time_s": time,
        "standstill": _numbered(kept.standstill),
        "status": status,
        "stretch_starts": starts,
        "rows_read": columns.rate_rad_per_s.shape[1] + outside,
        "rows_removed": removed,
        "findings": tuple(found),
        "provenance": dict(kept.provenance),
    }
    return without_masked(Log(**examined))


class _Findings(list[Finding]):
    """The faults of a recording, or an error where the policy refuses them."""

    def add(self, kind: str, action: str, count: int, message: str) -> None:
        if action == "refuse":
            raise LogError(f"{message} (the policy treats this fault as an error: see [policy] of the column map)")
        self.append(Finding(kind, action, count, message))


def _with_values(columns: Columns, found: _Findings, removed: dict[str, int]) -> Columns:
    """Without rows of channels that the map does not name, if they are many: they are no rows of the record."""
    held: Bools = np.isfinite(columns.rate_rad_per_s).any(axis=(0, 2)).astype(bool)
    others = {"specific_force_m_per_s2": (0, 2), "temperature_c": 0, "table_angle_rad": 1, "table_rate_rad_per_s": 1}
    for name, axes in others.items():
        values: Floats | None = getattr(columns, name)
        if values is not None:
            held |= np.isfinite(values).any(axis=axes)
    count = int(np.count_nonzero(~held))
    if columns.time_s is None or count < max(_MANY_ROWS, _COARSE * len(held)) or len(held) - count < 2:
        return columns
    removed["empty row"] = count
    text = f"{_rows(count)} have no value in any column of the map, and are left out"
    found.add("empty row", "mask", count, text)
    return columns.of_rows(held)


def _in_order(columns: Columns, policy: Policy, found: _Findings, removed: dict[str, int]) -> tuple[Columns, Floats]:
    """The rows whose time stamps increase, and these stamps."""
    rows = columns.rate_rad_per_s.shape[1]
    if (time := columns.time_s) is None:
        if columns.sample_rate_hz is None:
            raise LogError("the column map has neither a column of time stamps nor a sample rate: give one of them")
        return columns, np.arange(rows, dtype=np.float64) / float(columns.sample_rate_hz)
    order = np.arange(rows, dtype=np.int64)
    readable = np.abs(time) < _ABSURD
    refuse_intervals(time[readable])
    ahead = stamps_ahead(time, readable)
    before, _, unordered = against_earlier(time, readable & ~ahead)
    refuse_restart(time, before, unordered, columns.rows_before)
    count = int(np.count_nonzero(unordered))
    if count > max(_MANY_ROWS, _COARSE * rows):
        back = float(np.max((before - time)[unordered]))
        words = f"{_rows(count)} have a time stamp before that of an earlier row, by up to {back:.6g} s"
        if back > _SHUFFLED * float(np.ptp(time[readable & ~ahead])):
            raise LogError(
                f"{words}: does the column mix two clocks, or rows of several sensors? Select the rows of one sensor "
                "with where, or correct the time stamps"
            )
        action = "refuse" if policy.rows == "refuse" else "sort"
        found.add("rows out of order", action, count, f"{words}; the rows were sorted by time stamp")
        order = np.argsort(np.where(readable & ~ahead, time, np.inf), kind="stable").astype(np.int64)
        time, readable, ahead = time[order] - time[order[0]], readable[order], ahead[order]
    _, duplicate, unordered = against_earlier(time, readable & ~ahead)
    if np.count_nonzero(duplicate) > _COARSE * rows:
        known = time[readable & ~ahead]
        span = float(np.ptp(known))
        own = f'"{(len(known) - 1) / span:.6g} Hz"' if span > 0.0 else "what it was"
        raise LogError(
            f"of {rows} rows {np.count_nonzero(duplicate)} have the time stamp of an earlier row: are the time "
            f"stamps too coarse to distinguish rows? If so, leave time out and give sample_rate = {own} (the "
            "number of rows divided by the time span). Or are rows of several sensors mixed? If so, select the "
            "rows of one sensor with the key `where`"
        )
    kept = readable & ~ahead & ~duplicate & ~unordered
    for kind, bad, words in (
        ("unreadable row", ~readable, "without a readable time"),
        ("damaged stamp", ahead, "with a time stamp ahead of the rows around them"),
        ("duplicate stamp", duplicate, "with the time stamp of an earlier row"),
        ("unordered stamp", unordered, "stamped before an earlier row"),
    ):
        if bad.any():
            removed[kind] = int(np.count_nonzero(bad))
            first = int(order[bad].min())
            found.add(kind, policy.rows, removed[kind], f"{_rows(removed[kind])} {words}, first row {first}")
    if np.count_nonzero(kept) < 2:
        raise LogError(f"of {rows} rows, only {np.count_nonzero(kept)} have a later time stamp than all earlier rows")
    as_they_are = len(order[kept]) == rows and bool(np.all(np.diff(order) == 1))
    return (columns if as_they_are else columns.of_rows(order[kept])), time[kept]


def _stretches(
    time: Floats, policy: Policy, found: _Findings, removed: Mapping[str, int]
) -> tuple[Floats, NDArray[np.int64]]:
    """The times, and the rows at which stretches begin; even times where stamps are uneven but no row is lost."""
    interval = np.diff(time)
    if (changed := changed_rate(interval)) is not None:
        row, first_hz, second_hz = changed
        text = (
            f"rows come at {first_hz:.6g} Hz up to row {row}, and at {second_hz:.6g} Hz after it; a record must "
            f'have a single sample rate: read the parts separately, with --rows "0..{row}" and --rows "{row}.."'
        )
        found.add("changed rate", policy.values, 0, text)
    usual = float(np.median(interval))
    # In pairs of which some have lost a row most intervals are those between pairs.
    short = interval < _SHORT * usual
    if np.mean(short) > _OFTEN:
        usual = float(np.median(interval[short]))
    suspect = np.flatnonzero(interval > _GAP * usual)
    # Late stamps are followed by early ones; after a gap they are not.
    first = np.maximum(suspect - _WINDOW, 0)
    last = np.minimum(suspect + 1 + _WINDOW, len(time) - 1)
    gaps = suspect[(time[last] - time[first]) / usual - (last - first) > _GAP - 1.0]
    even = even_clock(time, gaps)
    over_time = f"{(len(time) - 1) / float(time[-1] - time[0]):.6g} Hz"
    if sum(removed.values()) > _OFTEN * len(time):
        even = None  # it is known that rows are missing
    elif like_regular_losses(time) or (even is not None and like_pauses(time, even[0], usual)):
        text = (
            "the time stamps are uneven in a regular pattern: either rows are missing in this pattern, or none is "
            "missing, and rows are stamped when they are read. If none is missing, give sample_rate = "
            f'"{over_time}" (rows over time) instead of time; if rows are missing, give a counter of the samples as '
            '`clock`, or set [policy] values = "keep", which takes the longer intervals as gaps'
        )
        found.add("uneven stamps", policy.values, 0, text)
        even = None
    lost, longest_s = 0, 0.0
    starts = np.concatenate([[0], gaps + 1]).astype(np.int64)
    if even is not None:
        inside = np.delete(interval, even[1][1:] - 1)
        time, starts, lost = even
        longest_s = float(np.max(np.diff(time)))
        rate = 1.0 / mean_interval(time, intervals_within(time, starts))
        text = (
            f"the time stamps are uneven, {1e3 * np.quantile(interval, 0.01):.3g} … {1e3 * inside.max():.3g} ms apart, "
            f"and {'most rows are present' if lost else 'no row is missing'}: the samples are taken as evenly spaced, "
            f"at {rate:.6g} Hz on average (to confirm, state this sample_rate instead of time)"
        )
        found.add("uneven stamps", "keep", 0, text)
    elif len(gaps):
        longer = interval[gaps] / usual
        if len(gaps) > max(_MANY_ROWS, _UNEVEN * len(time)) and not are_losses(time, longer, removed=bool(removed)):
            text = (
                f"the time stamps are not those of one even clock: half of the rows are less than {1e3 * usual:.3g} "
                f"ms apart, and the {len(gaps)} longer intervals are not like those over lost rows. If rows arrive in "
                f'bursts and none is missing, give sample_rate (such as "{over_time}", rows over time) instead of '
                "time; if the rows are counted, give the counter as `clock`"
            )
            found.add("uneven stamps", policy.values, 0, text)
        lost = round(min(float(np.sum(longer - 1.0)), 2.0**62))
        longest_s = float(np.max(interval[gaps]))
    if len(starts) > 1 and (lost or even is None):
        count = len(starts) - 1
        text = (
            f"{count} gap{'s' if count > 1 else ''} with about {lost} samples dropped, the longest {longest_s:.3g} s, "
            f"the first after row {int(starts[1]) - 1} of the rows that were kept"
        )
        found.add("gap", "refuse" if policy.rows == "refuse" else "split", count, text)
    return time, starts


def _masked(
    columns: Columns, time: Floats, starts: Whole, policy: Policy, found: _Findings
) -> tuple[Columns, NDArray[np.uint16]]:
    """The columns without values in rows that are masked whatever they hold, and the status of every unit's rows."""
    status = np.zeros(columns.rate_rad_per_s.shape[:2], np.uint16)

    def mask(reason: Reason, rows: Bools, words: str) -> None:
        # Rows that are masked whatever their values are have none.
        rows = rows & ((status & _WHOLE_ROWS) == 0)
        count = int(np.count_nonzero(rows))
        if count:
            unit, row = np.argwhere(rows)[0]
            named = f" of unit {columns.units[unit]}" if len(columns.units) > 1 else ""
            found.add(reason.words, policy.rows, count, f"{_rows(count)} {words}, first row {row}{named}")
            status[rows] |= reason.value

    if columns.left_out is not None:
        status[:, columns.left_out] |= Reason.LEFT_OUT.value
    if columns.marked is not None:
        mask(Reason.MARKED, columns.marked, "marked bad by the device")
    columns = _without(columns, status != 0)
    rate, force, warm = columns.rate_rad_per_s, columns.specific_force_m_per_s2, columns.temperature_c
    mask(Reason.MISSING_RATE, np.any(~(np.abs(rate) < _ABSURD), axis=2), "without a rate")
    if (full := columns.full_scale_rad_per_s) is not None:
        mask(Reason.SATURATED, np.any(np.abs(rate) >= full * (1 - 1e-9), axis=2), "at full scale")
    else:
        limit = np.zeros(status.shape, bool)
        for unit, axis in np.ndindex(rate.shape[0], rate.shape[2]):
            limit[unit] |= at_a_limit(rate[unit, :, axis])
        mask(Reason.SATURATED, limit, "stuck at the largest or smallest rate of the record")
    over = np.zeros(status.shape, bool)
    for unit, axis in np.ndindex(rate.shape[0], rate.shape[2]):
        over[unit] |= wrapped(rate[unit, :, axis])
    words = "whose rate wrapped at full scale, from one end of its range to the other: choose a larger full scale"
    mask(Reason.SATURATED, over, words)
    if force is not None:
        mask(Reason.MISSING_FORCE, np.any(~(np.abs(force) < _ABSURD), axis=2), "without a specific force")
    if warm is None:
        return columns, status
    known = np.where(np.abs(warm) < _ABSURD, warm, np.nan)
    # (A sensor without a thermometer lacks none.)
    missing = ~np.isfinite(known) & np.isfinite(known).any(axis=1, keepdims=True)
    mask(Reason.MISSING_TEMPERATURE, missing, "without a temperature")
    jumped = np.stack([jumped_temperature(values, starts) for values in known])
    words = "with a temperature that jumps for a while, as if the thermometer restarted or lost contact"
    mask(Reason.MISSING_TEMPERATURE, jumped, words)
    known[jumped] = np.nan
    frozen = np.stack([frozen_temperature(time, values, starts) for values in known])
    whole: Bools = np.asarray(frozen.all(axis=1), bool)
    if whole.any():
        named = ", ".join(np.array(columns.units)[whole])
        text = f"the temperature of {named} never changes: is it constant, or is the thermometer not connected?"
        found.add("constant temperature", "keep", 0, text)
    words = "with a constant temperature, although the temperature changes in the rest of the record"
    mask(Reason.FROZEN_TEMPERATURE, frozen & ~whole[:, None], words)
    return columns, status


def _questions(columns: Columns, time: Floats, starts: Whole, usable: Bools) -> Iterator[str]:
    """Where values are those of no sensor in the stated unit, or of several sensors in one column."""
    if (question := _interval_question(columns, time, starts)) is not None:
        yield question
    interval = float(np.median(np.diff(time)))
    for unit, name in enumerate(columns.units):
        rows = usable[unit]
        if not rows.any():
            continue
        rate, force, warm = columns.rate_rad_per_s[unit, rows], columns.specific_force_m_per_s2, columns.temperature_c
        large = float(np.percentile(np.abs(rate), 99)) if rate.size else 0.0
        if large > _FASTEST_RATE:
            reached = f"{np.degrees(large):.3g} deg/s"
            yield f"the rates of {name} reach {reached}: does the column map state a unit that is too large?"
        if warm is not None and np.isfinite(warm[unit, rows]).any():
            middle = float(np.nanmedian(warm[unit, rows]))
            if not -100.0 < middle < 200.0:
                yield f"the temperature of {name} is about {middle:.0f} degC: is its unit K, degF, or counts?"
        if force is not None:
            usual = float(np.median(np.linalg.norm(force[unit, rows], axis=1)))
            if usual > _LARGEST_FORCE or (force.shape[2] == 3 and 0.5 < usual < 2.0):
                yield f"the specific force of {name} is usually {usual:.3g} m/s²: is its unit g, or counts?"
        for axis, label in enumerate(columns.axes):
            walk, apart = _least_walk(rate[:, axis], interval), _in_turns(rate[:, axis])
            if walk > _NOISIEST:
                yield (
                    f"axis {label} of {name} is noisier than {np.degrees(walk) * 60:.3g} deg/sqrt(h), and no gyro is "
                    "so noisy: does the column map state rad/s instead of deg/s, or s instead of ms?"
                )
            if apart:
                yield (
                    f"axis {label} of {name}: rows {apart} apart are similar, and neighbouring rows are not: do rows "
                    "of several sensors alternate? If so, select the rows of one sensor with the key `where`"
                )
            yield from _against_table(columns, time, unit, axis, rows)


def _interval_question(columns: Columns, time: Floats, starts: Whole) -> str | None:
    """Where intervals are not those of the stated rate, or of any sensor."""
    interval, length_s = float(np.median(np.diff(time))), float(time[-1] - time[0])
    if (stated := columns.sample_rate_hz) is not None:
        ratio = interval * stated
        apart = f"the intervals of the time stamps are {ratio:.3g} times those of the stated rate"
        decimal = 10.0 ** round(float(np.clip(np.log10(ratio), -300, 300)))
        if decimal != 1.0 and abs(ratio / decimal - 1.0) < 0.1:
            return f"{apart}: are the time stamps in another unit?"
        if abs(mean_interval(time, intervals_within(time, starts)) * stated - 1.0) >= _OTHER_RATE:
            return f"{apart}: are the time stamps clock ticks, or is only every n-th sample recorded?"
        return None
    if _INTERVALS[0] < interval < _INTERVALS[1] and length_s < _LONGEST_S:
        return None
    longest = float(np.max(np.diff(time)))
    if interval < _INTERVALS[1] and longest > 0.5 * length_s:
        raise LogError(
            f"time stamps jump by {longest:.6g} s after row {np.argmax(np.diff(time))}: do they change to another "
            "clock, for example from the time since start to the time of day? Read the parts with --rows"
        )
    return f"time stamps are {interval:.3g} s apart, {length_s:.3g} s in all: are they in another unit?"


def _against_table(columns: Columns, time: Floats, unit: int, axis: int, usable: Bools) -> Iterator[str]:
    """A table axis and a sensor axis with the same motion except for a factor between units."""
    rates = columns.table_rate_rad_per_s
    if rates is None and columns.table_angle_rad is not None:
        rates = np.gradient(columns.table_angle_rad, time, axis=0)
    for k, label in enumerate(columns.table_axes if rates is not None else ()):
        of_table = np.asarray(rates)[:, k]
        rows = usable & np.isfinite(of_table)
        if np.count_nonzero(rows) < 10:
            continue
        turned = of_table[rows] - of_table[rows].mean()
        sensed = columns.rate_rad_per_s[unit, rows, axis] - columns.rate_rad_per_s[unit, rows, axis].mean()
        power = float(np.sqrt((turned @ turned) * (sensed @ sensed)))
        if not 0.0 < power < np.inf or abs(float(turned @ sensed)) < 0.98 * power:
            continue
        slope = abs(float(turned @ sensed / (turned @ turned)))
        if any(abs(ratio * factor - 1.0) < 0.05 for factor in _FACTORS for ratio in (slope, 1.0 / slope)):
            yield (
                f"axis {columns.axes[axis]} of {columns.units[unit]} measures {slope:.4g} times the rate of table axis "
                f"{label}: is a unit wrong (deg instead of rad, per hour or per minute instead of per second)?"
            )


def _in_turns(values: Floats) -> int:
    """How many sensors have their rows in turns: a row is nearer to the one so many later than to the next; or 0."""
    quiet = quiet_windows(values[: 1 << 16])
    if not quiet.size:
        return 0
    lags = range(1, _TURNS + 1)
    apart = [float(np.quantile(np.abs(quiet[:, lag:] - quiet[:, :-lag]), 0.75)) for lag in lags]
    best = int(np.argmax(np.array(apart) <= 1.2 * min(apart)))
    return best + 1 if best and min(apart[:best]) > _IN_TURNS * apart[best] > 0.0 else 0


def _clock_drifts(columns: Columns, time: Floats, starts: Whole) -> Iterator[str]:
    """Sample rates that vary, or that differ from the stated rate or from the computer's clock."""
    within = intervals_within(time, starts)
    stated, host = columns.sample_rate_hz, columns.host_time_s
    if stated is not None and columns.time_s is not None:
        error = mean_interval(time, within) * stated - 1
        if _DRIFT < abs(error) < _OTHER_RATE:
            yield f"the intervals between samples are {error * 1e6:+.0f} ppm longer than at the stated {stated:g} Hz"
    if host is not None and bool(np.all(np.abs(host) < _ABSURD)) and len(host) > 2:
        x, y = time - time.mean(), host - host.mean()
        slope = float(x @ y / (x @ x))
        # Stamps of the host jitter by milliseconds: only a larger deviation is drift.
        uncertain = float(np.std(y - slope * x) / (np.std(x) * np.sqrt(len(x))))
        if abs(slope - 1) > _DRIFT + 3 * uncertain and slope > 0:
            yield f"the sensor's clock is {(1 / slope - 1) * 1e6:+.0f} ppm fast relative to the computer's"
    varies = wander(within)
    if varies > _DRIFT:
        yield f"the sample interval varies by {varies * 1e6:.0f} ppm (rms) during the record"


def _without(columns: Columns, masked: Bools) -> Columns:
    """The columns with NaN in the rows `(units, rows)` that are masked whatever their values are."""
    if not masked.any():
        return columns
    names = ("rate_rad_per_s", "specific_force_m_per_s2", "temperature_c", "second_temperature_c")
    changed = dict[str, Floats]()
    for name in names:
        values: Floats | None = getattr(columns, name)
        if values is not None:
            changed[name] = values.astype(np.float64)
            changed[name][masked] = np.nan
    return replace(columns, **changed)


def _least_walk(values: Floats, interval: float) -> float:
    """The least angle random walk (rad/√s) that neighbouring samples and neighbouring means of 8 and 64 allow.

    From the median of their differences, which is that of the quieter half: the other half may contain motion.
    """
    walks: list[float] = []
    for size in (1, 8, 64):
        means = values[: len(values) // size * size].reshape(-1, size).mean(axis=1)
        if len(means) > 20:
            steps = np.diff(means)
            spread = 1.4826 * float(np.median(np.abs(steps - np.median(steps))))
            walks.append(spread * float(np.sqrt(size * interval / 2)))
    return min(walks, default=0.0)


def _numbered(standstill: Floats | None) -> NDArray[np.int64] | None:
    """Numbers of standstills: from the source, or truth values counted up run by run; -1 while moving."""
    if standstill is None:
        return None
    known = np.where(np.isfinite(standstill), standstill, -1.0)
    if np.isin(known, (0.0, 1.0)).all():
        result = np.full(len(known), -1, np.int64)
        for number, (start, stop) in enumerate(formulas.runs(known == 1.0).tolist()):
            result[start:stop] = number
        return result
    return np.maximum(np.rint(np.clip(known, -1, 2**53)), -1).astype(np.int64)


def _rows(count: int) -> str:
    return "1 row" if count == 1 else f"{count} rows"
