"""Whether the gyros agree that a table stands where its standstills begin and end.

A gyro that is filtered or delayed, or a controller that says "in position" too early, shows the end of a move within
the standstill; one that says so too late, or stamps of the wrong clock, its beginning. Each angle is small and the same
after every move, so that no test of single readings need notice it.
"""

from typing import NamedTuple

import numpy as np

from gradcal_jax.formulas import runs

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
    found: tuple[list[tuple[float, float]], list[tuple[float, float]]] = ([], [])
    for begin, end in runs(standing).tolist():
        if end - begin < _ROWS or not fits[begin:end].all():
            continue
        part = max(2, min(int(_PART_S / interval), int(_SHARE * (end - begin))))
        middle = rate[begin + part : end - part]
        mean, spread = float(middle.mean()), float(middle.std(ddof=1))
        if spread == 0.0:
            continue
        std = spread * interval * np.sqrt(part + part**2 / len(middle))
        # (The sample of the first row is of the time before it.)
        for into, inside, outside in (
            (found[0], slice(begin + 1, begin + part), slice(max(begin - beside, 0), begin)),
            (found[1], slice(end - part, end), slice(end, end + beside)),
        ):
            motion = rate[outside] - mean
            largest = float(motion[np.argmax(np.abs(motion))]) if len(motion) and fits[outside].all() else 0.0
            if abs(largest) > 20.0 * spread:
                angle = float(np.sum((rate[inside] - mean) * step[inside]))
                into.append((angle * float(np.sign(largest)), std))
    if min(len(one) for one in found) < _FEWEST:
        return None
    values = []
    for one in found:
        angles, stds = np.array(one).T
        values += [float(angles.mean()), float(np.sqrt(np.sum(stds**2))) / len(stds)]
    return Settling(*values)
