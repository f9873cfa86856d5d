"""An axis's rate from its positions, for controllers that do not tell it.

The mean since a reading at least 0.4 s before: a noisy encoder that is read twice in a millisecond would make any rate
of nothing. The time is taken from when the earlier position was asked for to when the later had come: a host that was
busy in between makes a rate too small, and never too large.
"""

from collections import deque

_OVER_S = 0.4


class MeanRate:
    """Of one axis."""

    def __init__(self) -> None:
        # When a position was asked for, and the position.
        self._recent: deque[tuple[float, float]] = deque()

    def of(self, asked_s: float, time_s: float, position_deg: float, *, moving: bool) -> float:
        """The rate at a reading that was asked for and had come at these times; 0 of an axis that stands."""
        recent = self._recent
        while len(recent) > 1 and time_s - recent[1][0] >= _OVER_S:
            recent.popleft()
        rate = 0.0
        if recent and moving and time_s - recent[0][0] >= _OVER_S:
            rate = (position_deg - recent[0][1]) / (time_s - recent[0][0])
        recent.append((asked_s, position_deg))
        return rate
