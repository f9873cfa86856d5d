"""Faults of time stamps: restarts, changed rates, other numbers; uneven stamps of an even clock (bursts, pairs, whole
ms).

Uneven stamps come back to an even clock again and again, where lost rows leave it for ever:

t_i stamps; a burst begins where an interval is longer than jitter P median time from burst to burst; m rows of most
bursts even the line through all t_i, or its running mean over many bursts, if all t_i stay within a burst of it

A pause between two bursts of much more than P is a gap: it is taken out, the rest is looked at as one, and it is put
back. Where bursts come evenly and some have fewer than m rows, rows were lost within them: the clock has m rows in
P."""

import importlib
from typing import Any, Final

import numpy as np

from gradcal_jax import formulas
from gradcal_jax.records.log import Bools, Floats, LogError, Whole

_MANY, _MANY_ROWS = 0.005, 20
# Bursts over which a wandering clock is averaged, and bursts by which stamps may leave it.
_BURSTS, _WITHIN = 40, 1.5
# Times the usual, beyond which a pause between bursts is a gap; bursts come evenly within this share of their period.
_PAUSE, _EVENLY = 1.6, 0.02
# Rows in which a pattern of intervals is looked for, its largest length, and its least share of their variance; least
# relative deviation of uneven intervals; intervals within bursts, over the mean, and the least share of them.
_PATTERN_ROWS, _PATTERN, _REPEATS, _UNEVEN = 1 << 16, 100, 0.3, 0.15
_CLOSE, _IN_BURSTS = 0.25, 0.3
_MILLISECOND, _OF_A_MILLISECOND = 1e-3, 1e-3
# Gaps of fewer intervals show whether they are whole numbers of intervals, which they are within the second figure.
_SHOWS, _NEAR_WHOLE = 12.0, 0.3
# Intervals of rounded stamps of an even clock differ by less than this factor.
_SHORTEST_GAP: Final = 1.6
# Even intervals over those within a burst: up to the first it is the same clock, from the second on these are arrivals.
_SAME_CLOCK, _ARRIVALS = 1.02, 4.0
# Least share of whole bursts from which their number of rows is known.
_WHOLE: Final = 0.3
# Rows without which stamps are not looked at; share of steps that are not forward, and steps that the stamps then span.
_LOOKED_AT, _NOT_FORWARD, _SPANNED = 100, 0.3, 10.0
# Usual intervals by which damaged stamps are ahead; largest share of rows with such stamps.
_FAR_AHEAD, _DAMAGED = 10.0, 0.1
# Steps back that are a fault of the whole column; rows on end that may be damaged.
_OFTEN_BACK, _LONGEST_AHEAD = 1000, 10_000
# Rows on end behind an earlier stamp that are not single outliers.
_RESTART: Final = 10
_COUNTERS: Final = {
    "32 bits of µs": 2**32 * 1e-6,
    "32 bits of ms": 2**32 * 1e-3,
    "32 bits of ns": 2**32 * 1e-9,
    "24 bits of µs": 2**24 * 1e-6,
    "16 bits of ms": 2**16 * 1e-3,
    "16 bits of µs": 2**16 * 1e-6,
}
# Blocks of rows by whose intervals a changed rate is seen: their number, the share of a block's intervals that are
# alike, within what share, the share of blocks of each rate, and the least ratio of the rates.
_BLOCKS, _EVEN, _ALIKE, _SOME, _CHANGED = 50, 0.8, 0.1, 0.1, 1.3


def against_earlier(time: Floats, readable: Bools) -> tuple[Floats, Bools, Bools]:
    """The latest time before each row, and which rows have it again or an earlier one."""
    earlier = np.maximum.accumulate(np.where(readable, time, -np.inf))
    before = np.concatenate([[-np.inf], earlier[:-1]])[: len(time)]
    return before, readable & (time == before), readable & (time < before)


def stamps_ahead(time: Floats, readable: Bools) -> Bools:
    """`(n,)`: rare rows whose stamps jump far ahead and back again, to where the stamps before them go on: damaged."""
    result = np.zeros(len(time), bool)
    rows = np.flatnonzero(readable)
    own = time[rows]
    if len(own) < _LOOKED_AT:
        return result
    steps = np.diff(own)
    usual = float(np.median(np.abs(steps)))
    good = 0
    latest = own[0]
    backs = np.flatnonzero(steps < -_FAR_AHEAD * usual) + 1
    if len(backs) >= _OFTEN_BACK:
        return result
    for back in backs.tolist():
        # The last row before this one from which the stamps go on here.
        start = max(good, back - _LONGEST_AHEAD)
        highest: Floats = np.maximum.accumulate(own[start:back])
        before = start + int(highest.searchsorted(float(own[back]))) - 1
        if before < start or own[back] <= latest:
            continue
        count = back - before - 1
        jump = own[before + 1] - own[before]
        lasts = own[back] - own[before]
        if jump > _FAR_AHEAD * usual and lasts < jump and lasts < _FAR_AHEAD * usual * (count + 1):
            result[rows[before + 1 : back]] = True
            good, latest = back, own[before]
    return result if np.mean(result) < _DAMAGED else np.zeros(len(time), bool)


def refuse_restart(time: Floats, before: Floats, unordered: Bools, rows_before: int) -> None:
    """Raise `LogError` for a clock that steps back and goes on from there: it does not give the order of the rows."""
    for start, stop in formulas.runs(unordered).tolist():
        usual = float(np.median(np.abs(np.diff(time[start:stop])))) if stop - start >= _RESTART else 0.0
        # Rows that are only late are followed by a jump back to the others' times.
        if usual > 0.0 and (stop == len(time) or time[stop] - time[stop - 1] < 3 * usual):
            step, row = float(before[start] - time[start]), start + rows_before
            turns = [words for words, turn in _COUNTERS.items() if abs(step + usual - turn) < 0.01 * turn]
            raise LogError(
                f"the clock steps back at row {row}, by {step:.6g} s, and continues from the earlier time: "
                + (f"did a counter of {turns[0]} wrap? " if turns else "did the clock restart, or a counter wrap? ")
                + f'Read the parts separately, with --rows "0..{row}" and --rows "{row}..", or correct the time stamps'
                + (
                    ""
                    if turns
                    else "; or do rows of another sensor follow? If so, select one sensor's rows with the key `where`"
                )
            )


def refuse_intervals(time: Floats) -> None:
    """Raise `LogError` for stamps `(n,)` that do not grow from row to row."""
    if len(time) < _LOOKED_AT:
        return
    steps = np.diff(time)
    low, high = np.quantile(time, [0.05, 0.95])
    if np.mean(steps <= 0.0) > _NOT_FORWARD and high - low <= _SPANNED * np.mean(np.abs(steps)):
        raise LogError(
            "the time stamps do not increase from row to row: does the column hold intervals between rows, two "
            "alternating clocks, a counter that wraps every few rows, or times with too few digits? Leave out time "
            "and give sample_rate"
        )


def changed_rate(interval: Floats) -> tuple[int, float, float] | None:
    """Of intervals `(n,)` that are alike in one part and others in another the row of the change, and both rates (Hz);
    None where they do not change so. Bursts, jitter and lost rows are in every part."""
    size = len(interval) // _BLOCKS
    if size < 4:
        return None
    blocks = interval[: size * _BLOCKS].reshape(_BLOCKS, size)
    usual = np.median(blocks, axis=1)
    even = np.mean(np.abs(blocks / usual[:, None] - 1.0) < _ALIKE, axis=1) > _EVEN
    if np.count_nonzero(even) < 2 * _SOME * _BLOCKS:
        return None
    low, high = np.quantile(usual[even], [_SOME, 1.0 - _SOME])
    if high < _CHANGED * low:
        return None
    first = usual[np.argmax(even)]
    other = np.flatnonzero(even & (np.abs(np.log(usual / first)) > np.log(_CHANGED)))[0]
    near = np.log(interval[(start := max(other - 1, 0) * size) : (other + 1) * size])
    row = start + 1 + int(np.argmax(np.abs(near - np.log(usual[other])) < np.abs(near - np.log(first))))
    return row, float(1.0 / first), float(1.0 / usual[other])


def even_clock(time: Floats, suspects: Whole) -> tuple[Floats, Whole, int] | None:
    """Even times, rows at which stretches begin, and the number of lost rows, of stamps `(n,)` with seeming gaps after
    the rows `suspects`; None where they are not of an even clock."""
    count = len(suspects)
    if count < max(_MANY_ROWS, _MANY * len(time)):
        return None
    interval = np.diff(time)
    usual = float(np.median(interval[suspects]))
    # (Shorter ones are of rows lost within a burst.)
    suspects = suspects[interval[suspects] > 0.5 * usual]
    begins = np.concatenate([[0], suspects + 1])
    period = float(np.median(np.diff(time[begins])))
    pauses = suspects[interval[suspects] > usual + _PAUSE * period - min(period, usual)]
    shift = np.zeros(len(time))
    shift[pauses + 1] = interval[pauses] - usual
    shift = np.cumsum(shift)
    joined = time - shift
    rows, sizes, most, lost = _rows_of_clock(joined, begins, period)
    even = _even(joined, rows, count)
    if even is None:
        return None
    starts = np.concatenate([[0], pauses + 1])
    if lost:
        starts = np.union1d(starts, begins[1:][sizes[:-1] < most])
    return even + shift, starts.astype(np.int64), lost + round(float(shift[-1]) / (period / most))


def are_losses(time: Floats, intervals: Floats, *, removed: bool) -> bool:
    """Whether long `intervals` (in usual ones) are those over lost rows: most are whole numbers, and the stamps do not
    come back to an even clock, which they do if rows are only late, or `removed` evenly."""
    rows = np.arange(len(time), dtype=np.float64)
    apart = time - np.polyval(np.polyfit(rows, time, 1), rows)
    if not removed and np.ptp(apart) <= 1.5 * float(np.max(np.diff(time))):
        return False
    # The usual interval is known to a few per cent of jitter: only short gaps show whether they are.
    short = intervals[intervals < _SHOWS]
    off = np.abs(short - np.rint(short))
    return len(short) > 0.5 * len(intervals) and float(np.mean(off < _NEAR_WHOLE)) > 0.9


def like_regular_losses(time: Floats) -> bool:
    """Whether the intervals of stamps `(n,)` repeat a pattern that regular losses leave, and uneven stamps of all rows
    as well: 1, 1, 2. Rows that arrive in bursts are much closer than rows over losses, and single rows that are late
    or missing at random repeat no pattern."""
    interval = np.diff(time[:_PATTERN_ROWS])
    if len(interval) < _LOOKED_AT:
        return False
    usual = float(np.mean(interval[interval <= np.quantile(interval, 0.99)]))
    apart = np.minimum(interval / usual, 4.0) - 1.0
    if np.mean(apart < _CLOSE - 1.0) > _IN_BURSTS or np.std(apart) < _UNEVEN:
        return False
    low, high = np.quantile(interval, [0.02, 0.98])
    if high < _SHORTEST_GAP * low or _in_whole_milliseconds(time, float(low)):
        return False
    count = len(apart)
    power = np.abs(np.fft.rfft(apart - apart.mean(), 2 * count)) ** 2
    alike = np.fft.irfft(power)[: min(_PATTERN, count // 4)]
    # (Where the rate changes within the record, all are alike.)
    return bool(np.max(alike[2:]) - np.median(alike[2:]) > _REPEATS * alike[0])


def like_pauses(time: Floats, even: Floats, usual: float) -> bool:
    """Whether the intervals of the `even` times of stamps are little longer than the `usual` ones within a burst: these
    may be those of the clock, with pauses between."""
    ratio = float(np.median(np.diff(even))) / usual
    return _SAME_CLOCK < ratio < _ARRIVALS and not _in_whole_milliseconds(time, usual)


def _in_whole_milliseconds(time: Floats, usual: float) -> bool:
    """Whether stamps are an even clock's of 500 … 1000 Hz in whole milliseconds: one or two of them apart."""
    places = time / _MILLISECOND
    whole = bool(np.max(np.abs(places - np.rint(places))) < _OF_A_MILLISECOND)
    return whole and abs(usual / _MILLISECOND - 1.0) < _OF_A_MILLISECOND


def _rows_of_clock(time: Floats, begins: Whole, period: float) -> tuple[Floats, Whole, int, int]:
    """Ticks of the clock of each row, rows of each burst, of most bursts, and the number of those lost within."""
    sizes = np.diff(begins, append=len(time))
    most = int(np.bincount(sizes).argmax())
    apart = np.abs(np.diff(time[begins]) - period)
    rows = np.arange(len(time), dtype=np.float64)
    larger, smaller = np.mean(sizes[:-1] > most), np.mean(sizes[:-1] < most)
    evenly = float(np.quantile(apart, 0.9)) < _EVENLY * period
    # (A row that falls into the next burst is not lost.)
    if not (evenly and most > 1 and larger < 0.1 * smaller < 0.1 * (1.0 - _WHOLE)):
        return rows, sizes, max(most, 1), 0
    burst = np.repeat(np.arange(len(sizes)), sizes)
    return burst * most + rows - begins[burst], sizes, most, int(np.sum(most - sizes[:-1]))


def _even(time: Floats, rows: Floats, suspects: int) -> Floats | None:
    slope, first = np.polyfit(rows, time, 1)
    line = first + slope * rows
    burst = _WITHIN * float(np.max(np.diff(time)))
    # The clock may wander slowly: over many bursts.
    ndimage: Any = importlib.import_module("scipy.ndimage")
    width = 2 * (_BURSTS * len(time) // suspects // 2) + 1
    wander: Floats = ndimage.uniform_filter1d(time - line, width, mode="nearest")
    for even in (line, line + wander):
        if np.ptp(time - even) <= burst and np.all(np.diff(even) > 0.0):
            return even
    return None


def wander(interval: Floats) -> float:
    """Deviation of block means of the interval from their mean, beyond jitter; relative rms."""
    size = len(interval) // _BLOCKS
    if size < 4:
        return 0.0
    table = interval[: size * _BLOCKS].reshape(_BLOCKS, size)
    means = table.mean(axis=1)
    # Jitter of stamps cancels in a block except at its ends.
    jitter = np.sqrt(2) * float(np.std(table - means[:, None])) / size
    excess = float(np.var(means)) - 4 * jitter**2
    return float(np.sqrt(max(excess, 0.0))) / float(means.mean())
