"""Alignment of another logger's recording with the run's clock, by the motion.

The table's track is the readings of its angles, θ_k at the run's times t_k. The unit's track is A(u), its rate
integrated over its own clock u. With the clocks related by

    t = offset + rate · (u − middle)

the readings follow the integrated rate: θ_k = c + s·A(u(t_k)) + e_k, with a separate constant and scale for every burst
of motion, so that biases, scale factors and slow drifts have no effect.

The coarse offset comes first: the rates of both tracks are correlated on a coarse grid, and the best offsets are
refined. An offset is accepted only where no other fits nearly as well. Motion in the recording and not in the run,
*and* in the run and not in the recording, counts against an offset: otherwise a cyclic plan would fit by any of its
cycles.

The uncertainty is the larger of two: from the scatter of the readings (white, with a part that grows with the rate,
because the time of a reading is uncertain too), and from the scatter between bursts, which is valid for any
correlation within a burst (White 1980). The delays of the table's readings and of the unit's filter are not in it: they
are the same at every reading and so part of the offset.
"""

import importlib
import math
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from functools import partial
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from gradcal_jax.formulas import runs

Floats = NDArray[np.float64]

# Of the correlation: its grid, the number of offsets that are refined, and how far apart they are.
_GRID_S, _PLACES, _APART_S = 0.5, 16, 2.0
# Longest burst, and time between two readings; least number of bursts; rate below which a table stands.
_LONGEST_S, _FEWEST_BURSTS, _STANDS_DPS = 60.0, 3, 0.5
# No two clocks differ by more. Largest misfit, and how much larger that of other offsets must be.
_CREDIBLE, _MISFIT, _AS_GOOD, _MOST_UNSURE_S = 1e-3, 0.02, 4.0, 0.05


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
    bursts: int
    readings: int
    misfit: float
    """The fraction of the table's motion (sum of squared turns) that is missing in the recording."""

    def host_time_s(self, recorded_s: Floats) -> Floats:
        return self.offset_s + self.rate * (recorded_s - self.middle_s)


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


def align(time_s: Floats, rates_dps: Mapping[str, Floats], tracks: Mapping[str, AngleTrack]) -> Alignment:
    """Align a recording with the run's clock.

    time_s      (n,)  of the recording, by its own clock
    rates_dps   (n,)  by axis, deg/s; axes that the table does not turn are ignored
    tracks            by the same names: the table's readings

    Raises `NoAlignment` where nothing fits, several places fit, or the place is not known to 0.05 s.
    """
    pairs = [
        (_Unit(time_s, rates_dps[name]), track)
        for name, track in tracks.items()
        if name in rates_dps and len(track.time_s) > 2 and float(np.ptp(track.angle_deg)) > 1.0
    ]
    if not pairs:
        raise NoAlignment(
            "the run did not turn any axis of the recording, so the recording cannot be aligned with the run"
        )
    middle_s = float(0.5 * (time_s[0] + time_s[-1]))
    places = [_refined(pairs, middle_s, lag_s + middle_s, outside) for lag_s, outside in _places(pairs)]
    if not places:
        raise NoAlignment(
            "no rate in the recording agrees with the motion of the table: the recording is from another run or "
            "another axis, or begins after the table has turned"
        )
    places.sort(key=lambda place: place.misfit)
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
            f"{1.0 / best.scale:.2f} times the turns of the table; the recording is from another run or another axis"
        )
    others = [place for place in places[1:] if abs(place.offset_s - best.offset_s) > _APART_S]
    if others and others[0].misfit < max(_AS_GOOD * best.misfit, 0.5 * _MISFIT):
        apart_s = abs(others[0].offset_s - best.offset_s)
        raise NoAlignment(
            f"the recording agrees with the run at more than one start time; two of these are {apart_s:.1f} s apart: "
            "the recording must contain the first or the last turn of the run, or turns that differ from each other"
        )
    alignment = _exactly(pairs, middle_s, best)
    if not alignment.offset_std_s < _MOST_UNSURE_S:
        raise NoAlignment(
            f"the recording's clock is determined only to {alignment.offset_std_s:.2g} s: too few readings were "
            "taken while the table turned"
        )
    return alignment


class _Place(NamedTuple):
    offset_s: float
    excess: float
    """By how much a second of the recording is longer than a second of the run."""
    misfit: float
    scale: float


def _least_squares(residuals: Callable[[Floats], Floats], offset_s: float, excess: float, ftol: float = 1e-8) -> Any:
    """The fit of a line near this one."""
    optimize: Any = importlib.import_module("scipy.optimize")
    return optimize.least_squares(
        residuals,
        [offset_s, excess],
        bounds=([offset_s - _APART_S, -_CREDIBLE], [offset_s + _APART_S, _CREDIBLE]),
        x_scale=[1e-2, 1e-5],
        xtol=1e-12,
        ftol=ftol,
    )


def _on_grid(time_s: Floats, angle_deg: Floats, begins_s: float, count: int) -> Floats:
    edges = begins_s + _GRID_S * np.arange(count + 1)
    return np.diff(np.interp(edges, time_s, angle_deg)) / _GRID_S


def _places(pairs: list[tuple[_Unit, AngleTrack]]) -> list[tuple[float, float]]:
    """Where the tracks' rates agree best: host time less recorded time, and the fraction of motion outside."""
    begins_t = min(float(track.time_s[0]) for _, track in pairs)
    begins_u = min(float(unit.time_s[0]) for unit, _ in pairs)
    count_t = 1 + int((max(float(track.time_s[-1]) for _, track in pairs) - begins_t) / _GRID_S)
    count_u = 1 + int((max(float(unit.time_s[-1]) for unit, _ in pairs) - begins_u) / _GRID_S)
    signal: Any = importlib.import_module("scipy.signal")
    # Σ left[i + lag] · right[i] for lags −(count_u − 1) … count_t − 1.
    against = partial(signal.correlate, method="fft")
    together = np.zeros(count_t + count_u - 1)
    inside_t, inside_u = together.copy(), together.copy()
    total_t = total_u = 0.0
    for unit, track in pairs:
        table = _on_grid(track.time_s, track.angle_deg, begins_t, count_t)
        sensed = _on_grid(unit.time_s, unit.angle_deg, begins_u, count_u)
        together += against(table, sensed)
        inside_t += against(table**2, np.ones(count_u))
        inside_u += against(np.ones(count_t), sensed**2)
        total_t += float(table @ table)
        total_u += float(sensed @ sensed)
    enough = (inside_t > 0.1 * total_t) & (inside_u > 1e-6 * total_t)
    likeness = np.where(enough, together, 0.0) / np.sqrt(np.where(enough, inside_t * inside_u, 1.0))
    outside = np.minimum(total_t - inside_t, total_u - inside_u).clip(0.0) / total_t
    peaks: list[tuple[float, float]] = []
    score = np.abs(likeness) - outside
    for place in np.argsort(-score)[: 50 * _PLACES]:
        lag_s = begins_t - begins_u + _GRID_S * (int(place) - (count_u - 1))
        if score[place] > 0.3 and all(abs(lag_s - other) > _APART_S for other, _ in peaks):
            peaks.append((lag_s, float(outside[place])))
        if len(peaks) == _PLACES:
            break
    return peaks


def _refined(pairs: list[tuple[_Unit, AngleTrack]], middle_s: float, offset_s: float, outside: float) -> _Place:
    """The best line near an offset for the turns between consecutive readings, one scale and bias for each axis."""
    turned = np.concatenate([np.diff(track.angle_deg) for _, track in pairs])

    def left(line: Floats) -> tuple[Floats, Floats, Floats]:
        """Residuals of the turns, zero where they are not known, these turns, and the scales."""
        design = np.zeros((len(turned), 2 * len(pairs)))
        first = 0
        for number, (unit, track) in enumerate(pairs):
            apart = np.diff(track.time_s)
            angle, _, part = unit.at(middle_s + (track.time_s - line[0]) / (1.0 + line[1]))
            keep = (part[1:] >= 0) & (part[1:] == part[:-1]) & (apart < _LONGEST_S)
            rows = slice(first, first + len(apart))
            design[rows, 2 * number] = np.where(keep, np.diff(angle), 0.0)
            design[rows, 2 * number + 1] = np.where(keep, apart, 0.0)
            first += len(apart)
        known = np.where(design.any(axis=1), turned, 0.0)
        solution = np.asarray(np.linalg.lstsq(design, known, rcond=None)[0], np.float64)
        return known - design @ solution, np.asarray(known, np.float64), solution[::2]

    fit = _least_squares(lambda line: left(line)[0], offset_s, 0.0, 1e-3)
    rest, known, scales = left(fit.x)
    power = float(known @ known)
    if np.count_nonzero(known) < 3 * (2 + 2 * len(pairs)) or power == 0.0:
        return _Place(offset_s, 0.0, 1.0, 1.0)
    return _Place(float(fit.x[0]), float(fit.x[1]), float(rest @ rest) / power + outside, float(np.mean(scales)))


class _Burst(NamedTuple):
    """Readings around one motion."""

    unit: _Unit
    time_s: Floats
    angle_deg: Floats

    def left(self, line: Floats, middle_s: float, noise_deg: float, jitter_s: float) -> tuple[Floats, Floats]:
        """Residuals in units of their scatter, with a constant and a scale projected out, and the rates."""
        angle, rate, _ = self.unit.at(middle_s + (self.time_s - line[0]) / (1.0 + line[1]))
        weight = 1.0 / np.hypot(noise_deg, jitter_s * rate)
        basis = np.linalg.qr(np.stack([weight, weight * (angle - angle.mean())], axis=1))[0]
        apart = (self.angle_deg - angle) * weight
        return apart - basis @ (basis.T @ apart), rate


def _bursts(pairs: list[tuple[_Unit, AngleTrack]], middle_s: float, place: _Place) -> list[_Burst]:
    bursts = list[_Burst]()
    for unit, track in pairs:
        _, rate, part = unit.at(middle_s + (track.time_s - place.offset_s) / (1.0 + place.excess))
        for first, after in runs(np.abs(rate) > _STANDS_DPS).tolist():
            # A long motion is split into pieces.
            piece = (track.time_s[first:after] - track.time_s[first]) // _LONGEST_S
            begins = first + np.flatnonzero(np.diff(piece, prepend=-1.0))
            for begin, end in zip(begins, [*begins[1:], after], strict=True):
                rows = slice(max(0, begin - 2), end + 2)
                here, time = part[rows], track.time_s[rows]
                if len(here) >= 5 and here.min() >= 0 and np.ptp(here) == 0 and np.max(np.diff(time)) <= _LONGEST_S:
                    bursts.append(_Burst(unit, time, track.angle_deg[rows]))
    if len(bursts) < _FEWEST_BURSTS:
        raise NoAlignment(
            f"the recording shows {len(bursts)} of the table's turns with readings; at least {_FEWEST_BURSTS} are "
            "needed to determine its clock"
        )
    return bursts


def _grown(rest: Floats, spared: Floats) -> float:
    """How much larger the scatter is than it was taken to be; 1 where too few readings show it."""
    count = float(np.sum(spared))
    return (math.sqrt(float(rest @ rest) / count) if count > 4.0 else 1.0) or 1.0


def _exactly(pairs: list[tuple[_Unit, AngleTrack]], middle_s: float, place: _Place) -> Alignment:
    bursts = _bursts(pairs, middle_s, place)
    line = np.array([place.offset_s, place.excess])
    noise_deg, jitter_s = 1e-3, 1e-3
    sizes = np.array([len(burst.time_s) for burst in bursts])
    spared = np.repeat(1.0 - 2.0 / sizes, sizes)
    rest, slopes, count = np.zeros(0), np.zeros((0, 2)), len(bursts)
    for _ in range(5):

        def residuals(line: Floats, scatter: tuple[float, float] = (noise_deg, jitter_s)) -> Floats:
            return np.concatenate([burst.left(line, middle_s, *scatter)[0] for burst in bursts])

        fit = _least_squares(residuals, *line)
        line, rest, slopes = fit.x, fit.fun, fit.jac
        rates = np.concatenate([burst.left(line, middle_s, noise_deg, jitter_s)[1] for burst in bursts])
        # The scatter of readings at rest, and its part that grows with the rate: one iteration.
        standing = np.abs(rates) <= _STANDS_DPS
        noise_deg = max(noise_deg * _grown(rest[standing], spared[standing]), 1e-7)
        jitter_s = max(jitter_s * _grown(rest[~standing], spared[~standing]), 1e-9)
    inverse = np.linalg.inv(slopes.T @ slopes)
    covariance = inverse * max(1.0, float(rest @ rest) / max(len(rest) - 2 * count - 2, 1))
    each = np.add.reduceat(slopes * rest[:, None], np.cumsum(sizes) - sizes)
    robust: Floats = inverse @ (each.T @ each) @ inverse * count / max(count - 2, 1)
    covariance = robust if robust[0, 0] > covariance[0, 0] else covariance
    own, cross, slope = float(covariance[0, 0]), float(covariance[0, 1]), float(covariance[1, 1])
    # The middle that makes the errors of offset and rate independent.
    shift_s, rate = -cross / slope, 1.0 + float(line[1])
    stds = math.sqrt(max(own - cross**2 / slope, 0.0)), math.sqrt(slope)
    return Alignment(middle_s + shift_s, float(line[0]) + rate * shift_s, rate, *stds, count, len(rest), place.misfit)
