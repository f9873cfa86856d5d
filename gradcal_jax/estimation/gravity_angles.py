"""Angles of a table without an encoder: gravity gives them at every standstill, the gyros count whole turns.

Between two standstills one axis turns, by the gyros' integral `φ̃ = (1 + s) φ` along it. About an axis that is not
vertical the accelerometers give the angle up to whole turns, so that `Δ = φ mod 2π` whatever the scale-factor error s
is. It is where

    C(s) = Σ w cos(Δ − φ̃/(1 + s))                     w: squared sine of the angle between axis and vertical

is greatest, for every direction of the axis in the body by itself; then whole turns are counted with it. Where another
s in the range fits as well, turns cannot be counted. About a vertical axis the gyros' integral is all that is known.

These angles are a start: `imu_solve` estimates each with the calibration, and linearises about the result again.
"""

import itertools
from typing import NamedTuple

import numpy as np

from gradcal_jax.estimation.imu_executed import SEEN, ImuRows, stops_between
from gradcal_jax.formulas import runs
from gradcal_jax.motion import Geometry, frames

# Scale-factor errors within which whole turns are counted, and beyond which it is said.
_RANGE, _LARGE = 0.2, 0.1
# Share of the best C(s), less the number of its terms, that another s has whose turns are as likely.
_AS_LIKELY = 0.5
# Error of an angle by uncalibrated accelerometers, rad: a floor for misfits.
_COARSE = 0.05
# Sine of the angle to the vertical below which gravity says nothing of an axis's angle.
_VERTICAL = 0.05
# An integral (rad) below which no axis has turned.
_LEAST_TURN = np.radians(0.06)
# Turns smaller than this (rad) are not read, nor the standstills within this time of them.
_SMALL_TURN, _BESIDE_S = np.radians(1.0), 0.5
_STEPS = 40
_PASSES = 3


class GravityAngles(NamedTuple):
    """`angles` `(n, L)` rad: at the rows where the table stands, NaN at the others; `doubtful` `(n,)`: rows about turns
    so small that they can hardly be told from standing; `messages` on large scale-factor errors."""

    angles: np.ndarray
    doubtful: np.ndarray
    messages: tuple[str, ...]


class _Still(NamedTuple):
    """The standstills: rows `first … last`, mean `rates` of the gyros and the direction `up`, `(K, 3)`, in the body."""

    rows: np.ndarray
    rates: np.ndarray
    up: np.ndarray
    mounting: np.ndarray


class _Chain(NamedTuple):
    """Angles `(K, L)` of all standstills; scale-factor errors by direction; mean square misfit of the verticals and the
    turns' directions."""

    angles: np.ndarray
    scales: dict[tuple[float, ...], float]
    misfit: float


class _Turn(NamedTuple):
    """The only turn between two standstills: the axis's direction in the body, the gyros' integral along it (rad), and
    what gravity adds to it, within half a turn, with its weight."""

    direction: np.ndarray
    integral: float
    beyond: float
    weight: float


def angles_by_gravity(log: ImuRows, geometry: Geometry, start: np.ndarray) -> GravityAngles:
    """The angles of a table's standstills. `start` `(L,)` rad: about where the plan begins; of mirror solutions the
    one nearer to it counts. Errors: `ValueError` where whole turns cannot be counted."""
    still = _standstills(log)
    turned = _integrals(log, still)
    found = [_with_scale(geometry, still, turned, one, log) for one in _starts(geometry, still, start)]
    least = min(of.misfit for of in found)
    # The nearest to the plan's begin comes first; a mirror image fits as well.
    angles, scales, _ = next(of for of in found if of.misfit <= least + _COARSE**2)
    result = np.full((len(log.time_s), geometry.axis_count), np.nan)
    for (first, last), own in zip(still.rows, angles, strict=True):
        result[first : last + 1] = own
    doubtful = np.zeros(len(log.time_s), bool)
    for k in range(len(angles) - 1):
        if np.max(np.abs(angles[k + 1] - angles[k])) < _SMALL_TURN and turned[k] is not None:
            near = np.searchsorted(log.time_s, log.time_s[still.rows[[k, k + 1], [1, 0]]] + [-_BESIDE_S, _BESIDE_S])
            doubtful[near[0] : near[1]] = True
    large = [s for s in scales.values() if abs(s) > _LARGE]
    said = [
        (
            f"the scale factor of the gyros is wrong by {100.0 * s:+.3g} %: the estimate counts whole turns with "
            "this scale factor; are the rates in rad/s?"
        )
        for s in large
    ]
    return GravityAngles(result, doubtful, tuple(dict.fromkeys(said)))


def _standstills(log: ImuRows) -> _Still:
    rows, rates, up = [], [], []
    for a, b in runs(log.standing):
        force = log.force[a:b]
        if b - a < 2 or not np.isfinite(force).any(axis=0).all():
            continue
        mean = np.nanmean(force, axis=0)
        rows.append((int(a), int(b) - 1))
        up.append(mean / np.linalg.norm(mean))
        known = np.isfinite(log.rates[a:b])
        total = np.sum(np.where(known, log.rates[a:b], 0.0), axis=0)
        rates.append(np.where(known.any(axis=0), total / np.maximum(known.sum(axis=0), 1), np.nan))
    if len(rows) < 2:
        raise ValueError("the log has fewer than two standstills, so gravity gives no angle")
    where = np.array(rows)
    return _Still(where, np.array(rates), np.array(up), log.mounting[where[:, 0]])


def _integrals(log: ImuRows, still: _Still) -> list[np.ndarray | None]:
    """The gyros' integrals (rad, `(n, 3)`) over the turns between standstills, less what they show at rest; None across
    a gap."""
    step, result = np.diff(log.time_s, prepend=log.time_s[0]), []
    for k, ((_, last), (first, _)) in enumerate(itertools.pairwise(still.rows)):
        inner = slice(last + 1, first + 1)
        if not log.usable[inner].all() or still.mounting[k] != still.mounting[k + 1]:
            result.append(None)
            continue
        quiet = 0.5 * (still.rates[k] + still.rates[k + 1])
        rates = log.rates[inner] - quiet
        edges = [0, *stops_between(rates[:, np.isfinite(quiet)]), len(rates)]
        result.append(np.array([step[inner][a:b] @ rates[a:b] for a, b in itertools.pairwise(edges)]))
    return result


def _starts(geometry: Geometry, still: _Still, start: np.ndarray) -> list[np.ndarray]:
    """Angles (rad) at which the first standstill shows its vertical, nearest to the plan's and mirrored ones."""
    found: list[np.ndarray] = []
    for quarter in itertools.product((0.0, 1.0, 2.0, 3.0), repeat=geometry.axis_count):
        angles = _by_gravity(geometry, start + 0.5 * np.pi * np.array(quarter), still.up[0], still.mounting[0])
        angles = start + _wrapped(angles - start)
        if not any(np.linalg.norm(_wrapped(angles - other)) < _COARSE for other in found):
            found.append(angles)
    misfits = [np.linalg.norm(_up(geometry, a, still.mounting[0]) - still.up[0]) for a in found]
    kept = [a for a, m in zip(found, misfits, strict=True) if m < min(misfits) + 2.0 * _COARSE]
    # Continua of solutions (of three axes) have no more than a few that differ.
    return sorted(kept, key=lambda a: float(np.linalg.norm(a - start)))[:6]


def _by_gravity(
    geometry: Geometry, angles: np.ndarray, up: np.ndarray, mounting: int, free: np.ndarray | bool = True
) -> np.ndarray:
    """Angles near `angles` at which the body sees this vertical, of the axes that are `free`: Gauss-Newton of least
    norm."""
    for _ in range(_STEPS):
        stages = frames(geometry, angles[None], np.array([mounting]))
        seen = stages.attitude[0][2]
        # A rotation δ about a table axis a turns what the body sees of the vertical by −δ a × u.
        slope = -np.cross(stages.axes[0], seen).T * free
        move = np.linalg.lstsq(slope, up - seen, rcond=1e-3)[0]
        angles = angles + move * min(1.0, 0.5 / max(float(np.linalg.norm(move)), 1e-12))
        if np.linalg.norm(move) < 1e-9:
            break
    return angles


def _up(geometry: Geometry, angles: np.ndarray, mounting: int) -> np.ndarray:
    return frames(geometry, angles[None], np.array([mounting])).attitude[0][2]


def _with_scale(
    geometry: Geometry, still: _Still, turned: list[np.ndarray | None], start: np.ndarray, log: ImuRows
) -> _Chain:
    """Angles of all standstills from a start, with whole turns counted by the scale-factor errors that fit."""
    scales: dict[tuple[float, ...], float] = {}
    for _ in range(_PASSES):
        turns = _chain(geometry, still, turned, start, scales)[1]
        before, scales = scales, _scales(turns, still, log)
        if before.keys() == scales.keys() and all(abs(before[k] - s) < 1e-3 for k, s in scales.items()):
            break
    angles, _, misfit = _chain(geometry, still, turned, start, scales)
    return _Chain(angles, scales, misfit)


def _chain(
    geometry: Geometry,
    still: _Still,
    turned: list[np.ndarray | None],
    start: np.ndarray,
    scales: dict[tuple[float, ...], float],
) -> tuple[np.ndarray, list[_Turn | None], float]:
    """The angles of all standstills, one turn after the other; the turns; and the mean square misfit of the vertical
    and of the turns' directions."""
    seen = np.asarray(np.isfinite(still.rates).all(axis=0))
    angles, turns, misfit = [start], list[_Turn | None](), 0.0
    for k, integral in enumerate(turned):
        here, mounting, up = angles[-1].copy(), still.mounting[k + 1], still.up[k + 1]
        own: list[tuple[int, np.ndarray, float]] = []
        if integral is None:
            # Across a gap, or hung anew: near the plan's begin if hung anew, else near where it stood.
            near = here if mounting == still.mounting[k] else start
            angles.append(near + _wrapped(_by_gravity(geometry, near, up, mounting) - near))
            turns.append(None)
            continue
        for part in integral:
            axes = frames(geometry, here[None], np.array([mounting])).axes[0]
            axis, angle, missed = _turned_axis(axes, part, seen)
            if abs(angle) < _LEAST_TURN:
                continue
            before = own.pop()[2] if own and own[-1][0] == axis else 0.0
            own.append((axis, axes[axis], before + angle))
            misfit += (missed / abs(angle)) ** 2
            here[axis] += angle / (1.0 + scales.get(_direction(axes[axis]), 0.0))
        if len(own) == 1:
            (axis, direction, angle), reached = own[0], here[own[0][0]]
            beyond, weight = _beyond(_up(geometry, here, mounting), up, direction)
            here[axis] += beyond if weight > _VERTICAL**2 else 0.0
            turns.append(_Turn(direction, angle, float(reached - angles[-1][axis] + beyond - angle), weight))
        else:
            # Of several turns at once whole ones are not counted anew: those of the gyros are corrected a little.
            turns.append(None)
            free = np.isin(np.arange(len(here)), [axis for axis, _, _ in own])
            here = _by_gravity(geometry, here, up, mounting, free) if len(own) else here
        misfit += float(np.sum((_up(geometry, here, mounting) - up) ** 2))
        angles.append(here)
    return np.array(angles), turns, misfit / max(len(turned), 1)


def _turned_axis(axes: np.ndarray, integral: np.ndarray, seen: np.ndarray) -> tuple[int, float, float]:
    """The axis along which an integral points, its angle, and how far the integral is off that line (rad)."""
    along, total = axes * seen, np.where(seen, integral, 0.0)
    size = np.sum(along**2, axis=1)
    angle = np.where(size > SEEN**2, along @ total / np.maximum(size, SEEN**2), 0.0)
    missed = np.linalg.norm(total - angle[:, None] * along, axis=1)
    axis = int(np.argmin(missed))
    return axis, float(angle[axis]), float(missed[axis])


def _beyond(expected: np.ndarray, up: np.ndarray, axis: np.ndarray) -> tuple[float, float]:
    """The further turn about an axis (body components), within half a turn, after which the body sees the vertical
    `up`, and the weight of what it says."""
    first, second = (v - (v @ axis) * axis for v in (expected, up))
    turn = np.arctan2(axis @ np.cross(first, second), first @ second)
    return -float(turn), float(np.linalg.norm(first) * np.linalg.norm(second))


def _direction(axis: np.ndarray) -> tuple[float, ...]:
    """Of turns about nearly the same line of the body."""
    return tuple(np.round(np.abs(axis), 1).tolist())


def _scales(turns: list[_Turn | None], still: _Still, log: ImuRows) -> dict[tuple[float, ...], float]:
    """The scale-factor error along every direction of turns. Errors: `ValueError` where another fits as well."""
    groups: dict[tuple[float, ...], list[int]] = {}
    for k, turn in enumerate(turns):
        if turn is not None and turn.weight > _VERTICAL**2:
            groups.setdefault(_direction(turn.direction), []).append(k)
    result: dict[tuple[float, ...], float] = {}
    for key, members in groups.items():
        own = [turn for k in members if (turn := turns[k]) is not None]
        integral, weight = np.array([t.integral for t in own]), np.array([t.weight for t in own])
        change = integral + np.array([t.beyond for t in own])
        largest = float(np.max(np.abs(integral)))
        scale = np.linspace(-_RANGE, _RANGE, 2 * int(np.ceil(10.0 * largest * _RANGE)) + 21)
        # Half of the squared misfits in units of what coarse accelerometers leave: log-likelihoods.
        apart = 1.0 - np.cos(change[:, None] - integral[:, None] / (1.0 + scale))
        misfit = weight @ apart / _COARSE**2
        best = int(np.argmin(misfit))
        # About the best, turns of the same count.
        away = np.abs(scale - scale[best]) * largest > np.pi
        if away.any() and float(np.min(misfit[away])) - float(misfit[best]) < len(own) * _AS_LIKELY:
            other = float(scale[away][int(np.argmin(misfit[away]))])
            begin = log.time_s[still.rows[members[int(np.argmax(np.abs(integral)))]][1]]
            raise ValueError(
                f"whole turns cannot be counted: scale-factor errors of {100 * scale[best]:+.2g} % and "
                f"{100 * other:+.2g} % explain the turns about one direction equally well (the longest turn: "
                f"{np.degrees(largest):.4g} deg, {begin:.6g} s after the start of the log); add a turn of half a "
                "revolution or less about this direction"
            )
        result[key] = float(scale[best])
    return result


def _wrapped(angle: np.ndarray) -> np.ndarray:
    return (angle + np.pi) % (2.0 * np.pi) - np.pi
