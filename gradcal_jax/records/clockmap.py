"""A device's clock against the run's clock: one line per session, with its residuals.

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
from dataclasses import dataclass
from typing import Any, Final

import numpy as np
from numpy.typing import NDArray

Floats = NDArray[np.float64]

_ARRIVALS_A_STRETCH, _STRETCHES = 8, 128
_ROUNDING_S: Final = 1e-9
# No unit's clock is off by more.
_CREDIBLE: Final = 0.01
_WINDOW_S: Final = 60.0
"""Before and after a gap, in which the quickest arrivals are compared."""


@dataclass(frozen=True)
class ClockMap:
    """`host = offset_s + rate · device`; residuals of the arrivals that were used."""

    offset_s: float
    rate: float
    rate_std: float
    residual_max_s: float


def fit_arrivals(device: Floats, host: Floats, *, resolution_s: float = 0.0) -> ClockMap:
    """Fit the line to the last samples of all chunks, in the order of arrival; three at least.

    `resolution_s` of the coarser of the two stamps limits `rate_std` from below, over the whole span.
    An implausible rate, from a stretch too short to show one, counts as 1, known to `_CREDIBLE`.
    """
    count = len(device)
    middle = float(device.mean())
    x = device - middle
    rate, offset = _line(x, host)
    stretches = np.array_split(np.arange(count), min(max(3, count // _ARRIVALS_A_STRETCH), _STRETCHES))
    quickest = np.zeros(0, np.int64)
    for _ in range(20):
        late = host - offset - rate * x
        fresh = np.array([rows[np.argmin(late[rows])] for rows in stretches])
        # Without the stretches that lie above the bulk, which had no quick arrival.
        above = late[fresh] - np.median(late[fresh])
        kept = above <= max(4.0 * 1.4826 * float(np.median(np.abs(above))), _ROUNDING_S)
        fresh = fresh[kept] if kept.sum() >= 3 else fresh
        if np.array_equal(fresh, quickest):
            break
        quickest = fresh
        rate, offset = _line(x[quickest], host[quickest])
    late = host - offset - rate * x
    near = late <= max(float(late[quickest].max()), _ROUNDING_S)
    rate, offset = _line(x[near], host[near])
    unknown = 0.0
    if abs(rate - 1.0) > _CREDIBLE:
        # The stretch is too short and all arrivals are late: the slope is that of the delays.
        unknown, rate, offset = _CREDIBLE, 1.0, float(np.min(host - x))
        near = host - offset - x <= np.sort(host - offset - x)[2]
    late = (host - offset - rate * x)[near]
    largest = float(np.max(np.abs(late)))
    # Errors at both ends, each anywhere within the residuals (± a/√3) and within a step of the grid (resolution / √12).
    ends = math.hypot(largest / math.sqrt(3.0), resolution_s / math.sqrt(12.0))
    rate_std = max(math.sqrt(2.0) * ends / float(np.ptp(x[near])), unknown)
    return ClockMap(offset - rate * middle, rate, rate_std, largest)


def _line(x: Floats, y: Floats) -> tuple[float, float]:
    """Least squares: slope, and value at x = 0."""
    x_mean, y_mean = float(x.mean()), float(y.mean())
    slope = float((x - x_mean) @ (y - y_mean)) / float((x - x_mean) @ (x - x_mean))
    return slope, y_mean - slope * x_mean


def bridge_gaps(samples: Any, round_s: float, sample_s: float) -> None:
    """Let the sensor's clock go on by the computer's behind a restart, and behind a gap at which a short counter, with
    a period of `round_s` (0: it is long), does not show whole periods; the samples of these are added to `gap`.

    The quickest arrivals before a gap and after it are equally late, but for the time that is missing.
    """
    restarted = samples["restarted"]
    unsure = (samples["gap"] > 0) | samples["disturbed"]
    places = np.flatnonzero(restarted | unsure if round_s else restarted)
    places = places[places > 0]
    if not len(places):
        return
    device: Floats = samples["time_s"].copy()
    host: Floats = samples["host_s"].copy()
    edges = np.concatenate([[0], places, [len(device)]])
    longest = int(np.argmax(np.diff(edges)))
    part = slice(edges[longest], edges[longest + 1])
    arrivals = last_of_chunks(device[part], host[part])
    late = host - (fit_arrivals(*arrivals).rate if len(arrivals[0]) > 2 else 1.0) * device
    shift: Floats = np.zeros(len(device))
    total_s = 0.0
    for row in places.tolist():
        low, high = np.searchsorted(host, [host[row] - _WINDOW_S, host[row] + _WINDOW_S])
        # (Later gaps make what follows later still, and a restart has another clock.)
        again = places[(places > row) & restarted[places]]
        high = min(int(high), *again[:1].tolist(), len(device))
        later_s = float(late[row:high].min() - (late[low:row] - shift[low:row]).min()) - total_s
        if restarted[row]:
            total_s += max(later_s, float(device[row - 1] - device[row]) + sample_s)
        elif later_s > 0.5 * round_s:
            samples["gap"][row] += round(later_s / sample_s)
            total_s += later_s
        shift[row:] = total_s
    samples["time_s"] = device + shift


def last_of_chunks(device: Floats, host: Floats) -> tuple[Floats, Floats]:
    """The stamps of the last samples of all chunks, which waited least: samples of one chunk share the host's time."""
    last = np.append(host[1:] > host[:-1], True)
    return device[last], host[last]
