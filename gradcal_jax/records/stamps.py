"""Time stamps of a recording: the rows whose stamps increase, and the stretches of one even clock.

A row whose stamp does not fit those of most rows (the longest increasing part of them) is removed and counted. Then
intervals are counted in samples:

    lost rows       leave an interval of a whole number of samples, and every later stamp is late by it
    uneven stamps   (bursts, radio events, whole milliseconds) come back to an even clock again and again; rows counted
                    against time give its rate

Where both may be, the answer is a question.
"""

import importlib
from bisect import bisect_left
from typing import Any, Final, Literal

import numpy as np

from gradcal_jax import formulas
from gradcal_jax.records.log import Bools, Finding, Floats, LogError, Whole
from gradcal_jax.tables.section import Section

ABSURD: Final = 1e12
"""A number of this size or larger (time in s, rate or temperature) is not a reading."""
# Rows that count as many; share of rows that may be removed for their stamps; rows on end that are not single outliers.
_MANY, _SHARE, _RESTART = 20, 0.1, 10
# Median intervals that are a gap, unless stamps within so many rows make up for it.
_GAP, _JITTER_ROWS = 1.6, 5
# An interval is short below this share of the median; if more than the second share are, stamps come in bursts.
_SHORT, _OFTEN = 0.3, 0.05
# If more than this share of the intervals are gaps, they must be whole numbers of intervals or of an even clock.
_UNEVEN: Final = 0.005
# Bursts over which a wandering clock is averaged, longest intervals by which stamps may leave it, and usual intervals
# between bursts beyond which one is a pause; bursts come evenly within the last share of their period.
_BURSTS, _WITHIN, _PAUSE, _EVENLY = 40, 1.5, 3.0, 0.02
# Even intervals over those within a burst, from which on stamps are those of arrivals.
_ARRIVALS: Final = 4.0
# Rows in which a pattern of intervals is looked for, its largest length, and its least share of their variance.
_PATTERN_ROWS, _PATTERN, _REPEATS = 1 << 16, 100, 0.3
# Blocks by whose intervals a changed rate is seen, share of a block's intervals that are alike within 10 %, blocks of
# another rate, and the ratio from which on it is another.
_BLOCKS, _ALIKE, _SOME, _CHANGED = 50, 0.8, 5, 1.3


class Policy(Section):
    """What to do with faults of a recording."""

    values: Literal["refuse", "keep"] = "refuse"
    """Signs of wrong units, of uneven or several clocks, and of several sensors in one column: "refuse" makes them an
    error, "keep" only reports them."""


class Findings(list[Finding]):
    """The faults of a recording; `removed`: rows by reason."""

    def __init__(self, policy: Policy) -> None:
        super().__init__()
        self._policy = policy
        self.removed = dict[str, int]()

    def note(self, kind: str, message: str) -> None:
        """What was removed or masked, or is kept."""
        self.append(Finding(kind, message))

    def question(self, kind: str, message: str) -> None:
        """What needs an answer: an error, unless the policy keeps values as they are."""
        if self._policy.values == "refuse":
            raise LogError(f"{message} (the policy treats this fault as an error: see [policy] of the column map)")
        self.note(kind, message)


def counted(count: int) -> str:
    """In words: ``1 row``."""
    return "1 row" if count == 1 else f"{count} rows"


def rows_in_order(time: Floats, found: Findings, rows_before: int = 0) -> Whole:
    """The rows of stamps `(n,)` that increase, in their order. `rows_before`: rows of the source before the first."""
    readable = np.abs(time) < ABSURD
    order = np.flatnonzero(readable)
    stamps = time[order]
    steps = np.diff(stamps)
    if len(stamps) > 5 * _MANY and np.mean(steps <= 0.0) > 0.3:
        low, high = np.quantile(stamps, [0.05, 0.95])
        if high - low <= 10.0 * np.mean(np.abs(steps)):
            raise LogError(
                "the time stamps do not increase from row to row: does the column hold intervals between rows, two "
                "alternating clocks, a counter that wraps every few rows, or times with too few digits? Leave out time "
                "and give sample_rate"
            )
    kept = _increasing(stamps)
    before = np.maximum.accumulate(np.where(kept, stamps, -np.inf))
    alike = ~kept & (stamps == before)
    if np.count_nonzero(alike) > _SHARE * len(time):
        span = float(np.ptp(stamps))
        own = f'"{(len(stamps) - 1) / span:.6g} Hz"' if span > 0.0 else "what it was"
        raise LogError(
            f"of {len(time)} rows {np.count_nonzero(alike)} have the time stamp of an earlier row: are the time stamps "
            f"too coarse to distinguish rows? If so, leave time out and give sample_rate = {own} (the number of rows "
            "divided by the time span). Or are rows of several sensors mixed? If so, select the rows of one sensor "
            "with the key `where`"
        )
    _refuse_restart(stamps, kept, rows_before)
    _refuse_disorder(stamps, kept, ~kept & ~alike)
    for kind, rows, words in (
        ("unreadable row", np.flatnonzero(~readable), "without a readable time"),
        ("damaged stamp", order[~kept & (stamps > before)], "with a time stamp ahead of the rows around them"),
        ("duplicate stamp", order[alike], "with the time stamp of an earlier row"),
        ("unordered stamp", order[~kept & (stamps < before)], "stamped before an earlier row"),
    ):
        if len(rows):
            found.removed[kind] = len(rows)
            found.note(kind, f"{counted(len(rows))} {words}, first row {rows.min()}")
    count = np.count_nonzero(kept)
    if count < 2:
        raise LogError(f"of {len(time)} rows, only {count} have a later time stamp than all earlier rows")
    return order[kept]


def _increasing(time: Floats) -> Bools:
    """`(n,)`: the longest strictly increasing part of stamps."""
    if np.all(np.diff(time) > 0.0):
        return np.ones(len(time), bool)
    ends, last, before = list[float](), list[int](), list[int]()
    for row, stamp in enumerate(time.tolist()):
        place = bisect_left(ends, stamp)
        before.append(last[place - 1] if place else -1)
        if ends[place : place + 1] != [stamp]:
            ends[place : place + 1], last[place : place + 1] = [stamp], [row]
    kept = np.zeros(len(time), bool)
    row = last[-1]
    while row >= 0:
        kept[row] = True
        row = before[row]
    return kept


def _refuse_restart(time: Floats, kept: Bools, rows_before: int) -> None:
    """Raise `LogError` for a clock that steps back and goes on from there: it does not give the order of the rows."""
    for start, stop in formulas.runs(~kept).tolist():
        usual = float(np.median(np.abs(np.diff(time[start:stop])))) if stop - start >= _RESTART else 0.0
        # Rows that are only late lie between two jumps.
        begins = start == 0 or 0.0 < time[start] - time[start - 1] < 3.0 * usual
        ends = stop == len(time) or 0.0 < time[stop] - time[stop - 1] < 3.0 * usual
        if usual > 0.0 and (begins or ends):
            first = max(start - 1, 0)
            steps = np.diff(time[first : stop + 1])
            row = rows_before + first + 1 + int(np.argmin(steps))
            raise LogError(
                f"the clock steps back at row {row}, by {-np.min(steps):.6g} s, and continues from the earlier time: "
                "did the clock restart, or a counter wrap? "
                f'Read the parts separately, with --rows "0..{row}" and --rows "{row}..", or correct the time stamps; '
                "or do rows of another sensor follow? If so, select one sensor's rows with the key `where`"
            )


def _refuse_disorder(time: Floats, kept: Bools, others: Bools) -> None:
    """Raise `LogError` where many rows are out of order, and where stamps of `others` that are not kept lie in a gap of
    those that are: damaged stamps may then be more than the sound ones beyond them."""
    if not others.any():
        return
    sound, removed = time[kept], time[others]
    steps = np.diff(sound, append=np.inf)
    gaps = steps[np.searchsorted(sound, removed) - 1]
    inside = np.isfinite(gaps) & (gaps > _RESTART * np.median(steps))
    many = np.count_nonzero(others) > max(_MANY, _SHARE * len(time))
    if many or inside.any():
        raise LogError(
            f"{counted(len(removed))} have a time stamp before that of an earlier row, or far from those about them: "
            "does the column mix two clocks, or rows of several sensors, does a counter wrap, or were packets late? "
            "Sort the rows, select those of one sensor with where, read a part with --rows, or give sample_rate "
            "instead of time"
        )


def stretches(time: Floats, found: Findings) -> tuple[Floats, Whole]:
    """The times, and the rows at which stretches begin; even times where stamps are uneven but no row is lost."""
    interval = np.diff(time)
    _ask_about_changed_rate(interval, found)
    usual = float(np.median(interval))
    # In pairs of which some have lost a row most intervals are those between pairs.
    short = interval < _SHORT * usual
    if np.mean(short) > _OFTEN:
        usual = float(np.median(interval[short]))
    gaps = _gaps(time, usual)
    uneven = len(gaps) > max(_MANY, _UNEVEN * len(time))
    removed = sum(found.removed.values())
    # Where many rows were removed, some are missing.
    whole = removed <= _OFTEN * len(time)
    even = _even_clock(time, gaps) if uneven and whole else None
    repeats = whole and _repeat_a_pattern(time)
    if even is not None and not repeats and _are_arrivals(time, even, usual):
        found.note(
            "uneven stamps",
            f"the time stamps are uneven, {1e3 * np.quantile(interval, 0.01):.3g} … {1e3 * interval.max():.3g} ms "
            "apart, and no row is missing: the samples are taken as evenly spaced, at "
            f"{1.0 / float(np.mean(np.diff(even))):.6g} Hz on average (to confirm, state this sample_rate instead of "
            "time)",
        )
        return even, np.zeros(1, np.int64)
    longer = interval[gaps] / usual
    if repeats or (uneven and (even is not None or not _are_losses(time, longer, removed > 0))):
        found.question(
            "uneven stamps",
            f"the time stamps are not those of one even clock: half of the rows are less than {1e3 * usual:.3g} ms "
            f"apart, and {len(gaps)} intervals are longer. If no row is missing (rows arrive in bursts, or are stamped "
            f'when they are read), give sample_rate = "{(len(time) - 1) / float(time[-1] - time[0]):.6g} Hz" (rows '
            "over time) instead of time; if rows are missing, give a counter of the samples as `clock`, or set "
            '[policy] values = "keep", which takes the longer intervals as gaps',
        )
    if count := len(gaps):
        found.note(
            "gap",
            f"{count} gap{'s' if count > 1 else ''} with about {min(float(np.sum(longer - 1.0)), 2.0**62):.0f} samples "
            f"dropped, the longest {interval[gaps].max():.3g} s, the first after row {gaps[0]} of the rows that were "
            "kept",
        )
    return time, np.concatenate([[0], gaps + 1]).astype(np.int64)


def _gaps(time: Floats, usual: float) -> Whole:
    """The rows before long intervals. Late stamps are followed by early ones; after a gap they are not."""
    suspect = np.flatnonzero(np.diff(time) > _GAP * usual)
    first = np.maximum(suspect - _JITTER_ROWS, 0)
    last = np.minimum(suspect + 1 + _JITTER_ROWS, len(time) - 1)
    return suspect[(time[last] - time[first]) / usual - (last - first) > _GAP - 1.0]


def _ask_about_changed_rate(interval: Floats, found: Findings) -> None:
    """Intervals `(n,)` that are alike in one part and others in another. Bursts, jitter and losses are in every
    part."""
    size = len(interval) // _BLOCKS
    if size < 4:
        return
    blocks = interval[: size * _BLOCKS].reshape(_BLOCKS, size)
    usual = np.median(blocks, axis=1)
    alike = np.mean(np.abs(blocks / usual[:, None] - 1.0) < 0.1, axis=1) > _ALIKE
    first = usual[np.argmax(alike)]
    other = alike & (np.abs(np.log(usual / first)) > np.log(_CHANGED))
    if min(np.count_nonzero(other), np.count_nonzero(alike & ~other)) >= _SOME:
        at = int(np.argmax(other))
        found.question(
            "changed rate",
            f"rows come at {1.0 / first:.6g} Hz at first, and at {1.0 / usual[at]:.6g} Hz from about row {at * size} "
            "on; a record must have a single sample rate: read the parts separately, with --rows",
        )


def _even_clock(time: Floats, suspects: Whole) -> Floats | None:
    """The even times of stamps `(n,)` with seeming gaps after the rows `suspects`: the line through them, or its
    running mean over many bursts, if all stamps stay within a burst of it; None where there are none."""
    interval = np.diff(time)
    longest = float(np.max(interval))
    if longest > _PAUSE * np.quantile(interval[suspects], 0.95):
        return None
    begins = np.concatenate([[0], suspects + 1])
    sizes, periods = np.diff(begins), np.diff(time[begins])
    most, period = int(np.bincount(sizes).argmax()), float(np.median(periods))
    larger, smaller = np.mean(sizes > most), np.mean(sizes < most)
    # Bursts come evenly, and some have fewer rows, which did not fall into the next one: rows were lost. One that lost
    # its first row begins later.
    lasts = float(np.median(time[begins[1:] - 1] - time[begins[:-1]]))
    if np.quantile(np.abs(periods - period), 0.9) < _EVENLY * period + lasts and larger < 0.1 * smaller:
        return None
    rows = np.arange(len(time), dtype=np.float64)
    line: Any = np.polyval(np.polyfit(rows, time, 1), rows)
    ndimage: Any = importlib.import_module("scipy.ndimage")
    width = 2 * (_BURSTS * len(time) // len(suspects) // 2) + 1
    slow: Floats = ndimage.uniform_filter1d(time - line, width, mode="nearest")
    even = line + slow
    return even if np.ptp(time - even) <= _WITHIN * longest and np.all(np.diff(even) > 0.0) else None


def _are_arrivals(time: Floats, even: Floats, usual: float) -> bool:
    """Whether stamps of `even` times are those of arrivals, in bursts or in whole milliseconds; if the `usual`
    intervals are little shorter than even ones, they may be those of the clock, with losses between."""
    return bool(np.median(np.diff(even)) >= _ARRIVALS * usual) or _in_whole_milliseconds(time, usual)


def _in_whole_milliseconds(time: Floats, usual: float) -> bool:
    """Whether stamps are an even clock's of 500 … 1000 Hz in whole milliseconds: one or two of them apart."""
    places = 1e3 * time
    return bool(np.max(np.abs(places - np.rint(places))) < 1e-3) and abs(1e3 * usual - 1.0) < 1e-3


def _repeat_a_pattern(time: Floats) -> bool:
    """Whether the intervals of stamps `(n,)` repeat a pattern of short and long ones that regular losses leave, and
    uneven stamps of all rows as well: 1, 1, 2. Rows that arrive in bursts are much closer than rows over losses, and
    single rows that are late or missing at random repeat no pattern."""
    interval = np.diff(time[:_PATTERN_ROWS])
    low, high = np.quantile(interval, [0.02, 0.98])
    apart = np.minimum(interval / np.mean(interval[interval <= high]), 4.0)
    in_bursts = np.mean(apart < 0.25) > _SHORT
    if len(interval) < 5 * _MANY or in_bursts or high < _GAP * low or _in_whole_milliseconds(time, float(low)):
        return False
    alike = [np.corrcoef(apart[:-lag], apart[lag:])[0, 1] for lag in range(2, min(_PATTERN, len(apart) // 4))]
    # (Where the rate changes within the record, all are alike.)
    return bool(np.max(alike) - np.median(alike) > _REPEATS)


def _are_losses(time: Floats, intervals: Floats, removed: bool) -> bool:
    """Whether long `intervals` (in usual ones) are those over lost rows: most are whole numbers, and the stamps do not
    come back to an even clock, which they do if rows are only late, or were `removed` evenly."""
    rows = np.arange(len(time), dtype=np.float64)
    apart = time - np.polyval(np.polyfit(rows, time, 1), rows)
    if not removed and np.ptp(apart) <= _WITHIN * float(np.max(np.diff(time))):
        return False
    # The usual interval is known to a few per cent of jitter: only short gaps show whether they are whole numbers.
    short = intervals[intervals < 12.0]
    off = np.abs(short - np.rint(short))
    return len(short) > 0.5 * len(intervals) and float(np.mean(off < 0.3)) > 0.9
