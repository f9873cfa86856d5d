"""A device's clock against the run's clock: one line per stream, with its residuals.

Bytes arrive late, never early: delayed by the unit, the adapter and the operating system, sometimes by much; of a burst
that is read in pieces, all but the last piece waited for the rest. The delay of most arrivals carries no information,
so the line is fitted to the quickest: the quickest of each of many stretches of the stream, and all arrivals as near to
the line as they are. Calibration needs the rate (a sensor's clock is a scale factor); the offset includes the latency
of the quickest arrivals.

The scatter of many stamps averages out, their resolution does not: if both ends of a line are known to the resolution,
the rate is uncertain by resolution over span, however small the scatter (which is only rounding in virtual time, where
bytes take no time).
"""

import math
from dataclasses import dataclass
from typing import Final

import numpy as np
from numpy.typing import NDArray

_ARRIVALS_A_STRETCH: Final = 8
_STRETCHES: Final = 128
_ROUNDING_S: Final = 1e-9
_CREDIBLE: Final = 0.01  # no unit's clock is off by more


@dataclass(frozen=True)
class ClockMap:
    """`host = offset_s + rate · device`. `rate_error` = rate − 1; residuals of the arrivals that were used."""

    offset_s: float
    rate: float
    rate_std: float
    residual_rms_s: float
    residual_max_s: float
    used: int
    late: int

    @property
    def rate_error(self) -> float:
        """How much longer the unit's second is than the host's; positive: the unit's clock runs slow."""
        return self.rate - 1.0

    def host_time_s(self, device_time_s: NDArray[np.float64]) -> NDArray[np.float64]:
        return self.offset_s + self.rate * device_time_s


def fit_clock(
    device_time_s: NDArray[np.float64], host_time_s: NDArray[np.float64], *, resolution_s: float = 0.0
) -> ClockMap:
    """Fit the line. Both `(n,)`, in the order of arrival; samples that came in one chunk share their host time.

    `resolution_s` of the coarser of the two stamps limits `rate_std` from below, over the whole span.
    An implausible rate, from a stretch too short to show one, counts as 1, known to `_CREDIBLE`.

    Raises `ValueError` for fewer than three arrivals, or times that do not increase.
    """
    # The last sample of a chunk waited least.
    last = np.append(np.diff(host_time_s) > 0.0, True)
    device, host = device_time_s[last], host_time_s[last]
    if device.size < 3 or np.any(np.diff(device) <= 0.0):
        raise ValueError(
            f"A clock map needs at least three arrivals with increasing device time; there are {device.size}."
        )
    middle = float(device.mean())
    centred = device - middle
    stretches = np.array_split(np.arange(device.size), min(max(3, device.size // _ARRIVALS_A_STRETCH), _STRETCHES))
    offset, rate = _line(centred, host)
    quickest = np.zeros(0, np.int64)
    for _ in range(20):
        residual = host - offset - rate * centred
        fresh = np.array([stretch[np.argmin(residual[stretch])] for stretch in stretches], np.int64)
        fresh = fresh[_not_above(residual[fresh])]
        if np.array_equal(fresh, quickest):
            break
        quickest = fresh
        offset, rate = _line(centred[quickest], host[quickest])
    residual = host - offset - rate * centred
    kept = residual <= max(float(residual[quickest].max()), _ROUNDING_S)
    offset, rate = _line(centred[kept], host[kept])
    residual = host - offset - rate * centred
    unknown = 0.0
    if abs(rate - 1.0) > _CREDIBLE:
        # The stretch is too short and all arrivals are late: the slope is that of the delays.
        unknown, rate, offset = _CREDIBLE, 1.0, float(np.min(host - centred))
        residual = host - offset - centred
        kept = residual <= float(np.sort(residual)[2])
    used = residual[kept]
    rms = float(np.sqrt(np.mean(used**2)))
    lever = float(np.sqrt(np.sum((centred[kept] - centred[kept].mean()) ** 2)))
    # An error anywhere within a step of the grid, at either end: √2 · resolution / √12.
    grid = resolution_s / math.sqrt(6.0) / float(np.ptp(centred[kept]))
    rate_std, largest = max(math.hypot(rms / lever, grid), unknown), float(np.max(np.abs(used)))
    return ClockMap(offset - rate * middle, rate, rate_std, rms, largest, int(kept.sum()), int((~kept).sum()))


def _not_above(residual: NDArray[np.float64]) -> NDArray[np.bool_]:
    """Without the stretches that lie above the bulk, which had no quick arrival. At least three stay."""
    middle = float(np.median(residual))
    spread = 1.4826 * float(np.median(np.abs(residual - middle)))
    kept = residual <= middle + max(4.0 * spread, _ROUNDING_S)
    return kept if kept.sum() >= 3 else np.ones(residual.size, bool)


def _line(x: NDArray[np.float64], y: NDArray[np.float64]) -> tuple[float, float]:
    """Least squares: value at x = 0, and slope."""
    middle = float(x.mean())
    slope = float((x - middle) @ (y - y.mean())) / float((x - middle) @ (x - middle))
    return float(y.mean()) - slope * middle, slope
