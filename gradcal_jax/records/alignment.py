"""Alignment of another logger's recording with the run's clock, by the motion.

The table's track is the readings of one axis, θ_k at the run's times t_k. The unit's track is A(u), its rates
integrated over its own clock u. With the clocks related by

    t = offset + rate · (u − middle)

the turns between neighbouring readings follow the integrated rates: θ_k − θ_{k−1} = s·(A(u_k) − A(u_{k−1})) + b·(t_k −
t_{k−1}) + e_k, where s is the direction of the table's axis in the unit, by least squares. What a reading tells of the
offset is the change of the rate since the one before: the beginnings and ends of turns.

The coarse offset comes first: the speeds of both tracks are correlated on a coarse grid, and the best offsets are
refined. An offset is accepted only where no other fits nearly as well. Motion in the recording and not in the run,
*and* in the run and not in the recording, counts against an offset: otherwise a cyclic plan would fit by any of its
cycles.

The uncertainty is from the scatter between the table's motions, which is valid for any correlation within one (White
1980). The delays of the table's readings and of the unit's filter are not in it: they are the same at every reading
and so part of the offset.
"""

import importlib
import math
from dataclasses import dataclass
from typing import Any, Final, NamedTuple

import numpy as np
from numpy.typing import NDArray

Floats = NDArray[np.float64]
_LINALG: Any = np.linalg

# Of the correlation: its grid, the number of offsets that are refined, and how far apart they are.
_GRID_S, _PLACES, _APART_S = 0.5, 16, 2.0
# Longest time between two readings; least number of motions; rate below which a table stands.
_LONGEST_S, _FEWEST_TURNS = 60.0, 3
_STANDS_DPS: Final = 0.5
# No two clocks differ by more. Largest misfit, and how much larger that of other offsets must be.
_CREDIBLE, _MISFIT, _AS_GOOD, _MOST_UNSURE_S = 1e-3, 0.02, 4.0, 0.05
# Weights of readings: of an encoder of 36″, read at times that are known to 1 ms. The covariance is of the residuals.
_NOISE_DEG, _JITTER_S = 0.01, 1e-3
_ANOTHER: Final = "the recording is from another run or another axis"


class NoAlignment(ValueError):
    """The recording cannot be aligned with the run's clock; the message says why."""


@dataclass(frozen=True)
class Alignment:
    """`t = offset_s + rate · (u − middle_s)`; the errors of `offset_s` and `rate` are independent of each other."""

    middle_s: float
    offset_s: float
    rate: float
    offset_std_s: float
    rate_std: float
    turns: int
    readings: int


@dataclass(frozen=True)
class AngleTrack:
    """Readings of one table axis: times that increase, s, and angles, deg."""

    time_s: Floats
    angle_deg: Floats


class _Place(NamedTuple):
    """A line near which the tracks agree: `u = middle + (t − offset) / (1 + excess)`."""

    fit: Any
    """The least squares of offset and excess: `x`, the weighted residuals of the turns `fun`, their slopes `jac`."""
    misfit: float
    """The fraction of the table's motion (sum of squared turns) that is missing in the recording."""
    scale: float
    """Turns of the table over those of the unit, of its only axis with their sign."""


def align(time_s: Floats, rates_dps: Floats, track: AngleTrack) -> Alignment:
    """Align a recording with the run's clock: its times `(n,)`, s, by its own clock, and its rates `(n, axes)`, deg/s.

    Raises `NoAlignment` where nothing fits, several places fit, or the place is not known to 0.05 s.
    """
    if len(track.time_s) < 3 or float(np.ptp(track.angle_deg)) < 1.0:
        raise NoAlignment("the run did not turn any axis of the recording")
    known = np.isfinite(rates_dps).all(axis=1)
    time_s, rates = time_s[known], rates_dps[known] - np.median(rates_dps[known], axis=0)
    integrate: Any = importlib.import_module("scipy.integrate")
    angles = integrate.cumulative_trapezoid(rates, time_s, axis=0, initial=0.0)
    table = np.diff(track.angle_deg, prepend=track.angle_deg[0])
    speeds = (
        _on_grid(track.time_s, np.cumsum(np.abs(table))),
        _on_grid(time_s, np.cumsum(np.linalg.norm(np.diff(angles, axis=0, prepend=angles[:1]), axis=1))),
    )
    begins_s, middle_s = float(track.time_s[0] - time_s[0]), float(0.5 * (time_s[0] + time_s[-1]))
    places = [
        _refined(time_s, np.hstack([angles, rates]), track, begins_s + lag_s, outside)
        for lag_s, outside in _places(*speeds)
    ]
    places.sort(key=lambda place: place.misfit)
    if not places:
        raise NoAlignment(f"no rate in the recording agrees with the motion of the table: {_ANOTHER}")
    best = places[0]
    if best.misfit > _MISFIT or not 0.8 < abs(best.scale) < 1.25:
        raise NoAlignment(
            "the recording does not agree with the motion of the table: at the best alignment "
            f"{100.0 * best.misfit:.0f} % of the motion is missing, and the sensor measures "
            f"{1.0 / best.scale:.2f} times the turns of the table; {_ANOTHER}"
        )
    if best.scale < 0.0:
        raise NoAlignment(
            "the rates in the recording have the opposite sign of the table's motion: change the sign of this axis "
            "in the column map"
        )
    for other in places[1:]:
        apart_s = abs(other.fit.x[0] - best.fit.x[0])
        if apart_s > _APART_S and other.misfit < max(_AS_GOOD * best.misfit, 0.5 * _MISFIT):
            raise NoAlignment(
                "the recording agrees with the run at more than one start time; two of these are "
                f"{apart_s:.1f} s apart: the recording must contain the first or the last turn of the run, or turns "
                "that differ from each other"
            )
    return _known_to(best, middle_s, track)


def _on_grid(time_s: Floats, way_deg: Floats) -> Floats:
    """The mean speed in each step of the grid, of a way at some times."""
    edges = np.arange(time_s[0], time_s[-1] + 2.0 * _GRID_S, _GRID_S)
    return np.diff(np.interp(edges, time_s, way_deg)) / _GRID_S


def _places(table: Floats, sensed: Floats) -> list[tuple[float, float]]:
    """Where the speeds agree best: by how much later the recording begins, and the fraction of motion outside."""
    signal: Any = importlib.import_module("scipy.signal")

    def against(left: Floats, right: Floats) -> Floats:
        """Σ left[i + lag] · right[i] for lags −(number of sensed − 1) … number of the table's − 1."""
        return signal.correlate(left, right, method="fft")

    inside_t, inside_u = against(table**2, np.ones(len(sensed))), against(np.ones(len(table)), sensed**2)
    total_t, total_u = float(table @ table), float(sensed @ sensed)
    enough = (inside_t > 0.1 * total_t) & (inside_u > 1e-6 * total_t)
    likeness = np.where(enough, against(table, sensed), 0.0) / np.sqrt(np.where(enough, inside_t * inside_u, 1.0))
    outside = np.minimum(total_t - inside_t, total_u - inside_u).clip(0.0) / total_t
    peaks: list[tuple[float, float]] = []
    score = likeness - outside
    for place in np.argsort(-score)[: 50 * _PLACES]:
        lag_s = _GRID_S * (int(place) - (len(sensed) - 1))
        if score[place] > 0.3 and all(abs(lag_s - other) > _APART_S for other, _ in peaks):
            peaks.append((lag_s, float(outside[place])))
    return peaks[:_PLACES]


def _refined(time_s: Floats, path: Floats, track: AngleTrack, lag_s: float, outside: float) -> _Place:
    """The best line near a lag of the recording for the turns between consecutive readings, with a direction and a
    bias. `path` `(n, 2 · axes)`: the integrated rates and the rates."""
    interpolate: Any = importlib.import_module("scipy.interpolate")
    optimize: Any = importlib.import_module("scipy.optimize")
    middle_s, axes = 0.5 * (time_s[0] + time_s[-1]), path.shape[1] // 2
    turned, apart = np.diff(track.angle_deg), np.diff(track.time_s)
    at = interpolate.make_interp_spline(time_s, path, k=1)
    # The angle turned across a gap is unknown.
    steps = np.diff(time_s, prepend=time_s[0])
    part: Any = np.cumsum(steps > 5.0 * np.median(steps))

    def turns(line: Floats) -> tuple[Floats, Floats, Floats]:
        """The columns of the turns between readings, their weights, zero where they are not known, and the solution."""
        times_s = middle_s + (track.time_s - line[0]) / (1.0 + line[1])
        row: NDArray[np.int64] = np.asarray(np.searchsorted(time_s, times_s), np.int64).clip(1, len(time_s) - 1)
        inside = (times_s >= time_s[0]) & (times_s < time_s[-1]) & (part[row - 1] == part[row])
        keep = inside[1:] & inside[:-1] & (part[row[1:]] == part[row[:-1]]) & (apart < _LONGEST_S)
        values: Floats = at(times_s.clip(time_s[0], time_s[-1]))
        variance = _NOISE_DEG**2 + _JITTER_S**2 * np.sum(values[:, axes:] ** 2, axis=1)
        weight = keep / np.sqrt(variance[1:] + variance[:-1])
        columns = np.column_stack([np.diff(values[:, :axes], axis=0), apart])
        return columns, weight, _LINALG.lstsq(columns * weight[:, None], turned * weight, rcond=None)[0]

    def residuals(line: Floats) -> Floats:
        columns, weight, solution = turns(line)
        return weight * (turned - columns @ solution)

    start = lag_s + middle_s
    bounds = [start - _APART_S, -_CREDIBLE], [start + _APART_S, _CREDIBLE]
    fit = optimize.least_squares(residuals, [start, 0.0], bounds=bounds, x_scale=[1e-2, 1e-5], xtol=1e-12)
    columns, weight, solution = turns(fit.x)
    known = weight > 0.0
    power = float(np.sum(turned[known] ** 2))
    # Of several gyros, that turn about one axis, the columns are nearly one, and hardly tell the direction.
    seen = float(np.sum(columns[known, :-1] ** 2)) or np.inf
    scale = float(solution[0]) if axes == 1 else math.sqrt(power / seen)
    missing = float(np.sum((turned - columns @ solution)[known] ** 2))
    misfit = missing / power + outside if np.count_nonzero(turned[known]) > 12 else 1.0
    return _Place(fit, misfit, scale)


def _known_to(place: _Place, middle_s: float, track: AngleTrack) -> Alignment:
    """The alignment, and how well its line is known. Raises `NoAlignment` where it is not."""
    moving = np.abs(np.diff(track.angle_deg)) > _STANDS_DPS * np.diff(track.time_s)
    turn = np.cumsum(np.diff(moving, prepend=False) & moving)
    slopes, rest = place.fit.jac, place.fit.fun
    turns = len(np.unique(turn[np.abs(slopes[:, 0]) > _STANDS_DPS / _NOISE_DEG]))
    if turns < _FEWEST_TURNS:
        raise NoAlignment(
            f"the recording shows {turns} of the table's turns with readings at their beginnings and ends; at "
            f"least {_FEWEST_TURNS} are needed to determine its clock"
        )
    inverse: Floats = _LINALG.inv(slopes.T @ slopes)
    each = np.stack([np.bincount(turn, of * rest) for of in slopes.T])
    covariance = inverse @ (each @ each.T) @ inverse * turns / (turns - 2)
    own, cross, slope = float(covariance[0, 0]), float(covariance[0, 1]), float(covariance[1, 1])
    offset_std_s = math.sqrt(max(own - cross**2 / slope, 0.0))
    if not offset_std_s < _MOST_UNSURE_S:
        raise NoAlignment(
            f"the recording's clock is determined only to {offset_std_s:.2g} s: too few readings were taken while the "
            "table turned"
        )
    # The middle that makes the errors of offset and rate independent.
    offset_s, excess = place.fit.x.tolist()
    shift_s, rate = -cross / slope, 1.0 + excess
    line = middle_s + shift_s, offset_s + rate * shift_s, rate
    return Alignment(*line, offset_std_s, math.sqrt(slope), turns, len(rest))
