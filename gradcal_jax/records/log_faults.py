"""From raw columns to a log: faults of recordings, detected, named, and treated by a policy (`Policy` lists them)."""

from collections.abc import Mapping
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
_NOISIEST: Final = np.radians(300.0) / 60.0
"""rad/√s, 300 deg/√h: a hundred times the angle random walk of the coarsest MEMS gyros on sale."""
_DRIFT: Final = 50e-6
"""A clock error up to this value is possible with any crystal."""
_OTHER_RATE: Final = 0.2
"""If stamps differ from the stated rate by a larger share than this, a clock error cannot be the reason."""
_TURNS, _IN_TURNS = 8, 3.0
"""Largest number of sensors whose rows may alternate; least ratio of differences, neighbours over rows of a sensor."""
_ABSURD: Final = 1e12
"""A number of this size or larger (time in s, rate or temperature) is not a reading."""
_WHOLE_ROWS: Final = Reason.LEFT_OUT | Reason.MARKED
_FACTORS: Final[Mapping[str, float]] = {
    "deg instead of rad, or the reverse": 180 / np.pi,
    "a thousandth": 1e3,
    "per hour instead of per second": 3600.0,
    "per minute instead of per second": 60.0,
}


class Policy(Section):
    """What to do with each kind of fault: "mask" excludes the rows from use and counts them, "split" ends one stretch
    of data and begins another, "keep" only reports the fault, "refuse" makes it an error."""

    unreadable_rows: Literal["mask", "refuse"] = "mask"
    """Rows whose time is not a number."""
    duplicate_stamps: Literal["mask", "refuse"] = "mask"
    """Rows with the same time stamp as an earlier row."""
    unordered_stamps: Literal["mask", "refuse"] = "mask"
    """Rows with a time stamp before that of an earlier row."""
    gaps: Literal["split", "refuse"] = "split"
    """Gaps: long intervals between time stamps, unless the intervals after them are correspondingly shorter."""
    missing_rates: Literal["mask", "refuse"] = "mask"
    """Rates that are not finite numbers."""
    missing_forces: Literal["mask", "refuse"] = "mask"
    """Specific forces that are not finite numbers."""
    saturated: Literal["mask", "keep", "refuse"] = "mask"
    """Rates at full scale, or stuck at the largest or smallest rate of the record."""
    marked: Literal["mask", "keep", "refuse"] = "mask"
    """Rows that the device itself marks as bad."""
    missing_temperatures: Literal["mask", "keep", "refuse"] = "mask"
    """Temperatures that are not finite numbers."""
    frozen_temperatures: Literal["mask", "keep", "refuse"] = "mask"
    """Temperatures that stay constant for a long time in a record in which the temperature changes."""
    wrong_units: Literal["keep", "refuse"] = "refuse"
    """Signs of a wrong unit: values that no sensor has, rates far from the table's, or a wrong sample rate."""
    rows_in_turns: Literal["keep", "refuse"] = "refuse"
    """Rows that alternate, as if several sensors shared one column."""
    changed_rate: Literal["keep", "refuse"] = "refuse"
    """Different sample rates in different parts of the record."""
    clock_drift: Literal["keep", "refuse"] = "keep"
    """Sample rates that vary, or that differ from the stated rate or from the computer's clock."""


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


def examine(columns: Columns, policy: Policy | None = None) -> Log:
    """The log of a source's columns, with every fault treated by the policy.

    Rows are removed only where their stamp is unusable; all others stay, masked unit by unit. Every row is counted: for
    every unit, used, masked and removed rows add up to the rows of the source.

    **Raises:** `LogError` where the policy refuses a fault, and where fewer than two rows are left.
    """
    # Absurd numbers may overflow or divide by zero; the result is absurd too, and compared as such.
    with np.errstate(all="ignore"):
        return _Examination(columns, policy or Policy()).log()


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


class _Examination:
    def __init__(self, columns: Columns, policy: Policy) -> None:
        self.raw = columns
        self.policy = policy
        self.findings: list[Finding] = []
        self.status = np.zeros((0, 0), np.uint16)
        outside = columns.rows_before + columns.rows_after
        self.removed: dict[str, int] = {Reason.LEFT_OUT.words: outside} if outside else {}

    def log(self) -> Log:
        rows = self.raw.rate_rad_per_s.shape[1]
        self.drop_empty_rows()
        time, rows_kept = self.ordered(rows)
        all_kept = np.array_equal(rows_kept, np.arange(len(self.raw.rate_rad_per_s[0]), dtype=np.int64))
        kept = self.raw if all_kept else self.raw.of_rows(rows_kept)
        time, starts = self.stretches(time)
        self.status = np.zeros(kept.rate_rad_per_s.shape[:2], np.uint16)
        if kept.left_out is not None:
            self.status[:, kept.left_out] |= Reason.LEFT_OUT.value
        if kept.marked is not None:
            self.mask(kept.marked, Reason.MARKED, self.policy.marked, "marked bad by the device")
        kept = _without(kept, self.status != 0)
        rate, force = kept.rate_rad_per_s, kept.specific_force_m_per_s2
        self.rates(rate)
        if force is not None:
            missing = np.any(~(np.abs(force) < _ABSURD), axis=2)
            self.mask(missing, Reason.MISSING_FORCE, self.policy.missing_forces, "without a specific force")
            self.force_sizes(force)
        if kept.temperature_c is not None:
            self.temperatures(time, kept.temperature_c, starts)
        self.sizes(time, kept, starts)
        self.clock(time, starts, kept.host_time_s)
        self.in_turns(rate)
        of_log = {field_.name for field_ in fields(Log)}
        as_it_is = {field_.name: getattr(kept, field_.name) for field_ in fields(kept) if field_.name in of_log}
        examined: dict[str, Any] = {
            "time_s": time,
            "standstill": _numbered(kept.standstill),
            "status": self.status,
            "stretch_starts": starts,
            "rows_read": rows + kept.rows_before + kept.rows_after,
            "rows_removed": self.removed,
            "findings": tuple(self.findings),
            "provenance": dict(kept.provenance),
        }
        return without_masked(Log(**as_it_is | examined))

    def drop_empty_rows(self) -> None:
        """Rows of channels that the map does not name, which are many, are no rows of the record."""
        raw = self.raw
        held: Bools = np.isfinite(raw.rate_rad_per_s).any(axis=(0, 2)).astype(bool)
        for values, axes in ((raw.specific_force_m_per_s2, (0, 2)), (raw.temperature_c, (0,))):
            if values is not None:
                held |= np.isfinite(values).any(axis=axes)
        for values in (raw.table_angle_rad, raw.table_rate_rad_per_s):
            if values is not None:
                held |= np.isfinite(values).any(axis=1)
        count = int(np.count_nonzero(~held))
        if raw.time_s is None or count < max(_MANY_ROWS, _COARSE * len(held)) or len(held) - count < 2:
            return
        self.raw = raw.of_rows(held)
        self.removed["empty row"] = count
        text = f"{_rows(count)} have no value in any column of the map, and are left out"
        self.findings.append(Finding("empty row", "mask", count, text))

    def note_fault(self, kind: str, action: str, count: int, message: str) -> None:
        """Note a fault, or raise where the policy refuses it."""
        if action == "refuse":
            raise LogError(f"{message} (the policy treats this fault as an error: see [policy] of the column map)")
        self.findings.append(Finding(kind, action, count, message))

    def wrong_unit(self, question: str) -> None:
        self.note_fault("wrong unit", self.policy.wrong_units, 0, question)

    def mask(self, where: Bools, reason: Reason, action: str, words: str) -> None:
        # Rows that are masked whatever their values are have none.
        where = where & ((self.status & np.uint16(_WHOLE_ROWS.value)) == 0)
        count = int(np.count_nonzero(where))
        if count == 0:
            return
        unit, row = np.argwhere(where)[0]
        named = f" of unit {self.raw.units[unit]}" if len(self.raw.units) > 1 else ""
        self.note_fault(reason.words, action, count, f"{_rows(count)} {words}, first row {row}{named}")
        if action == "mask":
            self.status[where] |= reason.value

    def ordered(self, rows: int) -> tuple[Floats, Whole]:
        """The increasing times, and their rows in the source."""
        raw = self.raw
        if raw.time_s is None:
            if raw.sample_rate_hz is None:
                raise LogError("the column map has neither a column of time stamps nor a sample rate: give one of them")
            return np.arange(rows) / raw.sample_rate_hz, np.arange(rows)
        time, order = raw.time_s, np.arange(len(raw.time_s))
        readable = np.abs(time) < _ABSURD
        refuse_intervals(time[readable])
        ahead = stamps_ahead(time, readable)
        readable &= ~ahead
        before, duplicate, unordered = against_earlier(time, readable)
        refuse_restart(time, before, unordered, raw.rows_before)
        if (count := int(np.count_nonzero(unordered))) > max(_MANY_ROWS, _COARSE * rows):
            back = float(np.max((before - time)[unordered]))
            if back > _SHUFFLED * float(np.ptp(time[readable])):
                raise LogError(
                    f"{_rows(count)} have a time stamp before that of an earlier row, by up to {back:.6g} s: does "
                    "the column mix two clocks, or rows of several sensors? Select the rows of one sensor with "
                    "where, or correct the time stamps"
                )
            text = (
                f"{_rows(count)} have a time stamp before that of an earlier row, by up to {back:.3g} s; the rows "
                "were sorted by time stamp"
            )
            action = "refuse" if self.policy.unordered_stamps == "refuse" else "sort"
            self.note_fault("rows out of order", action, count, text)
            order = np.argsort(np.where(readable, time, np.inf), kind="stable")
            time, readable, ahead = time[order] - time[order[0]], readable[order], ahead[order]
            before, duplicate, unordered = against_earlier(time, readable)
        if np.count_nonzero(duplicate) > _COARSE * rows:
            span = float(np.max(time[readable]) - np.min(time[readable]))
            own = f'"{(np.count_nonzero(readable) - 1) / span:.6g} Hz"' if span > 0.0 else "what it was"
            raise LogError(
                f"of {rows} rows {np.count_nonzero(duplicate)} have the time stamp of an earlier row: are the time "
                f"stamps too coarse to distinguish rows? If so, leave time out and give sample_rate = {own} (the "
                "number of rows divided by the time span). Or are rows of several sensors mixed? If so, select the "
                "rows of one sensor with the key `where`"
            )
        for kind, where, action, words in (
            ("unreadable row", ~readable & ~ahead, self.policy.unreadable_rows, "without a readable time"),
            ("damaged stamp", ahead, self.policy.unreadable_rows, "with a time stamp ahead of the rows around them"),
            ("duplicate stamp", duplicate, self.policy.duplicate_stamps, "with the time stamp of an earlier row"),
            ("unordered stamp", unordered, self.policy.unordered_stamps, "stamped before an earlier row"),
        ):
            count = int(np.count_nonzero(where))
            if count:
                first = int(order[where].min())
                self.note_fault(kind, action, count, f"{_rows(count)} {words}, first row {first}")
                self.removed[kind] = count
        kept = readable & ~duplicate & ~unordered
        if np.count_nonzero(kept) < 2:
            raise LogError(
                f"of {rows} rows, only {np.count_nonzero(kept)} have a later time stamp than all earlier rows"
            )
        return time[kept], order[kept]

    def stretches(self, time: Floats) -> tuple[Floats, NDArray[np.int64]]:
        """The times, and the rows at which stretches begin; even times where stamps are uneven but no row is lost."""
        interval = np.diff(time)
        if (changed := changed_rate(interval)) is not None:
            row, first, second = changed
            text = (
                f"rows come at {first:.6g} Hz up to row {row}, and at {second:.6g} Hz after it; a record must "
                f'have a single sample rate: read the parts separately, with --rows "0..{row}" and --rows "{row}.."'
            )
            self.note_fault("changed rate", self.policy.changed_rate, 0, text)
        usual = float(np.median(interval))
        # In pairs of which some have lost a row most intervals are those between pairs.
        short = interval < _SHORT * usual
        if np.mean(short) > _OFTEN:
            usual = float(np.median(interval[short]))
        suspect = np.flatnonzero(interval > _GAP * usual)
        # Late stamps are followed by early ones; after a gap they are not.
        first = np.maximum(suspect - _WINDOW, 0)
        last = np.minimum(suspect + 1 + _WINDOW, len(time) - 1)
        lost = (time[last] - time[first]) / usual - (last - first)
        gaps = suspect[lost > _GAP - 1.0]
        found = even_clock(time, gaps)
        if sum(self.removed.values()) > _OFTEN * len(time):
            found = None  # it is known that rows are missing
        elif like_regular_losses(time) or (found is not None and like_pauses(time, found[0], usual)):
            self.note_fault("uneven stamps", self.policy.wrong_units, 0, _either(time))
            found = None
        if found is not None:
            even, starts, lost_rows = found
            inside = np.delete(interval, starts[1:] - 1)
            rate = 1.0 / mean_interval(even, intervals_within(even, starts))
            words = "most rows are present" if lost_rows else "no row is missing"
            text = (
                f"the time stamps are uneven, {1e3 * np.quantile(interval, 0.01):.3g} … {1e3 * inside.max():.3g} "
                f"ms apart, and {words}: the samples are taken as evenly spaced, at {rate:.6g} Hz on average (to "
                "confirm, state this sample_rate instead of time)"
            )
            self.note_fault("uneven stamps", "keep", 0, text)
            if lost_rows:
                self.note_gaps(starts[1:] - 1, lost_rows, float(np.max(np.diff(even))))
            return even, starts
        if len(gaps) > max(_MANY_ROWS, _UNEVEN * len(time)) and not are_losses(
            time, interval[gaps] / usual, removed=bool(self.removed)
        ):
            text = (
                f"the time stamps are not those of one even clock: half of the rows are less than {1e3 * usual:.3g} ms "
                f"apart, and the {len(gaps)} longer intervals are not like those over lost rows. If rows arrive in "
                f'bursts and none is missing, give sample_rate (such as "{_over_time(time)}", rows over time) instead '
                "of time; if the rows are counted, give the counter as `clock`"
            )
            self.note_fault("uneven stamps", self.policy.wrong_units, 0, text)
        if len(gaps):
            seconds = float(np.sum(interval[gaps])) - usual * len(gaps)
            self.note_gaps(gaps, round(min(seconds / usual, 2.0**62)), float(np.max(interval[gaps])))
        return time, np.concatenate([[0], gaps + 1]).astype(np.int64)

    def note_gaps(self, gaps: NDArray[np.int64], dropped: int, longest_s: float) -> None:
        text = (
            f"{len(gaps)} gap{'s' if len(gaps) > 1 else ''} with about {dropped} samples dropped, the longest "
            f"{longest_s:.3g} s, the first after row {int(gaps[0])} of the rows that were kept"
        )
        self.note_fault("gap", self.policy.gaps, len(gaps), text)

    def rates(self, rate: Floats) -> None:
        missing = np.any(~(np.abs(rate) < _ABSURD), axis=2)
        self.mask(missing, Reason.MISSING_RATE, self.policy.missing_rates, "without a rate")
        full = self.raw.full_scale_rad_per_s
        if full is not None:
            where = np.asarray(np.any(np.abs(rate) >= full * (1 - 1e-9), axis=2))
            words = "at full scale"
        else:
            where = np.zeros(rate.shape[:2], bool)
            for unit, axis in np.ndindex(rate.shape[0], rate.shape[2]):
                where[unit] |= at_a_limit(rate[unit, :, axis])
            words = "stuck at the largest or smallest rate of the record"
        self.mask(where, Reason.SATURATED, self.policy.saturated, words)
        over = np.zeros(rate.shape[:2], bool)
        for unit, axis in np.ndindex(rate.shape[0], rate.shape[2]):
            over[unit] |= wrapped(rate[unit, :, axis])
        words = "whose rate wrapped at full scale, from one end of its range to the other: choose a larger full scale"
        self.mask(over, Reason.SATURATED, self.policy.saturated, words)

    def temperatures(self, time: Floats, temperature: Floats, starts: NDArray[np.int64]) -> None:
        missing, policy = ~(np.abs(temperature) < _ABSURD), self.policy
        self.mask(missing, Reason.MISSING_TEMPERATURE, policy.missing_temperatures, "without a temperature")
        known = np.where(missing, np.nan, temperature)
        jumped = np.stack([jumped_temperature(values, starts) for values in known])
        words = "with a temperature that jumps for a while, as if the thermometer restarted or lost contact"
        self.mask(jumped, Reason.MISSING_TEMPERATURE, policy.missing_temperatures, words)
        known[jumped] = np.nan
        frozen = np.stack([frozen_temperature(time, values, starts) for values in known])
        whole = [name for name, rows in zip(self.raw.units, frozen, strict=True) if rows.all()]
        if whole:
            text = (
                f"the temperature of {', '.join(whole)} never changes: is the temperature constant, or is the "
                "thermometer not connected?"
            )
            self.note_fault("constant temperature", "keep", 0, text)
            frozen[frozen.all(axis=1)] = False
        words = "with a constant temperature, although the temperature changes in the rest of the record"
        self.mask(frozen, Reason.FROZEN_TEMPERATURE, policy.frozen_temperatures, words)

    def sizes(self, time: Floats, kept: Columns, starts: Whole) -> None:
        rate, temperature, table_rate = kept.rate_rad_per_s, kept.temperature_c, kept.table_rate_rad_per_s
        usable = self.status == 0
        for unit, name in enumerate(self.raw.units):
            rows = usable[unit]
            if not rows.any():
                continue
            large = float(np.percentile(np.abs(rate[unit, rows]), 99))
            if large > _FASTEST_RATE:
                reached = f"{np.degrees(large):.3g} deg/s"
                self.wrong_unit(
                    f"the rates of {name} reach {reached}: does the column map state a unit that is too large?"
                )
            if temperature is not None:
                known = temperature[unit, rows & np.isfinite(temperature[unit])]
                middle = float(np.median(known)) if len(known) else 20.0
                if not -100.0 < middle < 200.0:
                    about = f"{middle:.0f} degC"
                    self.wrong_unit(f"the temperature of {name} is about {about}: is its unit K, degF, or counts?")
        interval = float(np.median(np.diff(time)))
        stated = self.raw.sample_rate_hz
        if stated is not None:
            ratio = interval * stated
            decimal = round(float(np.clip(np.log10(ratio), -300, 300)))
            apart = f"the intervals of the time stamps are {ratio:.3g} times those of the stated rate"
            if decimal != 0 and abs(ratio / 10.0**decimal - 1) < 0.1:
                self.wrong_unit(f"{apart}: are the time stamps in another unit?")
            elif abs(mean_interval(time, intervals_within(time, starts)) * stated - 1) >= _OTHER_RATE:
                self.wrong_unit(f"{apart}: are the time stamps clock ticks, or is only every n-th sample recorded?")
        elif not (_INTERVALS[0] < interval < _INTERVALS[1] and time[-1] - time[0] < _LONGEST_S):
            longest, whole = float(np.max(np.diff(time))), f"{time[-1] - time[0]:.3g} s in all"
            if interval < _INTERVALS[1] and longest > 0.5 * (time[-1] - time[0]):
                raise LogError(
                    f"time stamps jump by {longest:.6g} s after row {np.argmax(np.diff(time))}: do they change to "
                    "another clock, for example from the time since start to the time of day? Read the parts "
                    "with --rows"
                )
            self.wrong_unit(f"time stamps are {interval:.3g} s apart, {whole}: are they in another unit?")
        for unit, axis in np.ndindex(rate.shape[0], rate.shape[2]):
            walk = _least_walk(rate[unit, usable[unit], axis], interval)
            if walk > _NOISIEST:
                self.wrong_unit(
                    f"axis {self.raw.axes[axis]} of {self.raw.units[unit]} is noisier than "
                    f"{np.degrees(walk) * 60:.3g} deg/sqrt(h), and no gyro is so noisy: does the column map state "
                    "rad/s instead of deg/s, or s instead of ms?"
                )
        if table_rate is None and kept.table_angle_rad is not None:
            table_rate = np.gradient(kept.table_angle_rad, time, axis=0)
        if table_rate is not None:
            self.against_table(rate, table_rate, usable)

    def force_sizes(self, force: Floats) -> None:
        """Specific forces beyond an accelerometer of a gyro's unit, or in g."""
        for unit, name in enumerate(self.raw.units):
            if not (rows := self.status[unit] == 0).any():
                continue
            usual = float(np.median(np.linalg.norm(force[unit, rows], axis=1)))
            if usual > _LARGEST_FORCE or (force.shape[2] == 3 and 0.5 < usual < 2.0):
                self.wrong_unit(f"the specific force of {name} is usually {usual:.3g} m/s²: is its unit g, or counts?")

    def against_table(self, rate: Floats, table_rate: Floats, usable: Bools) -> None:
        """A table axis and a sensor axis with the same motion except for a factor between units."""
        for unit, axis in np.ndindex(rate.shape[0], rate.shape[2]):
            for table_axis in range(table_rate.shape[1]):
                reference = table_rate[:, table_axis]
                rows = usable[unit] & np.isfinite(reference)
                if np.count_nonzero(rows) < 10:
                    continue
                x, y = reference[rows] - reference[rows].mean(), rate[unit, rows, axis] - rate[unit, rows, axis].mean()
                power = float(np.sqrt((x @ x) * (y @ y)))
                if power == 0.0 or not np.isfinite(power) or abs(float(x @ y)) < 0.98 * power:
                    continue
                slope = abs(float(x @ y / (x @ x)))
                for words, factor in _FACTORS.items():
                    if abs(slope / factor - 1) < 0.05 or abs(slope * factor - 1) < 0.05:
                        self.wrong_unit(
                            f"axis {self.raw.axes[axis]} of {self.raw.units[unit]} measures {slope:.4g} times the "
                            "rate of "
                            f"table axis {self.raw.table_axes[table_axis]}: is a unit wrong ({words})?"
                        )

    def in_turns(self, rate: Floats) -> None:
        """Rows of several sensors in turns: a row is nearer to the one after next than to the next."""
        for unit, axis in np.ndindex(rate.shape[0], rate.shape[2]):
            quiet = quiet_windows(rate[unit, self.status[unit] == 0, axis][: 1 << 16])
            if not quiet.size:
                continue
            lags = range(1, _TURNS + 1)
            apart = [float(np.quantile(np.abs(quiet[:, lag:] - quiet[:, :-lag]), 0.75)) for lag in lags]
            best = int(np.argmax(np.array(apart) <= 1.2 * min(apart)))
            if best and min(apart[:best]) > _IN_TURNS * apart[best] > 0.0:
                text = (
                    f"axis {self.raw.axes[axis]} of {self.raw.units[unit]}: rows {best + 1} apart are similar, "
                    "and neighbouring rows are not: do rows of several sensors alternate? If so, select the rows of "
                    "one sensor with the key `where`"
                )
                self.note_fault("rows in turns", self.policy.rows_in_turns, 0, text)
                return

    def clock(self, time: Floats, starts: NDArray[np.int64], host: Floats | None) -> None:
        action = self.policy.clock_drift
        within = intervals_within(time, starts)
        stated, mean = self.raw.sample_rate_hz, mean_interval(time, within)
        if stated is not None and self.raw.time_s is not None:
            error = mean * stated - 1
            if _DRIFT < abs(error) < _OTHER_RATE:
                text = (
                    f"the intervals between samples are {error * 1e6:+.0f} ppm longer than at the stated {stated:g} Hz"
                )
                self.note_fault("clock drift", action, 0, text)
        if host is not None and bool(np.all(np.abs(host) < _ABSURD)) and len(host) > 2:
            x, y = time - time.mean(), host - host.mean()
            slope = float(x @ y / (x @ x))
            # Stamps of the host jitter by milliseconds: only a larger deviation is drift.
            uncertain = float(np.std(y - slope * x) / (np.std(x) * np.sqrt(len(x))))
            if abs(slope - 1) > _DRIFT + 3 * uncertain and slope > 0:
                text = f"the sensor's clock is {(1 / slope - 1) * 1e6:+.0f} ppm fast relative to the computer's"
                self.note_fault("clock drift", action, 0, text)
        varies = wander(within)
        if varies > _DRIFT:
            text = f"the sample interval varies by {varies * 1e6:.0f} ppm (rms) during the record"
            self.note_fault("clock drift", action, 0, text)


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


def _over_time(time: Floats) -> str:
    return f"{(len(time) - 1) / float(time[-1] - time[0]):.6g} Hz"


def _either(time: Floats) -> str:
    return (
        "the time stamps are uneven in a regular pattern: either rows are missing in this pattern, or none is missing, "
        "and rows are stamped when they are read. If none is missing, give sample_rate = "
        f'"{_over_time(time)}" (rows over time) instead of time; if rows are missing, give a counter of the samples as '
        '`clock`, or set [policy] wrong_units = "keep", which takes the longer intervals as gaps'
    )


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
