"""A device's own clock against the run's clock: one line per stream, with what is left over.

Bytes arrive late, never early: by the latency of the unit, of the adapter and of the operating system, sometimes by a
lot. So the line is fitted to the samples of the quickest arrivals: least squares, then again without what lies above
the bulk. The rate is what calibration needs (a sensor's clock is a scale factor); the offset holds the usual latency.

The scatter of many stamps averages out, the grid that they lie on does not: two ends of a line that are each known to
the stamps' resolution leave the rate uncertain by resolution over span, however small the scatter (on virtual time,
where bytes take no time at all, it is nothing but rounding).
"""

import math
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray


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

    `resolution_s` of the coarser of the two stamps: `rate_std` is not below what it leaves over the whole span.

    Raises:
        ValueError: fewer than three arrivals, or times that do not increase.
    """
    # Of one chunk the last sample waited least.
    last = np.append(np.diff(host_time_s) > 0.0, True)
    device, host = device_time_s[last], host_time_s[last]
    if device.size < 3 or np.any(np.diff(device) <= 0.0):
        raise ValueError(
            f"A clock map needs at least three arrivals with increasing device time; there are {device.size}."
        )
    middle = float(device.mean())
    centred = device - middle
    kept = np.ones(device.size, bool)
    offset, rate = _line(centred, host)
    residual = host - offset - rate * centred
    for _ in range(10):
        spread = 1.4826 * float(np.median(np.abs(residual[kept] - np.median(residual[kept]))))
        fresh = residual <= max(4.0 * spread, 1e-9)
        if fresh.sum() < 3 or np.array_equal(fresh, kept):
            break
        kept = fresh
        offset, rate = _line(centred[kept], host[kept])
        residual = host - offset - rate * centred
    used = residual[kept]
    rms = float(np.sqrt(np.mean(used**2)))
    lever = float(np.sqrt(np.sum((centred[kept] - centred[kept].mean()) ** 2)))
    # An error anywhere within a step of the grid, at either end: √2 · resolution / √12.
    grid = resolution_s / math.sqrt(6.0) / float(np.ptp(centred[kept]))
    return ClockMap(
        offset_s=offset - rate * middle,
        rate=rate,
        rate_std=math.hypot(rms / lever, grid),
        residual_rms_s=rms,
        residual_max_s=float(np.max(np.abs(used))),
        used=int(kept.sum()),
        late=int((~kept).sum()),
    )


def _line(x: NDArray[np.float64], y: NDArray[np.float64]) -> tuple[float, float]:
    """Least squares: value at x = 0, and slope."""
    middle = float(x.mean())
    slope = float((x - middle) @ (y - y.mean())) / float((x - middle) @ (x - middle))
    return float(y.mean()) - slope * middle, slope
