"""Angles of a table without an encoder: gravity gives them at every standstill, the gyros count whole turns.

Between two standstills one axis turns, by the gyros' integral along it, which is wrong by their scale factor. About an
axis that is not vertical the accelerometers give the angle up to whole turns: the angle nearest to the gyros', so long
as the scale factor's error is less than half a turn of the turn. About a vertical axis the gyros' integral is all that
is known. The first standstill is near the plan's begin.

These angles are a start: `imu_solve` estimates each with the calibration, and linearises about the result again.
"""

import itertools
from typing import NamedTuple

import numpy as np

from gradcal_jax.estimation.imu_executed import SEEN, ImuRows, stops_between
from gradcal_jax.formulas import runs
from gradcal_jax.motion import Geometry, frames

# The largest scale-factor error with which whole turns are counted, and one that is said.
_COUNTED, _LARGE = 0.15, 0.1
# Sine of the angle to the vertical below which gravity says nothing of an axis's angle.
_VERTICAL = 0.05
# An integral (rad) below which no axis has turned.
_LEAST_TURN = np.radians(0.06)
# Turns smaller than this (rad) are not read, nor the standstills within this time of them.
_SMALL_TURN, _BESIDE_S = np.radians(1.0), 0.5
_STEPS = 40


class GravityAngles(NamedTuple):
    """`angles` `(n, L)` rad: at the rows where the table stands, NaN at the others; `doubtful` `(n,)`: rows about turns
    so small that they can hardly be told from standing; `messages` on a large scale-factor error."""

    angles: np.ndarray
    doubtful: np.ndarray
    messages: tuple[str, ...]


class _Still(NamedTuple):
    """The standstills: rows `first … last`, mean `rates` of the gyros and the direction `up`, `(K, 3)`, in the body."""

    rows: np.ndarray
    rates: np.ndarray
    up: np.ndarray
    mounting: np.ndarray


def angles_by_gravity(log: ImuRows, geometry: Geometry, start: np.ndarray) -> GravityAngles:
    """The angles of a table's standstills. `start` `(L,)` rad: about where the plan begins. Errors: `ValueError` where
    whole turns cannot be counted."""
    still = _standstills(log)
    turned = _integrals(log, still)
    angles, scales = _chain(log, geometry, still, turned, start)
    result = np.full((len(log.time_s), geometry.axis_count), np.nan)
    for (first, last), own in zip(still.rows, angles, strict=True):
        result[first : last + 1] = own
    doubtful = np.zeros(len(log.time_s), bool)
    for k in range(len(angles) - 1):
        if np.max(np.abs(angles[k + 1] - angles[k])) < _SMALL_TURN and turned[k] is not None:
            near = np.searchsorted(log.time_s, log.time_s[still.rows[[k, k + 1], [1, 0]]] + [-_BESIDE_S, _BESIDE_S])
            doubtful[near[0] : near[1]] = True
    scale = float(np.median(scales)) if scales else 0.0
    said = (
        f"the scale factor of the gyros is wrong by {100.0 * scale:+.3g} %: the estimate counts whole turns with "
        "this scale factor; are the rates in rad/s?"
    )
    return GravityAngles(result, doubtful, (said,) if abs(scale) > _LARGE else ())


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


def _chain(
    log: ImuRows, geometry: Geometry, still: _Still, turned: list[np.ndarray | None], start: np.ndarray
) -> tuple[np.ndarray, list[float]]:
    """The angles of all standstills, one turn after the other, and the gyros' scale-factor errors by single turns."""
    seen = np.asarray(np.isfinite(still.rates).all(axis=0))
    first = _by_gravity(geometry, start, still.up[0], still.mounting[0])
    angles, scales = [start + _wrapped(first - start)], list[float]()
    for k, integral in enumerate(turned):
        here, mounting, up = angles[-1].copy(), still.mounting[k + 1], still.up[k + 1]
        own: dict[int, tuple[np.ndarray, float]] = {}
        if integral is None:
            # Across a gap, or hung anew: near the plan's begin if hung anew, else near where it stood.
            near = here if mounting == still.mounting[k] else start
            angles.append(near + _wrapped(_by_gravity(geometry, near, up, mounting) - near))
            continue
        for part in integral:
            axes = frames(geometry, here[None], np.array([mounting])).axes[0]
            axis, angle, _ = _turned_axis(axes, part, seen)
            if abs(angle) < _LEAST_TURN:
                continue
            own[axis] = axes[axis], own[axis][1] + angle if axis in own else angle
            here[axis] += angle
        largest = max((abs(angle) for _, angle in own.values()), default=0.0)
        if largest * _COUNTED > np.pi:
            begin, most = log.time_s[still.rows[k, 1]], np.degrees(np.pi / _COUNTED)
            raise ValueError(
                f"whole turns cannot be counted: a turn of {np.degrees(largest):.4g} deg, {begin:.6g} s after the "
                "start of the log, may be a turn more or less with the gyros' scale factor; turn by "
                f"{most:.3g} deg or less at once"
            )
        if len(own) == 1:
            ((axis, (direction, angle)),) = own.items()
            beyond, weight = _beyond(frames(geometry, here[None], np.array([mounting])).attitude[0][2], up, direction)
            if weight > _VERTICAL**2:
                here[axis] += beyond
                scales += [angle / (angle + beyond) - 1.0] if abs(angle) > 1.0 else []
        elif own:
            # Of several turns at once whole ones are not counted anew: those of the gyros are corrected a little.
            here = _by_gravity(geometry, here, up, mounting, np.isin(np.arange(len(here)), list(own)))
        angles.append(here)
    return np.array(angles), scales


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


def _wrapped(angle: np.ndarray) -> np.ndarray:
    return (angle + np.pi) % (2.0 * np.pi) - np.pi
