"""A device's clock against the run's clock: one line per stream, with its residuals.

Bytes arrive late, never early: delayed by the unit, the adapter and the operating system, sometimes by much; of a burst
that is read in pieces, all but the last piece waited for the rest. The delay of most arrivals carries no information,
so the line is fitted to the quickest: the quickest of each of many stretches of the stream, and all arrivals as near to
the line as they are. Calibration needs the rate (a sensor's clock is a scale factor); the offset includes the latency
of the quickest arrivals.

The scatter of many stamps does not average out: how long the quickest arrivals take changes with what else the computer
does, for minutes, so that either end of the line may be late by as much as the arrivals along it differ. Nor does the
resolution of the stamps: the rate is uncertain by both over the span, however many arrivals there are (in virtual time,
where bytes take no time, both are only rounding).
"""

import math
from collections.abc import Callable, Iterable, Iterator
from dataclasses import dataclass
from typing import Final

import numpy as np
from numpy.typing import NDArray

from gradcal_jax.records.spool import StoredColumn

Floats = NDArray[np.float64]
_Spans = Callable[[], Iterable[tuple[Floats, Floats]]]

_ARRIVALS_A_STRETCH: Final = 8
_STRETCHES: Final = 128
_SPAN: Final = 1 << 18  # arrivals in memory at once
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


def fit_arrivals(device: StoredColumn, host: StoredColumn, *, resolution_s: float = 0.0) -> ClockMap:
    """Fit the line to the last samples of all chunks, in the order of arrival, which are read a span at a time.

    `resolution_s` of the coarser of the two stamps limits `rate_std` from below, over the whole span.
    An implausible rate, from a stretch too short to show one, counts as 1, known to `_CREDIBLE`.

    Raises `ValueError` for fewer than three arrivals, or times that do not increase.
    """
    count = len(device)
    if count < 3 or not _increasing(device):
        raise ValueError(
            f"The relation of two clocks needs at least three samples whose device times increase; there are "
            f"{count} samples."
        )
    firsts = range(0, count, _SPAN)
    middle = sum(float(device[first : first + _SPAN].sum()) for first in firsts) / count

    def part(first: int, end: int) -> tuple[Floats, Floats]:
        return device[first:end] - middle, host[first:end]

    def spans() -> Iterator[tuple[Floats, Floats]]:
        return (part(first, min(first + _SPAN, count)) for first in firsts)

    offset, rate = _line(spans)
    stretches = _split(count, min(max(3, count // _ARRIVALS_A_STRETCH), _STRETCHES))
    quickest = np.zeros(0, np.int64)
    centred, stamps = np.zeros(0), np.zeros(0)
    for _ in range(20):
        rows: list[tuple[int, float, float, float]] = []
        for first, end in stretches:
            x, y = part(first, end)
            residual = y - offset - rate * x
            least = int(np.argmin(residual))
            rows.append((first + least, float(x[least]), float(y[least]), float(residual[least])))
        fresh, *points = (np.array(column) for column in zip(*rows, strict=True))
        bulk = _not_above(points[2])
        if np.array_equal(fresh[bulk], quickest):
            break
        quickest, centred, stamps = fresh[bulk], points[0][bulk], points[1][bulk]
        offset, rate = _line(lambda at=(centred, stamps): [at])
    most = max(float((stamps - offset - rate * centred).max()), _ROUNDING_S)
    line = offset, rate

    def kept() -> Iterator[tuple[Floats, Floats]]:
        for x, y in spans():
            near = y - line[0] - line[1] * x <= most
            yield x[near], y[near]

    offset, rate = _line(kept)
    unknown = 0.0
    if abs(rate - 1.0) > _CREDIBLE:
        # The stretch is too short and all arrivals are late: the slope is that of the delays.
        unknown, rate, offset = _CREDIBLE, 1.0, min(float(np.min(y - x)) for x, y in spans())
        line = offset, rate
        quick = np.concatenate([np.sort(y - offset - x)[:3] for x, y in spans()])
        most = float(np.sort(quick)[2])
    used, squares, largest, low, high = 0, 0.0, 0.0, math.inf, -math.inf
    for x, y in kept():
        if len(x):
            residual = y - offset - rate * x
            used, squares = used + len(x), squares + float((residual**2).sum())
            largest = max(largest, float(np.max(np.abs(residual))))
            low, high = min(low, float(x.min())), max(high, float(x.max()))
    # Errors at both ends, each anywhere within the residuals (± a/√3) and within a step of the grid (resolution / √12).
    ends = math.hypot(largest / math.sqrt(3.0), resolution_s / math.sqrt(12.0))
    rate_std = max(math.sqrt(2.0) * ends / (high - low), unknown)
    return ClockMap(offset - rate * middle, rate, rate_std, math.sqrt(squares / used), largest, used, count - used)


def _increasing(column: StoredColumn) -> bool:
    return all(bool(np.all(np.diff(column[first : first + _SPAN + 1]) > 0.0)) for first in range(0, len(column), _SPAN))


def _split(count: int, parts: int) -> list[tuple[int, int]]:
    """First and end of `parts` pieces whose lengths differ by one at most, the longer ones first."""
    ends = np.cumsum([count // parts + (number < count % parts) for number in range(parts)]).tolist()
    return list(zip([0, *ends[:-1]], ends, strict=True))


def _not_above(residual: NDArray[np.float64]) -> NDArray[np.bool_]:
    """Without the stretches that lie above the bulk, which had no quick arrival. At least three stay."""
    middle = float(np.median(residual))
    spread = 1.4826 * float(np.median(np.abs(residual - middle)))
    kept = residual <= middle + max(4.0 * spread, _ROUNDING_S)
    return kept if kept.sum() >= 3 else np.ones(residual.size, bool)


def _line(spans: _Spans) -> tuple[float, float]:
    """Least squares: value at x = 0, and slope."""
    sums = [(len(x), float(x.sum()), float(y.sum())) for x, y in spans()]
    count, *totals = (sum(column) for column in zip(*sums, strict=True))
    x_mean, y_mean = (total / count for total in totals)
    products = [(float((x - x_mean) @ (y - y_mean)), float((x - x_mean) @ (x - x_mean))) for x, y in spans()]
    cross, own = (sum(column) for column in zip(*products, strict=True))
    return y_mean - cross / own * x_mean, cross / own
