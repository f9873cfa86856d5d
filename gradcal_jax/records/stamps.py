"""Time stamps of a recording: the rows whose stamps increase, and the stretches of one even clock.

A row whose stamp does not fit those of most rows (the longest increasing part of them) is removed and counted. Then
intervals are counted in samples:

    lost rows       leave an interval of a whole number of samples, and every later stamp is late by it
    uneven stamps   (bursts, radio events, whole milliseconds) come back to an even clock again and again; rows counted
                    against time give its rate

Where both may be, the answer is a question.
"""

import bisect
import importlib
from typing import Any, Final, Literal

import numpy as np

from gradcal_jax import formulas
from gradcal_jax.records.log import Bools, Finding, Floats, LogError, Whole
from gradcal_jax.tables.section import Section

ABSURD: Final = 1e12
"""A number of this size or larger (time in s, rate or temperature) is not a reading."""
# Rows that count as many; share of rows that may be removed for their stamps before they are looked at as a whole.
_MANY, _SHARE = 20, 0.1
# Rows on end that are not single outliers; share of the span within which late packets are sorted; share of a gap by
# which stamps in it may differ from the clock at its edge.
_RESTART, _SHUFFLED, _FITS = 10, 0.01, 0.1
# Median intervals that are a gap, unless stamps within so many rows make up for it.
_GAP, _JITTER_ROWS = 1.6, 5
# An interval is short below this share of the median; if more than the second share are, stamps come in bursts.
_SHORT, _OFTEN = 0.3, 0.05
# If more than this share of the intervals are gaps, they must be whole numbers of intervals or of an even clock.
_UNEVEN: Final = 0.005
# Bursts over which a wandering clock is averaged, longest intervals by which stamps may leave it, and usual intervals
# between bursts beyond which one is a pause.
_BURSTS, _WITHIN, _PAUSE = 40, 1.5, 3.0
# Bursts come evenly within this share of their period.
_EVENLY: Final = 0.02
# Rows in which a pattern of intervals is looked for, its largest length, and its least share of their variance.
_PATTERN_ROWS, _PATTERN, _REPEATS = 1 << 16, 100, 0.3
# Even intervals over those within a burst: up to the first it is the same clock, from the second on these are arrivals.
_SAME_CLOCK, _ARRIVALS = 1.02, 4.0
# Blocks by whose intervals a changed rate is seen, share of a block's intervals that are alike within 10 %, share of
# blocks of each rate, and the least ratio of the rates.
_BLOCKS, _EVEN, _SOME, _CHANGED = 50, 0.8, 0.1, 1.3


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

    def rows(self, kind: str, count: int, message: str, done: str = "mask") -> None:
        """Rows that are left out."""
        self.append(Finding(kind, done, count, message))

    def note(self, kind: str, message: str) -> None:
        """What is kept."""
        self.append(Finding(kind, "keep", 0, message))

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
    _refuse_intervals(time[readable])
    order = np.flatnonzero(readable)
    stamps = time[order]
    kept = _increasing(stamps)
    others = np.arange(len(stamps))
    while len(wrong := _off_clock(stamps, kept)):
        others = np.setdiff1d(others, wrong)
        kept[:] = False
        kept[others] = _increasing(stamps[others])
    before = np.maximum.accumulate(np.where(kept, stamps, -np.inf))
    span = float(np.ptp(stamps)) if len(stamps) else 0.0
    alike = np.count_nonzero(~kept & (stamps == before))
    if alike > _SHARE * len(time):
        own = f'"{(len(stamps) - 1) / span:.6g} Hz"' if span > 0.0 else "what it was"
        raise LogError(
            f"of {len(time)} rows {alike} have the time stamp of an earlier row: are the time stamps too coarse to "
            f"distinguish rows? If so, leave time out and give sample_rate = {own} (the number of rows divided by the "
            "time span). Or are rows of several sensors mixed? If so, select the rows of one sensor with the key "
            "`where`"
        )
    _refuse_restart(stamps, kept, rows_before)
    count = int(np.count_nonzero(~kept) - alike)
    if count > max(_MANY, _SHARE * len(time)):
        rows = np.arange(len(stamps))
        back = float(np.max(np.abs(stamps - np.interp(rows, rows[kept], stamps[kept]))))
        words = f"{counted(count)} have a time stamp before that of an earlier row, by up to {back:.6g} s"
        if back > _SHUFFLED * span:
            raise LogError(
                f"{words}: the clock steps back again and again: does the column mix two clocks, or rows of several "
                "sensors, or does a counter wrap? Select the rows of one sensor with where, or give sample_rate"
            )
        found.rows("rows out of order", count, f"{words}; the rows were sorted by time stamp", "sort")
        order = order[np.argsort(stamps, kind="stable")]
        stamps = before = time[order]
        kept = np.diff(stamps, prepend=-np.inf) > 0.0
    for kind, rows, words in (
        ("unreadable row", np.flatnonzero(~readable), "without a readable time"),
        ("damaged stamp", order[~kept & (stamps > before)], "with a time stamp ahead of the rows around them"),
        ("duplicate stamp", order[~kept & (stamps == before)], "with the time stamp of an earlier row"),
        ("unordered stamp", order[~kept & (stamps < before)], "stamped before an earlier row"),
    ):
        if len(rows):
            found.removed[kind] = len(rows)
            found.rows(kind, len(rows), f"{counted(len(rows))} {words}, first row {rows.min()}")
    if np.count_nonzero(kept) < 2:
        count = np.count_nonzero(kept)
        raise LogError(f"of {len(time)} rows, only {count} have a later time stamp than all earlier rows")
    return order[kept]


def _increasing(time: Floats) -> Bools:
    """`(n,)`: the longest strictly increasing part of stamps."""
    if np.all(np.diff(time) > 0.0):
        return np.ones(len(time), bool)
    ends, last = list[float](), list[int]()
    before = np.full(len(time), -1)
    for row, stamp in enumerate(time.tolist()):
        place = bisect.bisect_left(ends, stamp)
        before[row] = last[place - 1] if place else -1
        if place == len(ends):
            ends.append(stamp)
            last.append(row)
        elif stamp < ends[place]:
            ends[place], last[place] = stamp, row
    kept = np.zeros(len(time), bool)
    row = last[-1] if last else -1
    while row >= 0:
        kept[row] = True
        row = before[row]
    return kept


def _off_clock(time: Floats, kept: Bools) -> Whole:
    """The kept rows of stamps `(n,)` that are off the clock of the others: at an end of a record, damaged stamps may be
    more than the sound ones beyond them. They leave a gap, in which stamps of removed rows are where the clock of more
    rows at its edge has them, across the damaged rows."""
    rows, removed = np.flatnonzero(kept), np.flatnonzero(~kept)
    stamps = time[rows]
    after = np.searchsorted(stamps, time[removed])
    inside = (after > 0) & (after < len(rows))
    removed, after = removed[inside], after[inside]
    if not len(removed):
        return removed
    usual = float(np.median(np.diff(stamps)))
    gap = stamps[after] - stamps[after - 1]
    place = np.searchsorted(rows, removed)
    off = np.zeros(len(time), bool)
    for edge, side, own in ((after - 1, 1, after), (after, -1, len(rows) - after)):
        across = side * (place - after)
        error = time[removed] - stamps[edge] - (removed - rows[edge]) * usual
        fits = (across > 0) & (across < own) & (gap > _RESTART * usual) & (np.abs(error) < _FITS * gap)
        for row, at in zip(removed[fits].tolist(), rows[edge[fits]].tolist(), strict=True):
            off[min(row, at) + 1 : max(row, at)] = True
    return np.flatnonzero(off & kept)


def _refuse_intervals(time: Floats) -> None:
    """Raise `LogError` for stamps `(n,)` that do not grow from row to row."""
    if len(time) < 5 * _MANY:
        return
    steps = np.diff(time)
    low, high = np.quantile(time, [0.05, 0.95])
    if np.mean(steps <= 0.0) > 0.3 and high - low <= 10.0 * np.mean(np.abs(steps)):
        raise LogError(
            "the time stamps do not increase from row to row: does the column hold intervals between rows, two "
            "alternating clocks, a counter that wraps every few rows, or times with too few digits? Leave out time "
            "and give sample_rate"
        )


def _refuse_restart(time: Floats, kept: Bools, rows_before: int) -> None:
    """Raise `LogError` for a clock that steps back and goes on from there: it does not give the order of the rows."""
    for start, stop in formulas.runs(~kept).tolist():
        usual = float(np.median(np.abs(np.diff(time[start:stop])))) if stop - start >= _RESTART else 0.0
        # Rows that are only late lie between two jumps.
        begins = start == 0 or 0.0 < time[start] - time[start - 1] < 3.0 * usual
        ends = stop == len(time) or 0.0 < time[stop] - time[stop - 1] < 3.0 * usual
        if usual == 0.0 or not (begins or ends):
            continue
        steps = np.diff(time[max(start - 1, 0) : stop + 1])
        row = max(start - 1, 0) + 1 + int(np.argmin(steps))
        step = float(-np.min(steps))
        row += rows_before
        raise LogError(
            f"the clock steps back at row {row}, by {step:.6g} s, and continues from the earlier time: "
            "did the clock restart, or a counter wrap? "
            f'Read the parts separately, with --rows "0..{row}" and --rows "{row}..", or correct the time stamps; or '
            "do rows of another sensor follow? If so, select one sensor's rows with the key `where`"
        )


def stretches(time: Floats, found: Findings) -> tuple[Floats, Whole]:
    """The times, and the rows at which stretches begin; even times where stamps are uneven but no row is lost."""
    interval = np.diff(time)
    if (changed := _changed_rate(interval)) is not None:
        row, first_hz, second_hz = changed
        found.question(
            "changed rate",
            f"rows come at {first_hz:.6g} Hz up to row {row}, and at {second_hz:.6g} Hz after it; a record must have a "
            f'single sample rate: read the parts separately, with --rows "0..{row}" and --rows "{row}.."',
        )
    usual = float(np.median(interval))
    # In pairs of which some have lost a row most intervals are those between pairs.
    short = interval < _SHORT * usual
    if np.mean(short) > _OFTEN:
        usual = float(np.median(interval[short]))
    gaps = _gaps(time, usual)
    removed = sum(found.removed.values())
    # Where many rows were removed, some are missing.
    even = None if removed > _OFTEN * len(time) else _even_clock(time, gaps)
    own_rate = f'"{(len(time) - 1) / float(time[-1] - time[0]):.6g} Hz" (rows over time)'
    if removed <= _OFTEN * len(time) and (
        _like_regular_losses(time) or (even is not None and _like_pauses(time, even, usual))
    ):
        even = None
        found.question(
            "uneven stamps",
            "the time stamps are uneven in a regular pattern: either rows are missing in this pattern, or none is "
            f"missing, and rows are stamped when they are read. If none is missing, give sample_rate = {own_rate} "
            "instead of time; if rows are missing, give a counter of the samples as `clock`, or set [policy] values = "
            '"keep", which takes the longer intervals as gaps',
        )
    starts = np.concatenate([[0], gaps + 1]).astype(np.int64)
    lost, longest_s = 0, float(np.max(interval[gaps], initial=0.0))
    if even is not None:
        time, starts = even, np.zeros(1, np.int64)
        found.note(
            "uneven stamps",
            f"the time stamps are uneven, {1e3 * np.quantile(interval, 0.01):.3g} … {1e3 * interval.max():.3g} ms "
            "apart, and no row is missing: the samples are taken as evenly spaced, at "
            f"{1.0 / float(np.mean(np.diff(time))):.6g} Hz on average (to confirm, state this sample_rate instead of "
            "time)",
        )
    elif len(gaps):
        longer = interval[gaps] / usual
        lost = round(min(float(np.sum(longer - 1.0)), 2.0**62))
        if len(gaps) > max(_MANY, _UNEVEN * len(time)) and not _are_losses(time, longer, removed > 0):
            found.question(
                "uneven stamps",
                f"the time stamps are not those of one even clock: half of the rows are less than {1e3 * usual:.3g} ms "
                f"apart, and the {len(gaps)} longer intervals are not like those over lost rows. If rows arrive in "
                f"bursts and none is missing, give sample_rate, such as {own_rate}, instead of time; if the rows are "
                "counted, give the counter as `clock`",
            )
    count = len(starts) - 1
    if count:
        found.rows(
            "gap",
            count,
            f"{count} gap{'s' if count > 1 else ''} with about {lost} samples dropped, the longest {longest_s:.3g} s, "
            f"the first after row {int(starts[1]) - 1} of the rows that were kept",
            "split",
        )
    return time, starts


def _gaps(time: Floats, usual: float) -> Whole:
    """The rows before long intervals. Late stamps are followed by early ones; after a gap they are not."""
    suspect = np.flatnonzero(np.diff(time) > _GAP * usual)
    first = np.maximum(suspect - _JITTER_ROWS, 0)
    last = np.minimum(suspect + 1 + _JITTER_ROWS, len(time) - 1)
    return suspect[(time[last] - time[first]) / usual - (last - first) > _GAP - 1.0]


def _changed_rate(interval: Floats) -> tuple[int, float, float] | None:
    """Of intervals `(n,)` that are alike in one part and others in another the row of the change, and both rates (Hz);
    None where they do not change so. Bursts, jitter and lost rows are in every part."""
    if (size := len(interval) // _BLOCKS) < 4:
        return None
    blocks = interval[: size * _BLOCKS].reshape(_BLOCKS, size)
    usual = np.median(blocks, axis=1)
    even = np.mean(np.abs(blocks / usual[:, None] - 1.0) < 0.1, axis=1) > _EVEN
    if np.count_nonzero(even) < 2 * _SOME * _BLOCKS:
        return None
    low, high = np.quantile(usual[even], [_SOME, 1.0 - _SOME])
    if high < _CHANGED * low:
        return None
    # The first row whose intervals up to the next block are nearer to the other rate.
    first = usual[np.argmax(even)]
    other = high if first < np.sqrt(low * high) else low
    nearer = np.abs(np.log(interval / other)) < np.abs(np.log(interval / first))
    ahead = np.convolve(nearer, np.ones(size), "full")[size - 1 :]
    row = int(np.argmax(nearer & (ahead > _EVEN * size)))
    return row + 1, float(1.0 / first), float(1.0 / other)


def wander(interval: Floats) -> float:
    """Deviation of block means of the interval from their mean, beyond jitter; relative rms."""
    if (size := len(interval) // _BLOCKS) < 4:
        return 0.0
    blocks = interval[: size * _BLOCKS].reshape(_BLOCKS, size)
    means = blocks.mean(axis=1)
    # Jitter of stamps cancels in a block except at its ends.
    jitter = np.sqrt(2) * float(np.std(blocks - means[:, None])) / size
    return float(np.sqrt(max(float(np.var(means)) - 4 * jitter**2, 0.0))) / float(means.mean())


def _even_clock(time: Floats, suspects: Whole) -> Floats | None:
    """The even times of stamps `(n,)` with seeming gaps after the rows `suspects`: the line through them, or its
    running mean over many bursts, if all stamps stay within a burst of it; None where there are none."""
    if len(suspects) < max(_MANY, _UNEVEN * len(time)):
        return None
    interval = np.diff(time)
    longest = float(np.max(interval))
    if longest > _PAUSE * np.quantile(interval[suspects], 0.95):
        return None
    begins = np.concatenate([[0], suspects + 1])
    sizes, periods = np.diff(begins), np.diff(time[begins])
    most, period = int(np.bincount(sizes).argmax()), float(np.median(periods))
    larger, smaller = np.mean(sizes > most), np.mean(sizes < most)
    # Bursts come evenly, and some have fewer rows, which did not fall into the next one: rows were lost.
    if np.quantile(np.abs(periods - period), 0.9) < _EVENLY * period and larger < 0.1 * smaller:
        return None
    rows = np.arange(len(time), dtype=np.float64)
    slope, first = np.polyfit(rows, time, 1)
    line = first + slope * rows
    ndimage: Any = importlib.import_module("scipy.ndimage")
    width = 2 * (_BURSTS * len(time) // len(suspects) // 2) + 1
    slow: Floats = ndimage.uniform_filter1d(time - line, width, mode="nearest")
    for even in (line, line + slow):
        if np.ptp(time - even) <= _WITHIN * longest and np.all(np.diff(even) > 0.0):
            return even
    return None


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


def _like_regular_losses(time: Floats) -> bool:
    """Whether the intervals of stamps `(n,)` repeat a pattern that regular losses leave, and uneven stamps of all rows
    as well: 1, 1, 2. Rows that arrive in bursts are much closer than rows over losses, and single rows that are late
    or missing at random repeat no pattern."""
    interval = np.diff(time[:_PATTERN_ROWS])
    if len(interval) < 5 * _MANY:
        return False
    usual = float(np.mean(interval[interval <= np.quantile(interval, 0.99)]))
    apart = np.minimum(interval / usual, 4.0) - 1.0
    in_bursts = np.mean(apart < -0.75) > 0.3
    low, high = np.quantile(interval, [0.02, 0.98])
    if in_bursts or np.std(apart) < 0.15 or high < _GAP * low or _in_whole_milliseconds(time, float(low)):
        return False
    count = len(apart)
    power = np.abs(np.fft.rfft(apart - apart.mean(), 2 * count)) ** 2
    alike = np.fft.irfft(power)[: min(_PATTERN, count // 4)]
    # (Where the rate changes within the record, all are alike.)
    return bool(np.max(alike[2:]) - np.median(alike[2:]) > _REPEATS * alike[0])


def _like_pauses(time: Floats, even: Floats, usual: float) -> bool:
    """Whether the intervals of the `even` times of stamps are little longer than the `usual` ones within a burst: these
    may be those of the clock, with pauses between."""
    ratio = float(np.median(np.diff(even))) / usual
    return _SAME_CLOCK < ratio < _ARRIVALS and not _in_whole_milliseconds(time, usual)


def _in_whole_milliseconds(time: Floats, usual: float) -> bool:
    """Whether stamps are an even clock's of 500 … 1000 Hz in whole milliseconds: one or two of them apart."""
    places = 1e3 * time
    return bool(np.max(np.abs(places - np.rint(places))) < 1e-3) and abs(1e3 * usual - 1.0) < 1e-3
