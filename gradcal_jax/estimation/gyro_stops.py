"""What the gyros show of a table's stops: where it stands for an instant between two turns, which axis turned, and what
a row at a stop holds of either turn."""

import numpy as np

from gradcal_jax.estimation.imu_rows import ExecutedImu, ImuRows
from gradcal_jax.motion import Geometry, frames

# The speed at a stop is this many times below that on both sides; speeds below this share of the fastest are noise.
_DIP, _SLOWEST = 10.0, 1e-3
# Least share of an axis's rate along the gyros at which it is observable.
SEEN = 0.3
# The gyros' integral over a move is off the axis by at most this share more than off the nearest axis.
FOLLOWS = 0.05


def stops_between(rates: np.ndarray) -> list[int]:
    """Rows `(n, axes)` at which the table stops for an instant between two turns, counted from the end of each."""
    speed = np.linalg.norm(rates, axis=1)
    top = float(np.max(speed, initial=0.0))
    if top == 0.0:
        return []
    # Noise at a minimum must not divide it into two.
    width = max(len(speed) // 400, 1)
    smooth = np.convolve(np.pad(speed, width, mode="edge"), np.ones(2 * width + 1) / (2 * width + 1), mode="valid")
    # Imported where it is used: it imports all of SciPy's statistics.
    from scipy.signal import find_peaks

    stops = find_peaks(-np.log(np.maximum(smooth, _SLOWEST * top)), prominence=np.log(_DIP))[0]
    # The mean over several rows is least beside the stop, towards the slower move.
    around = [np.arange(max(stop - width, 0), min(stop + width + 1, len(speed))) for stop in stops]
    return [1 + int(rows[np.argmin(speed[rows])]) for rows in around]


def turned_axis(
    geometry: Geometry, at: np.ndarray, mounting: int, total: np.ndarray, goal: np.ndarray | None = None
) -> tuple[int, float]:
    """Axis (and angle, rad) along which the gyros' integral `total` `(3,)` points, NaN where there is no gyro, on a
    table at the angles `at`; of several the one with the angle nearest to its way to the `goal`, if that is known."""
    seen = np.isfinite(total)
    axes, total = frames(geometry, at[None], np.array([mounting])).axes[0][:, seen], total[seen]
    size = np.sum(axes**2, axis=1)
    angle = (axes @ total) / np.maximum(size, SEEN**2)
    missed = np.linalg.norm(total[None] - angle[:, None] * axes, axis=1)
    along = missed <= np.min(missed) + FOLLOWS * np.linalg.norm(total)
    best = (
        int(np.argmin(missed)) if goal is None else int(np.argmin(np.where(along, np.abs(angle - goal + at), np.inf)))
    )
    return best, float(angle[best])


def across_stops(done: ExecutedImu, log: ImuRows) -> np.ndarray:
    """Corrections of the gyros' integrals over every piece `(P, 3)`, rad, where the table stopped for an instant.

    The row of the stop contains the end of one turn and the begin of the next, some tens or hundreds of µrad at 100
    rows/s. Of two axes their different directions separate them, of one axis the slopes of the rate on both sides.
    """
    result, axis, rows = np.zeros((len(done.motion.axis), 3)), done.motion.axis, done.rows
    before, _ = done.motion.angles()
    rests, seen = np.flatnonzero(axis < 0), np.asarray(np.isfinite(log.rates).any(axis=0))
    for k in np.flatnonzero((axis[:-1] >= 0) & (axis[1:] >= 0)):
        stop, place = int(rows[k + 1]), np.searchsorted(rests, k)
        if log.at_end is not None and log.at_end[stop]:
            continue
        beside = rests[max(place - 1, 0) : place + 1]
        still = [np.mean(log.rates[rows[j] + 1 : rows[j + 1] + 1], axis=0) for j in beside]
        # The lines of the rate meet at the bias, 0.3 deg/s of which are 0.1 mrad.
        bias = np.mean(still, axis=0) if still else np.zeros(3)
        late = np.zeros(3)
        if axis[k] == axis[k + 1]:
            near = slice(stop - 3, stop + 4)
            if rows[k] + 3 < stop < rows[k + 2] - 3:
                late = _of_one_axis(log.time_s[near], log.rates[near] - bias)
        elif still:
            near = np.arange(max(rows[k] + 1, stop - 1), min(rows[k + 2], stop + 1) + 1)
            turned = (log.rates[near] - bias) * (log.time_s[near] - log.time_s[near - 1])[:, None]
            axes = frames(done.motion.geometry, before[[k + 1]], done.motion.mounting[[k + 1]]).axes[0]
            late = _of_two_axes(axes[[axis[k], axis[k + 1]]], turned, near <= stop, seen)
        result[k] -= late
        result[k + 1] += late
    return result


def _of_two_axes(axes: np.ndarray, turned: np.ndarray, first: np.ndarray, seen: np.ndarray) -> np.ndarray:
    """What the rows up to a stop (`first`) hold of the second turn, less what those after it hold of the first, rad
    `(3,)`. `axes` `(2, 3)`; `turned` `(n, 3)` rad: in the rows near the stop; `seen`: the gyros that there are."""
    if not (turned := turned[:, seen]).size or not np.isfinite(turned).all():
        return np.zeros(3)
    axes = axes * seen
    if np.linalg.svd(axes, compute_uv=False)[-1] < SEEN:
        return np.zeros(3)
    ended, begun = np.linalg.lstsq(axes.T[seen], turned.T)[0]
    return np.sum(begun[first]) * axes[1] - np.sum(ended[~first]) * axes[0]


def _of_one_axis(time_s: np.ndarray, rates: np.ndarray) -> np.ndarray:
    """The same of two moves of one axis. `time_s` `(7,)`, `rates` `(7, 3)`, less the bias: of the row of the stop, in
    the middle, and of those beside it. Controllers brake and start at constant accelerations: straight lines of the
    rate."""
    step = np.diff(time_s, prepend=2.0 * time_s[0] - time_s[1])
    result, end, middle = np.zeros(3), time_s[3], time_s - 0.5 * step
    main = int(np.nanargmax(np.nansum(np.abs(rates), axis=0))) if np.isfinite(rates).any() else 0
    for one, other, sign in ((0, 1, -1.0), (5, 6, 1.0)):
        slope = (rates[other] - rates[one]) / (middle[other] - middle[one])
        if not abs(slope[main]) > 0.0:
            continue
        # From the row's end to where the line is zero: past it on the side of the other move.
        beyond = (end - (middle[one] - rates[one, main] / slope[main])) * sign
        if 0.0 < beyond < 1.5 * step[3]:
            # Either way a part of one move is among the rows of the other.
            result += 0.5 * np.nan_to_num(slope) * beyond**2
    return result
