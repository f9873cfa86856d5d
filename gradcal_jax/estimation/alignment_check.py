"""A coarse comparison of gyros and accelerometers with the table, before anything is estimated: which channel has the
wrong sign, axis or unit.

Where one axis k alone turned by θ between two rests, the gyros' integral is `G a_k θ`, with a_k the direction of the
axis in the body; at rest the accelerometers show `A g up`. For a unit that hangs as its spec says, G and A are the
identity to a few per cent.
"""

from typing import NamedTuple

import numpy as np

from gradcal_jax.estimation.imu_executed import ImuRows, mean_angles
from gradcal_jax.formulas import runs
from gradcal_jax.motion import Geometry, frames

# Least angle (rad) of a turn that counts, and the largest that the other axes may turn meanwhile.
_TURNED, _STILL = 0.3, 0.02
# Share of a direction that the turns, or the poses, must show.
_SEEN = 0.5


class CoarseFit(NamedTuple):
    """`matrix` `(3, 3)`: what each channel shows of each body axis; `seen` `(3,)`: whether the data show that axis."""

    matrix: np.ndarray
    seen: np.ndarray


def coarse_fits(rows: ImuRows, geometry: Geometry) -> dict[str, CoarseFit]:
    """The matrices of gyros and accelerometers by kind; zero rows for channels that the log lacks."""
    rests = [(int(a), int(b)) for a, b in runs(rows.standing) if b - a > 2]
    if len(rests) < 2 or not np.isfinite(rows.angles).any():
        return dict.fromkeys(("gyro", "accelerometer"), CoarseFit(np.eye(3), np.zeros(3, bool)))
    step = np.diff(rows.time_s, prepend=rows.time_s[0])
    angles = np.array(mean_angles(rows, [(a, b - 1) for a, b in rests])).reshape(len(rests), -1)
    mounting = np.array([rows.mounting[a] for a, _ in rests], int)
    stages = frames(geometry, angles, mounting)
    totals = np.cumsum(np.nan_to_num(rows.rates) * step[:, None], axis=0)
    turns, shown = [], []
    for i in range(len(rests) - 1):
        change, middle = angles[i + 1] - angles[i], (rests[i][1] - 1, rests[i + 1][0])
        k = int(np.argmax(np.abs(change)))
        whole = rows.usable[middle[0] + 1 : middle[1] + 1].all() and mounting[i] == mounting[i + 1]
        if whole and abs(change[k]) > _TURNED and np.sum(np.abs(np.delete(change, k))) < _STILL:
            turns.append(stages.axes[i, k] * change[k])
            shown.append(totals[middle[1]] - totals[middle[0]])
    up = stages.attitude[:, 2, :] * float(geometry.gravity)
    felt = np.nan_to_num(np.array([np.mean(rows.force[a:b], axis=0) for a, b in rests]).reshape(len(rests), 3))
    return {"gyro": _fitted(turns, shown), "accelerometer": _fitted(up, felt)}


def _fitted(truth, shown) -> CoarseFit:
    truth, shown = np.asarray(truth, float).reshape(-1, 3), np.asarray(shown, float).reshape(-1, 3)
    if not np.any(truth):
        return CoarseFit(np.eye(3), np.zeros(3, bool))
    left, size, right = np.linalg.svd(truth, full_matrices=False)
    large = size > 0.1 * size[0]
    inverse = (right[large].T / size[large]) @ left[:, large].T
    seen = np.sum(right[large] ** 2, axis=0) > 1.0 - _SEEN**2
    return CoarseFit((inverse @ shown).T, seen)
