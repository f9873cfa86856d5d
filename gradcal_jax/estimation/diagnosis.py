"""What residuals that are too large look like: a few single events, or motion, or the sensor's own noise."""

from typing import NamedTuple

import numpy as np

# Robust standard deviations beyond which a residual is an event; largest share of events; the fewest residuals judged.
_EVENT, _FEW, _JUDGED = 8.0, 0.01, 20
# Ratio of the scales of residuals in motion and at rest that tells.
_TELLS = 1.5
# Events closer than this, s, are one.
_ONE_S = 60.0


class Diagnosis(NamedTuple):
    """`events` `(k, 2)`: first and last time (s) of the events, in as many `readings`; scales of the other
    residuals after moves and at rest, for the noise that the spec states (NaN: too few)."""

    events: np.ndarray
    readings: int
    moving: float
    resting: float

    @property
    def motion_tells(self) -> bool:
        """Whether motion makes residuals larger."""
        return bool(self.moving > _TELLS * max(self.resting, 1.0))


def diagnosis(residual: np.ndarray, time_s: np.ndarray, moved: np.ndarray) -> Diagnosis:
    """Of whitened residuals `(n,)` at their times (s); `moved` `(n,)`: whether the table moved before the reading."""
    events = np.zeros(len(residual), bool)
    for chosen in (moved, ~moved):
        own = np.abs(residual[chosen])
        if len(own) >= _JUDGED:
            events[chosen] = own > _EVENT * max(1.4826 * float(np.median(own)), 1.0)
    if np.count_nonzero(events) > max(3, int(_FEW * len(residual))):
        events[:] = False
    at = np.sort(time_s[events])
    groups = np.split(at, np.flatnonzero(np.diff(at) > _ONE_S) + 1) if len(at) else []
    scales = (
        float(np.sqrt(np.mean(residual[chosen] ** 2))) if np.count_nonzero(chosen) >= _JUDGED else np.nan
        for chosen in (moved & ~events, ~moved & ~events)
    )
    return Diagnosis(np.array([(g[0], g[-1]) for g in groups]).reshape(-1, 2), len(at), *scales)
