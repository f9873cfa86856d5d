"""The moves of a slow log, by the plan that the table executed.

At 1 to 10 rows a second a turn is a few rows: they show when the table turned and by how much, but neither the stop
between two axes' turns nor the rate within one. Both are the plan's: between two standstills lie the moves of the plan
with the same angles, and the gyros' integrals over the rows show when they began.
"""

from collections.abc import Callable, Sequence
from typing import Any, NamedTuple

import numpy as np

# Logs with rows further apart than this (s) are slow.
SLOW_S = 0.06
# Largest difference between a plan's angles and the table's (rad), and of their time, as a share of it.
_SAME_ANGLE, _SAME_TIME = np.radians(0.5), 0.25


class PlannedMove(NamedTuple):
    """A turn of a plan: its table `axis`, `angle` (rad) and `duration` (s); `profile`: the share of the angle that is
    turned at equal parts of the time, from 0 to 1."""

    axis: int
    angle: float
    duration: float
    profile: np.ndarray


class TimedMove(NamedTuple):
    """A planned move with the time (s) at which it began."""

    move: PlannedMove
    begin: float

    def share(self, time: np.ndarray) -> np.ndarray:
        """The share of its angle that is turned at a time (s)."""
        places = np.linspace(0.0, 1.0, len(self.move.profile))
        return np.interp((time - self.begin) / self.move.duration, places, self.move.profile)


def timed_moves(
    groups: Sequence[Sequence[PlannedMove]],
    change: np.ndarray,
    time_s: np.ndarray,
    turned: np.ndarray,
    directions_of: Callable[[Sequence[PlannedMove]], np.ndarray],
) -> list[TimedMove]:
    """The moves of one of the plan's `groups` that turned the axes by `change` (rad); empty where none did.

    `time_s` `(n + 1,)`: of the rows from the last one at rest to the first one at rest again; `turned` `(n, a)`: the
    gyros' integrals over each of them, rad; `directions_of(group)` `(moves, a)`: of each move's axis along the gyros.
    """
    step, best = np.diff(time_s), None
    room = float(time_s[-1] - time_s[0])
    for group in groups:
        net = np.zeros(len(change))
        for move in group:
            net[move.axis] += move.angle
        lasts = sum(move.duration for move in group)
        fits = np.max(np.abs(net - change)) < _SAME_ANGLE and lasts < room * (1.0 + _SAME_TIME) + np.max(step)
        if fits and (best is None or abs(lasts - room) < abs(best[0] - room)):
            best = lasts, group
    if best is None:
        return []
    lasts, group = best
    begins = np.cumsum([0.0, *(move.duration for move in group[:-1])])
    ways = directions_of(group) * np.array([move.angle for move in group])[:, None]

    def placed(start: float) -> list[TimedMove]:
        return [TimedMove(move, start + float(begin)) for move, begin in zip(group, begins, strict=True)]

    def apart(start: float) -> float:
        shares = np.stack([np.diff(timed.share(time_s)) for timed in placed(start)], axis=1)
        return float(np.sum((shares @ ways - turned) ** 2))

    # Imported where it is used: few logs are slow.
    from scipy import optimize

    first, last = float(time_s[0] - step[0]), float(max(time_s[-1] + step[-1] - lasts, time_s[0]))
    starts = np.linspace(first, last, max(int(np.ceil((last - first) / (0.25 * np.min(step)))), 2) + 1)
    near = int(np.argmin([apart(float(s)) for s in starts]))
    ends = float(starts[max(near - 1, 0)]), float(starts[min(near + 1, len(starts) - 1)])
    found: Any = optimize.minimize_scalar(apart, bounds=ends, method="bounded", options={"xatol": 1e-6})
    return placed(float(found.x))
