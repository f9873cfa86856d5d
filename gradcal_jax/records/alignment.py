"""Alignment of another logger's recording with the run's clock, by the motion.

The table's track is the readings of its angles, θ_k at the run's times t_k. The unit's track is A(u), its rate
integrated over its own clock u. With the clocks related by

    t = offset + rate · (u − middle)

the turns between neighbouring readings follow the integrated rate: θ_k − θ_{k−1} = s·(A(u_k) − A(u_{k−1})) + b·(t_k −
t_{k−1}) + e_k. What a reading tells of the offset is the change of the rate since the one before: the beginnings and
ends of turns.

The coarse offset comes first: the rates of both tracks are correlated on a coarse grid, and the best offsets are
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
from functools import partial
from typing import Any, Final, NamedTuple

import numpy as np
from numpy.typing import NDArray

Floats = NDArray[np.float64]

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


class _Unit:
    """One axis of the recording: its rate, and the angle that it makes."""

    def __init__(self, time_s: Floats, rate_dps: Floats) -> None:
        known = np.isfinite(rate_dps)
        self.time_s, rate = time_s[known], rate_dps[known]
        self.rate_dps = rate - float(np.median(rate))
        steps = np.diff(self.time_s)
        self.angle_deg = np.concatenate(([0.0], np.cumsum(0.5 * steps * (self.rate_dps[1:] + self.rate_dps[:-1]))))
        # The angle turned across a gap is unknown.
        self.part = np.concatenate(([0], np.cumsum(steps > 5.0 * np.median(steps))))

    def at(self, times_s: Floats) -> tuple[Floats, Floats, NDArray[np.int64]]:
        """Angle, rate and unbroken part; part −1 outside, and in gaps."""
        row = np.searchsorted(self.time_s, times_s, side="right") - 1
        before, after = row.clip(0), (row + 1).clip(max=len(self.time_s) - 1)
        inside = (row >= 0) & (row + 1 < len(self.time_s)) & (self.part[before] == self.part[after])
        angle = np.interp(times_s, self.time_s, self.angle_deg)
        return angle, np.interp(times_s, self.time_s, self.rate_dps), np.where(inside, self.part[before], -1)


class _Place(NamedTuple):
    """A line near which the tracks agree: `u = middle + (t − offset_s) / (1 + excess)`."""

    offset_s: float
    excess: float
    misfit: float
    """The fraction of the table's motion (sum of squared turns) that is missing in the recording."""
    scale: float
    rest: Floats
    """Residuals `(turns,)` by their weights, and their slopes over offset and excess."""
    slopes: Floats


def align(time_s: Floats, rate_dps: Floats, track: AngleTrack) -> Alignment:
    """Align a recording with the run's clock: its times `(n,)`, s, by its own clock, and its rate `(n,)`, deg/s, about
    the axis of the track.

    Raises `NoAlignment` where nothing fits, several places fit, or the place is not known to 0.05 s.
    """
    if len(track.time_s) < 3 or float(np.ptp(track.angle_deg)) < 1.0:
        raise NoAlignment("the run did not turn the axis of the recording")
    unit, middle_s = _Unit(time_s, rate_dps), float(0.5 * (time_s[0] + time_s[-1]))
    places = [_refined(unit, track, middle_s, *place) for place in _places(unit, track)]
    places.sort(key=lambda place: place.misfit)
    if not places:
        raise NoAlignment(f"no rate in the recording agrees with the motion of the table: {_ANOTHER}")
    best = places[0]
    if best.scale < 0.0:
        raise NoAlignment(
            "the rates in the recording have the opposite sign of the table's motion: change the sign of this axis "
            "in the column map"
        )
    if best.misfit > _MISFIT or not 0.8 < best.scale < 1.25:
        raise NoAlignment(
            "the recording does not agree with the motion of the table: at the best alignment "
            f"{100.0 * best.misfit:.0f} % of the motion is missing, and the sensor measures "
            f"{1.0 / best.scale:.2f} times the turns of the table; {_ANOTHER}"
        )
    others = [place for place in places if abs(place.offset_s - best.offset_s) > _APART_S]
    if others and others[0].misfit < max(_AS_GOOD * best.misfit, 0.5 * _MISFIT):
        raise NoAlignment(
            "the recording agrees with the run at more than one start time; two of these are "
            f"{abs(others[0].offset_s - best.offset_s):.1f} s apart: the recording must contain the first or the last "
            "turn of the run, or turns that differ from each other"
        )
    alignment = _known_to(best, middle_s, track)
    if not alignment.offset_std_s < _MOST_UNSURE_S:
        raise NoAlignment(
            f"the recording's clock is determined only to {alignment.offset_std_s:.2g} s: too few readings were "
            "taken while the table turned"
        )
    return alignment


def _places(unit: _Unit, track: AngleTrack) -> list[tuple[float, float]]:
    """Where the rates agree best: host time less recorded time, and the fraction of motion outside."""
    on_grid = list[Floats]()
    for time_s, angle_deg in ((track.time_s, track.angle_deg), (unit.time_s, unit.angle_deg)):
        edges = np.arange(time_s[0], time_s[-1] + 2.0 * _GRID_S, _GRID_S)
        on_grid.append(np.diff(np.interp(edges, time_s, angle_deg)) / _GRID_S)
    table, sensed = on_grid
    signal: Any = importlib.import_module("scipy.signal")
    # Σ left[i + lag] · right[i] for lags −(number of sensed − 1) … number of the table's − 1.
    against = partial(signal.correlate, method="fft")
    inside_t, inside_u = against(table**2, np.ones(len(sensed))), against(np.ones(len(table)), sensed**2)
    total_t, total_u = float(table @ table), float(sensed @ sensed)
    enough = (inside_t > 0.1 * total_t) & (inside_u > 1e-6 * total_t)
    likeness = np.where(enough, against(table, sensed), 0.0) / np.sqrt(np.where(enough, inside_t * inside_u, 1.0))
    outside = np.minimum(total_t - inside_t, total_u - inside_u).clip(0.0) / total_t
    peaks: list[tuple[float, float]] = []
    score = np.abs(likeness) - outside
    for place in np.argsort(-score)[: 50 * _PLACES]:
        lag_s = float(track.time_s[0] - unit.time_s[0]) + _GRID_S * (int(place) - (len(sensed) - 1))
        if score[place] > 0.3 and all(abs(lag_s - other) > _APART_S for other, _ in peaks):
            peaks.append((lag_s, float(outside[place])))
    return peaks[:_PLACES]


def _refined(unit: _Unit, track: AngleTrack, middle_s: float, lag_s: float, outside: float) -> _Place:
    """The best line near an offset for the turns between consecutive readings, with a scale and a bias."""
    turned, apart = np.diff(track.angle_deg), np.diff(track.time_s)
    offset_s = lag_s + middle_s

    def left(line: Floats) -> tuple[Floats, Floats, Floats, float]:
        """Residuals of the turns, zero where they are not known, these turns, their weights, and the scale."""
        angle, rate, part = unit.at(middle_s + (track.time_s - line[0]) / (1.0 + line[1]))
        keep = (part[1:] >= 0) & (part[1:] == part[:-1]) & (apart < _LONGEST_S)
        variance = _NOISE_DEG**2 + (_JITTER_S * rate) ** 2
        weight = 1.0 / np.sqrt(variance[1:] + variance[:-1])
        known = np.where(keep, turned, 0.0)
        design = np.where(keep, [np.diff(angle), apart], 0.0).T
        solution = np.asarray(np.linalg.lstsq(design * weight[:, None], known * weight, rcond=None)[0], np.float64)
        return known - design @ solution, known, weight, float(solution[0])

    def weighted(line: Floats) -> Floats:
        rest, _, weight, _ = left(line)
        return rest * weight

    optimize: Any = importlib.import_module("scipy.optimize")
    bounds = [offset_s - _APART_S, -_CREDIBLE], [offset_s + _APART_S, _CREDIBLE]
    scales = [1e-2, 1e-5]
    fit = optimize.least_squares(weighted, [offset_s, 0.0], bounds=bounds, x_scale=scales, xtol=1e-12)
    rest, known, _, scale = left(fit.x)
    power = float(known @ known)
    misfit = float(rest @ rest) / power + outside if np.count_nonzero(known) > 12 and power > 0.0 else 1.0
    return _Place(float(fit.x[0]), float(fit.x[1]), misfit, scale, fit.fun, fit.jac)


def _known_to(place: _Place, middle_s: float, track: AngleTrack) -> Alignment:
    """The alignment, and how well its line is known."""
    moving = np.abs(np.diff(track.angle_deg)) > _STANDS_DPS * np.diff(track.time_s)
    turn = np.cumsum(np.diff(moving, prepend=False) & moving)
    information = place.slopes.T @ place.slopes
    seen = np.unique(turn[np.abs(place.slopes[:, 0]) > _STANDS_DPS / _NOISE_DEG])
    if len(seen) < _FEWEST_TURNS:
        raise NoAlignment(
            f"the recording shows {len(seen)} of the table's turns with readings at their beginnings and ends; at "
            f"least {_FEWEST_TURNS} are needed to determine its clock"
        )
    inverse: Any = np.linalg.inv(information)
    each = np.stack([np.bincount(turn, place.slopes[:, k] * place.rest) for k in (0, 1)])
    covariance = inverse @ (each @ each.T) @ inverse * len(seen) / (len(seen) - 2)
    own, cross, slope = float(covariance[0, 0]), float(covariance[0, 1]), float(covariance[1, 1])
    # The middle that makes the errors of offset and rate independent.
    shift_s, rate = -cross / slope, 1.0 + place.excess
    stds = math.sqrt(max(own - cross**2 / slope, 0.0)), math.sqrt(slope)
    return Alignment(middle_s + shift_s, place.offset_s + rate * shift_s, rate, *stds, len(seen), len(place.rest))
