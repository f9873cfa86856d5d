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

import math
from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from typing import Final

import numpy as np
from numpy.typing import NDArray

from gradcal_jax.formulas import runs

Floats = NDArray[np.float64]

_GRID_S: Final = 0.5
_PLACES: Final = 16
_APART_S: Final = 2.0
_FEWEST_BURSTS: Final = 3
_LONGEST_S: Final = 60.0  # of a burst, and between two readings
_CREDIBLE: Final = 1e-3  # no two clocks differ by more
_MISFIT: Final = 0.02
_AS_GOOD: Final = 4.0
_MOST_UNSURE_S: Final = 0.05
_STANDS_DPS: Final = 0.5


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


@dataclass(frozen=True)
class _Place:
    offset_s: float
    excess: float
    """By how much a second of the recording is longer than a second of the run."""
    misfit: float
    scale: float


def _on_grid(time_s: Floats, angle_deg: Floats, begins_s: float, count: int) -> Floats:
    edges = begins_s + _GRID_S * np.arange(count + 1)
    return np.diff(np.interp(edges, time_s, angle_deg)) / _GRID_S


def _places(pairs: list[tuple[_Unit, AngleTrack]]) -> list[tuple[float, float]]:
    """Where the tracks' rates agree best: host time less recorded time, and the fraction of motion outside."""
    begins_t = min(float(track.time_s[0]) for _, track in pairs)
    begins_u = min(float(unit.time_s[0]) for unit, _ in pairs)
    count_t = 1 + int((max(float(track.time_s[-1]) for _, track in pairs) - begins_t) / _GRID_S)
    count_u = 1 + int((max(float(unit.time_s[-1]) for unit, _ in pairs) - begins_u) / _GRID_S)
    size = 1 << (count_t + count_u).bit_length()

    def against(left: Floats, right: Floats) -> Floats:
        """Σ left[i + lag] · right[i] for lags −(count_u − 1) … count_t − 1."""
        product = np.fft.irfft(np.fft.rfft(left, size) * np.conj(np.fft.rfft(right, size)), size)
        return np.concatenate((product[-(count_u - 1) :], product[:count_t])) if count_u > 1 else product[:count_t]

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
    """Gauss-Newton on the turns between consecutive readings, with one scale and one bias for each axis."""
    excess, misfit, scale = 0.0, 1.0, 1.0
    for _ in range(20):
        rows: list[Floats] = []
        values: list[Floats] = []
        for number, (unit, track) in enumerate(pairs):
            u = middle_s + (track.time_s - offset_s) / (1.0 + excess)
            angle, rate, part = unit.at(u)
            apart = np.diff(track.time_s)
            keep = (part[1:] >= 0) & (part[1:] == part[:-1]) & (apart < _LONGEST_S)
            late = np.diff(rate)
            row = np.zeros((len(apart), 2 + 2 * len(pairs)))
            row[:, 0], row[:, 1] = -late, -np.diff(rate * (u - middle_s))
            row[:, 2 + 2 * number], row[:, 3 + 2 * number] = np.diff(angle), apart
            rows.append(row[keep])
            values.append(np.diff(track.angle_deg)[keep])
        design, turned = np.concatenate(rows), np.concatenate(values)
        power = float(turned @ turned)
        if len(turned) < 3 * design.shape[1] or power == 0.0:
            return _Place(offset_s, excess, 1.0, scale)
        solved = np.linalg.lstsq(design, turned, rcond=None)[0]
        scale = float(np.mean(solved[2::2]))
        left = turned - design[:, 2:] @ solved[2:]
        misfit = float(left @ left) / power
        step_s, step = float(solved[0]) / (scale or 1.0), float(solved[1]) / (scale or 1.0)
        offset_s += min(max(step_s, -1.0), 1.0)
        excess = min(max(excess + min(max(step, -1e-4), 1e-4), -_CREDIBLE), _CREDIBLE)
        if abs(step_s) < 1e-7 and abs(step) < 1e-10:
            break
    return _Place(offset_s, excess, misfit + outside, scale)


@dataclass(frozen=True)
class _Burst:
    """Readings around one motion; constant and scale are eliminated after weighting."""

    left_deg: Floats
    slopes: Floats
    rate_dps: Floats
    design: Floats


def _bursts(pairs: list[tuple[_Unit, AngleTrack]], middle_s: float, offset_s: float, excess: float) -> Iterator[_Burst]:
    for unit, track in pairs:
        u = middle_s + (track.time_s - offset_s) / (1.0 + excess)
        angle, rate, part = unit.at(u)
        moves = np.abs(rate) > _STANDS_DPS
        for first, last in _runs(moves, track.time_s):
            rows = slice(max(0, first - 2), last + 3)
            here, t = part[rows], track.time_s[rows]
            if len(here) < 5 or here.min() < 0 or np.ptp(here) or float(np.diff(t).max()) > _LONGEST_S:
                continue
            design = np.stack((np.ones(len(here)), angle[rows] - angle[rows].mean()), axis=1)
            slopes = -np.stack((rate[rows], rate[rows] * (u[rows] - middle_s)), axis=1)
            yield _Burst(track.angle_deg[rows] - angle[rows], slopes, rate[rows], design)


def _runs(moves: NDArray[np.bool_], time_s: Floats) -> Iterator[tuple[int, int]]:
    """First and last reading of each motion; a long motion is split into pieces."""
    for first, after in runs(moves).tolist():
        begin = first
        for place in range(first, after):
            if place == after - 1 or time_s[place] - time_s[begin] > _LONGEST_S:
                yield begin, place
                begin = place + 1


@dataclass(frozen=True)
class _Fit:
    """One Gauss-Newton step, and its slopes and residuals by burst, in units of their scatter."""

    bursts: list[_Burst]
    weighted: list[tuple[Floats, Floats]]
    normal: Floats
    step: Floats

    @property
    def rest(self) -> list[Floats]:
        return [left - slopes @ self.step for slopes, left in self.weighted]


def _fit(bursts: list[_Burst], noise_deg: float, jitter_s: float) -> _Fit:
    if len(bursts) < _FEWEST_BURSTS:
        raise NoAlignment(
            f"the recording shows {len(bursts)} of the table's turns with readings; at least {_FEWEST_BURSTS} are "
            "needed to determine its clock"
        )
    weighted = [_projected(burst, noise_deg, jitter_s) for burst in bursts]
    slopes, left = (np.concatenate(parts) for parts in zip(*weighted, strict=True))
    normal: Floats = slopes.T @ slopes
    return _Fit(bursts, weighted, normal, np.asarray(np.linalg.solve(normal, slopes.T @ left), np.float64))


def _exactly(pairs: list[tuple[_Unit, AngleTrack]], middle_s: float, place: _Place) -> Alignment:
    offset_s, excess = place.offset_s, place.excess
    noise_deg, jitter_s = 1e-3, 1e-3
    for _ in range(6):
        fit = _fit([*_bursts(pairs, middle_s, offset_s, excess)], noise_deg, jitter_s)
        offset_s, excess = offset_s + float(fit.step[0]), excess + float(fit.step[1])
        noise_deg, jitter_s = _scatter(fit.bursts, fit.rest, noise_deg, jitter_s)
    fit = _fit([*_bursts(pairs, middle_s, offset_s, excess)], noise_deg, jitter_s)
    rest, bursts = fit.rest, len(fit.bursts)
    count = sum(len(left) for left in rest)
    inverse = np.linalg.inv(fit.normal)
    spare = max(count - 2 * bursts - 2, 1)
    covariance = inverse * max(1.0, sum(float(left @ left) for left in rest) / spare)
    each = np.array([slopes.T @ left for (slopes, _), left in zip(fit.weighted, rest, strict=True)])
    robust = inverse @ (each.T @ each) @ inverse * bursts / max(bursts - 2, 1)
    covariance = robust if robust[0, 0] > covariance[0, 0] else covariance
    own, cross, slope = float(covariance[0, 0]), float(covariance[0, 1]), float(covariance[1, 1])
    # The middle that makes the errors of offset and rate independent.
    shift_s = -cross / slope
    line = middle_s + shift_s, offset_s + (1.0 + excess) * shift_s, 1.0 + excess
    stds = math.sqrt(max(own - cross**2 / slope, 0.0)), math.sqrt(slope)
    return Alignment(*line, *stds, bursts, count, place.misfit)


def _projected(burst: _Burst, noise_deg: float, jitter_s: float) -> tuple[Floats, Floats]:
    """Slopes and residuals in units of their scatter, with constant and scale projected out."""
    weight = 1.0 / np.hypot(noise_deg, jitter_s * burst.rate_dps)
    basis = np.linalg.qr(burst.design * weight[:, None])[0]
    slopes, left = burst.slopes * weight[:, None], burst.left_deg * weight
    return slopes - basis @ (basis.T @ slopes), left - basis @ (basis.T @ left)


def _scatter(bursts: list[_Burst], rest: list[Floats], noise_deg: float, jitter_s: float) -> tuple[float, float]:
    """Scatter of readings at rest, and its part that grows with the rate, from the residuals: one iteration."""
    still, moving = 0.0, 0.0
    count_still, count_moving = 0.0, 0.0
    for burst, left in zip(bursts, rest, strict=True):
        spared = 1.0 - 2.0 / len(left)
        stands = np.abs(burst.rate_dps) <= _STANDS_DPS
        still += float(left[stands] @ left[stands])
        moving += float(left[~stands] @ left[~stands])
        count_still += spared * float(stands.sum())
        count_moving += spared * float((~stands).sum())
    grown = math.sqrt(still / count_still) if count_still > 4.0 and still > 0.0 else 1.0
    quicker = math.sqrt(moving / count_moving) if count_moving > 4.0 and moving > 0.0 else 1.0
    return max(noise_deg * grown, 1e-7), max(jitter_s * quicker, 1e-9)
