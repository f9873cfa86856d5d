"""Angles of a table without an encoder: gravity gives them at every standstill, the gyros count whole turns.

Between two standstills one axis after the other turns, by the gyros' integral along it, which is wrong by their scale
factor. About axes that are not vertical the accelerometers correct the angle, so long as the scale factor's error is
less than half a turn of the turn. About a vertical axis the gyros' integral is all that is known. The first standstill
is near the plan's begin.

These angles are a start: `imu_solve` estimates each with the calibration, and linearises about the result again.
"""

import itertools

import numpy as np

from gradcal_jax.estimation.gyro_stops import stops_between, turned_axis
from gradcal_jax.estimation.imu_rows import ImuRows, mean_known
from gradcal_jax.formulas import runs
from gradcal_jax.motion import Geometry, frames

# The largest scale-factor error with which whole turns are counted.
_COUNTED = 0.15
# An integral (rad) below which no axis has turned.
_LEAST_TURN = np.radians(0.06)
# Turns smaller than this (rad) are not read, nor the standstills within this time of them.
_SMALL_TURN, _BESIDE_S = np.radians(1.0), 0.5
_STEPS = 40
# Sine of the angle to the vertical below which gravity says nothing of an axis's angle.
_VERTICAL = 0.05


def angles_by_gravity(log: ImuRows, geometry: Geometry, start: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """The angles of a table's standstills `(n, L)`, rad, NaN at other rows, and whether a row `(n,)` is near a turn so
    small that it can hardly be told from standing. `start` `(L,)` rad: about where the plan begins. Errors:
    `ValueError` where whole turns cannot be counted."""
    stands = [(int(a), int(b) - 1) for a, b in runs(log.standing)]
    stands = [(a, b) for a, b in stands if b > a and np.isfinite(log.force[a : b + 1]).any(axis=0).all()]
    if len(stands) < 2:
        raise ValueError("the log has fewer than two standstills, so gravity gives no angle")
    result = np.full((len(log.time_s), geometry.axis_count), np.nan)
    doubtful, at = np.zeros(len(log.time_s), bool), start
    for k, (first, last) in enumerate(stands):
        mounting, up = int(log.mounting[first]), mean_known(log.force[first : last + 1])
        up, before = up / np.linalg.norm(up), at
        end = stands[k - 1][1] if k else first
        hung_anew = not k or mounting != log.mounting[end]
        parts = (
            None
            if hung_anew or not log.usable[end + 1 : first + 1].all()
            else _integrals(log, stands[k - 1], (first, last))
        )
        if parts is None:
            # Across a gap, or hung anew: near the plan's begin if hung anew, else near where it stood.
            near = start if hung_anew else at
            at = near + _wrapped(_by_gravity(geometry, near, up, mounting) - near)
        else:
            at = _turned(geometry, at, up, mounting, parts, log.time_s[end])
            if np.max(np.abs(at - before)) < _SMALL_TURN:
                near = np.searchsorted(log.time_s, [log.time_s[end] - _BESIDE_S, log.time_s[first] + _BESIDE_S])
                doubtful[near[0] : near[1]] = True
        result[first : last + 1] = at
    return result, doubtful


def _integrals(log: ImuRows, before: tuple[int, int], after: tuple[int, int]) -> list[np.ndarray]:
    """The gyros' integrals (rad, `(3,)`) over the turns between two standstills, less what they show at rest."""
    quiet = 0.5 * sum(mean_known(log.rates[a : b + 1]) for a, b in (before, after))
    end, first = before[1], after[0]
    rates, step = log.rates[end + 1 : first + 1] - quiet, np.diff(log.time_s[end : first + 1])
    edges = [0, *stops_between(rates[:, np.isfinite(quiet)]), len(rates)]
    return [step[a:b] @ rates[a:b] for a, b in itertools.pairwise(edges)]


def _turned(
    geometry: Geometry, at: np.ndarray, up: np.ndarray, mounting: int, parts: list[np.ndarray], begin_s: float
) -> np.ndarray:
    """The angles after turns with these integrals."""
    here, turned = at.copy(), np.zeros(len(at))
    for part in parts:
        axis, angle = turned_axis(geometry, here, mounting, part)
        if abs(angle) >= _LEAST_TURN:
            here[axis] += angle
            turned[axis] += angle
    largest = float(np.max(np.abs(turned)))
    if largest * _COUNTED > np.pi:
        raise ValueError(
            f"whole turns cannot be counted: a turn of {np.degrees(largest):.4g} deg, {begin_s:.6g} s after the "
            "start of the log, may be a turn more or less with the gyros' scale factor; turn by "
            f"{np.degrees(np.pi / _COUNTED):.3g} deg or less at once"
        )
    # Of several turns at once whole ones are not counted anew: those of the gyros are corrected a little.
    return _by_gravity(geometry, here, up, mounting, turned != 0.0) if turned.any() else here


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
        # (Of a nearly vertical axis gravity says nothing.)
        slope = slope * (np.linalg.norm(slope, axis=0) > _VERTICAL)
        move = np.linalg.lstsq(slope, up - seen, rcond=1e-3)[0]
        angles = angles + move * min(1.0, 0.5 / max(float(np.linalg.norm(move)), 1e-12))
        if np.linalg.norm(move) < 1e-9:
            break
    return angles


def _wrapped(angle: np.ndarray) -> np.ndarray:
    return (angle + np.pi) % (2.0 * np.pi) - np.pi
