"""Standstills of a gyro from its own rates, for recordings without a table's angle.

Two quantities are computed in a window about each row: the spread and the mean of the rates. The spread at rest is the
noise or the vibration of a drive that holds its position, and differs between standstills; the spread of moves is
larger by orders of magnitude. So there are two criteria:

1. quiet stretches: the spread of all axes together is below the geometric mean of the quietest tenth and the largest
   spread (but not below `factor` times the quiet level, since a record may contain no move), and the mean is within the
   largest bias;
2. begin and end of each: the spread stays within `factor` times the stretch's own.

Stretches that are too short are not standstills. Where nothing but gyros tells when a hand is at rest, a slow turn
divides a stretch by its spread.

And whether the gyros agree that a table stands where its standstills begin and end. A gyro that is filtered or delayed,
or a controller that says "in position" too early, shows the end of a move within the standstill; one that says so too
late, or stamps of the wrong clock, its beginning. Each angle is small and the same after every move, so that no test of
single readings need notice it. The same is true of samples that are lost on the ramp of every move.
"""

from typing import NamedTuple

import numpy as np
from scipy.ndimage import uniform_filter1d

from gradcal_jax.formulas import runs

_QUIETEST = 0.10
# Rows of the shortest window.
_FEWEST_ROWS = 4
# Spread of a quantised sensor that changes between two values half of the time or less, in counts.
_FLICKER = 0.3


def find_standstills(
    rate_rad_per_s: np.ndarray,
    sample_interval_s: float,
    *,
    window_s: float = 0.5,
    shortest_s: float = 1.0,
    factor: float = 3.0,
    largest_bias: float = np.radians(10.0),
    valid: np.ndarray | None = None,
    divide: bool = False,
) -> np.ndarray:
    """`(n,)`: the number of the standstill of each row, counted from 0; −1 while moving. Rates `(n, axes)`, rad/s.
    `divide`: a slow turn within a quiet stretch divides it by its spread.

    A window has four rows at least, whatever the sample rate. Errors: `ValueError` where the record is shorter than two
    windows, or nothing is quiet enough.
    """
    width = max(round(window_s / sample_interval_s), _FEWEST_ROWS)
    if len(rate_rad_per_s) < 2 * width:
        raise ValueError("the record is shorter than two windows: standstills cannot be detected")
    usable = np.ones(len(rate_rad_per_s), bool) if valid is None else valid
    mean, spread = _about_each_row(rate_rad_per_s, usable, width)
    # The output of a quantised sensor may be constant: then a share of one count is the level.
    counts = [_least_step(rate_rad_per_s[usable, k]) for k in range(rate_rad_per_s.shape[1])]
    least = _FLICKER * float(np.linalg.norm(counts))
    level = float(np.quantile(spread[usable], _QUIETEST))
    level = max(level, least)
    quiet = max(factor * level, float(np.sqrt(level * np.max(spread[usable]))))
    still = usable & (spread <= quiet) & np.all(np.abs(mean) <= largest_bias, axis=1)
    number = np.full(len(still), -1, np.int64)
    count = 0
    for first, end in runs(still):
        calm = spread[first:end] <= factor * max(float(np.median(spread[first:end])), least)
        # A window that overlaps a move shortens the standstill by half its width at both ends, on the safe side.
        parts = runs(calm) if divide else np.flatnonzero(calm)[[0, -1]][None] + np.array([0, 1])
        for begin, stop in (first + parts).tolist():
            if (stop - begin) * sample_interval_s >= shortest_s:
                number[begin:stop] = count
                count += 1
    if not count:
        raise ValueError(
            f"no part of the record is steady for {shortest_s:g} s: is the sensor ever at rest? Otherwise mark "
            "the standstills yourself"
        )
    return number


def _about_each_row(rate: np.ndarray, usable: np.ndarray, width: int) -> tuple[np.ndarray, np.ndarray]:
    """Means `(n, axes)` and standard deviation of all axes `(n,)` of the usable rates in a window about each row."""
    share = np.maximum(uniform_filter1d(usable.astype(float), width), 1.0 / width)[:, None]
    # About the median, since squares of a large constant would lose digits.
    middle = np.median(rate[usable], axis=0)
    apart = np.where(usable[:, None], rate - middle, 0.0)
    mean = uniform_filter1d(apart, width, axis=0) / share
    square = uniform_filter1d(apart**2, width, axis=0) / share
    return mean + middle, np.sqrt(np.sum(np.maximum(square - mean**2, 0.0), axis=1))


def _least_step(values: np.ndarray) -> float:
    """The smallest difference between values of one axis: a count of a quantised sensor, or almost zero."""
    distinct = np.unique(values[: 1 << 16])
    return float(np.min(np.diff(distinct))) if len(distinct) > 1 else 0.0


# Longest part at either end of a standstill (s), its largest share of it, and the fewest rows of all of it.
_PART_S, _SHARE, _ROWS = 1.0, 0.25, 12
# Time of the move that tells its direction, s.
_BESIDE_S = 0.5
_FEWEST = 4


class Settling(NamedTuple):
    """Mean angle (rad), in the direction of the move, that a gyro turns after standstills begin and before they end,
    with standard deviations."""

    after: float
    after_std: float
    before: float
    before_std: float


def settling(time_s: np.ndarray, rate: np.ndarray, standing: np.ndarray, usable: np.ndarray) -> Settling | None:
    """What a gyro's rates `(n,)` (rad/s) say of the ends of the standstills; None of fewer than four moves."""
    step = np.diff(time_s, prepend=time_s[0])
    rate, fits = np.nan_to_num(rate), usable & np.isfinite(rate)
    interval = float(np.median(step[1:]))
    beside = max(int(_BESIDE_S / interval), 2)
    found = list[list[tuple[float, float]]]([[], []])
    for begin, end in runs(standing).tolist():
        if end - begin < _ROWS or not fits[begin:end].all():
            continue
        part = max(2, min(int(_PART_S / interval), int(_SHARE * (end - begin))))
        middle = rate[begin + part : end - part]
        mean, spread = float(middle.mean()), float(middle.std(ddof=1))
        std = spread * interval * np.sqrt(part + part**2 / len(middle))
        # (The sample of the first row is of the time before it.)
        ends = (
            (slice(begin + 1, begin + part), slice(max(begin - beside, 0), begin)),
            (slice(end - part, end), slice(end, end + beside)),
        )
        for one, (inside, outside) in zip(found, ends, strict=True):
            motion = rate[outside] - mean
            largest = float(motion[np.argmax(np.abs(motion))]) if len(motion) and fits[outside].all() else 0.0
            if spread > 0.0 and abs(largest) > 20.0 * spread:
                one.append((float(np.sum((rate[inside] - mean) * step[inside])) * float(np.sign(largest)), std))
    if min(map(len, found)) < _FEWEST:
        return None
    angles, stds = zip(*(np.array(one).T for one in found), strict=True)
    means = [float(of.mean()) for of in angles]
    known = [float(np.linalg.norm(of)) / len(of) for of in stds]
    return Settling(means[0], known[0], means[1], known[1])


# An interval of so many usual ones lacks a sample, unless stamps within so many rows of it make up for it.
_LOST, _STAMPS = 1.6, 5
# Least steps of a channel that a rate changes by where a repeated value was no measured one.
_STEPS = 2.5


def lost_in_moves(
    time_s: np.ndarray, rate: np.ndarray, standing: np.ndarray, usable: np.ndarray, starts: np.ndarray
) -> tuple[int, float]:
    """How often samples of a gyro are missing or repeated within moves, and the mean over all moves of the angle (rad)
    that is uncertain by it: half the change of rate, times the time without a sample.

    An integration holds the next sample for this time. If samples are lost on the same ramp of every move, the errors
    have the same sign, so they look like a scale factor. Times, rates (rad/s) and truth values of all rows `(n,)`;
    `starts`: rows at which stretches begin, before which nothing is integrated.
    """
    known = np.flatnonzero(np.isfinite(rate))
    begin, end = known[:-1], known[1:]
    # A repeated value is no new sample. (At rest a coarse channel repeats values by nature.)
    fresh = np.concatenate([[True], (rate[end] != rate[begin]) | standing[end]])
    known = known[fresh]
    if len(known) < 2 * _STAMPS:
        return 0, 0.0
    begin, end = known[:-1], known[1:]
    interval, moving = time_s[end] - time_s[begin], ~(standing[begin] & standing[end])
    if not moving.any():
        return 0, 0.0
    # (Of moves alone: a sensor that is read twice as often as it measures repeats every value.)
    usual = float(np.median(interval[moving]))
    at = np.flatnonzero(moving & (interval > _LOST * usual))
    first, last = np.maximum(at - _STAMPS, 0), np.minimum(at + 1 + _STAMPS, len(known) - 1)
    at = at[(time_s[known[last]] - time_s[known[first]]) / usual - (last - first) > _LOST - 1.0]
    unusable = ~(usable & np.isfinite(rate))
    unusable[starts] = True
    marked = np.cumsum(unusable)
    at = at[marked[end[at]] == marked[begin[at]]]
    change = np.abs(rate[end[at]] - rate[begin[at]])
    # (In motion, too, it repeats values, and then changes by one step.)
    wide = change > _STEPS * _least_step(rate[known])
    at, change = at[wide], change[wide]
    uncertain = 0.5 * change * (interval[at] - usual)
    return len(at), float(np.sum(uncertain)) / max(len(runs(~standing)), 1)
