"""The number of missing samples where a unit's counter wraps, from the host's clock.

A counter that wraps after `R` samples (a STIM300's: 16 at 125 samples/s, 0.128 s) shows a loss modulo R. The host's
stamps show the rest: every sample after a loss of k rounds reaches the host k rounds later than its own count says.
Stamps are late by an unknown delay, but never early, so that only the *quickest* arrivals are compared: `behind`, of
the last `WINDOW_S` before a place, and `ahead`, of the next `WINDOW_S` after it. With `step = (ahead − behind)/round`:

    rounds lost there = nearest whole number to `step`

This is right if the delays of the quickest arrivals in both windows agree within half a round, however late all others
are: a computer that is busy for seconds, a burst that is read in pieces and bytes that wait behind it have no effect.
The number is reported as doubtful where |step − nearest| is more than a quarter of a round, or where fewer than three
arrivals ahead are as quick. So the first wrong number of a stream stays unreported only where the quickest three of a
whole window were late by more than three quarters of a round.

Nothing is counted where the stream has no trace of a loss (a jump of the counter, or bytes outside datagrams): stamps
that are later from there on may be a loss of exactly k rounds, or a computer that is busy for a whole window. This is
reported too. Where a trace follows within the window, it counts as the place of the loss.

The unit's clock may differ from the host's by some 0.05 %: a window then moves by a quarter of a round.
"""

from collections import deque
from dataclasses import dataclass, replace
from typing import Final

import numpy as np
from numpy.typing import NDArray

from ..hardware.roles import ImuBatch

WINDOW_S: Final = 60.0
_FEWEST_ARRIVALS: Final = 3
_SURE: Final = 0.25

Floats = NDArray[np.float64]
Whole = NDArray[np.int64]


@dataclass(frozen=True)
class Doubt:
    """A place where the number of missing samples is not known for certain, and why."""

    row: int
    """The first sample behind it."""
    rounds: int
    """The number counted there; without a trace nothing is counted, and this is the number that the stamps suggest."""
    traced: bool
    why: str


@dataclass(frozen=True)
class _Arrivals:
    """Samples that arrived together, represented by the last, which waited least."""

    last: Whole
    host_s: Floats
    late_s: Floats
    """Host time less device time: up to a constant, how late."""
    ahead_s: Floats
    """The smallest `late_s` of this arrival and of all later ones within the window."""
    follow: Whole
    """How many that are."""


def wraps_resolved(samples: ImuBatch, round_samples: int, sample_s: float) -> tuple[ImuBatch, tuple[Doubt, ...]]:
    """`samples` of one stream, from its first on, with `device_time_s` and `gap_before` from the whole stream.

    `round_samples`: the unit's counter wraps after so many samples (0: its stamps are absolute, and nothing changes);
    `sample_s`: the sampling interval by the unit's clock. The decoder's own number of rounds, from past samples only,
    is dropped.
    """
    if not round_samples or len(samples) < 2:
        return samples, ()
    gaps = samples.gap_before % round_samples
    gaps[0] = samples.gap_before[0]
    since = np.concatenate(([0], np.cumsum(gaps[1:] + 1)))
    last = np.flatnonzero(np.append(np.diff(samples.host_time_s) > 0.0, True))
    host = samples.host_time_s[last]
    late = host - (since * sample_s)[last]
    follow = np.searchsorted(host, host + WINDOW_S, side="right") - np.arange(last.size)
    arrivals = _Arrivals(last, host, late, _minima(late, follow), follow)
    traces = np.flatnonzero((gaps > 0) | samples.disturbed)
    lost, doubts = _lost_rounds(arrivals, traces[traces > 0], round_samples * sample_s)
    for row, rounds in lost.items():
        gaps[row] += rounds * round_samples
    since = np.concatenate(([0], np.cumsum(gaps[1:] + 1)))
    device = samples.device_time_s[0] + since * sample_s
    return replace(samples, device_time_s=device, gap_before=gaps), doubts


def _minima(values: Floats, counts: Whole) -> Floats:
    """For every place the smallest of the `counts` values from there on, by minima of 1, 2, 4, … values."""
    minima, width, least = values.copy(), 1, values
    while width <= int(counts.max(initial=0)):
        here = np.flatnonzero((counts >= width) & (counts < 2 * width))
        minima[here] = np.minimum(least[here], least[here + counts[here] - width])
        if 2 * width > values.size:
            break
        least = np.minimum(least[:-width], least[width:])
        width *= 2
    return minima


def _lost_rounds(arrivals: _Arrivals, traces: Whole, round_s: float) -> tuple[dict[int, int], tuple[Doubt, ...]]:
    """Rounds lost before rows, and the doubtful numbers."""
    lost: dict[int, int] = {}
    doubts: list[Doubt] = []
    quickest: deque[tuple[float, float]] = deque()
    # The step that was reported and not counted, and until when the window behind still shows it.
    reported: deque[tuple[float, int]] = deque()
    shift_s = 0.0
    arrival_of = np.append(np.searchsorted(arrivals.last, traces), arrivals.last.size)
    bounds: list[int] = np.searchsorted(arrival_of, np.arange(arrivals.last.size + 1)).tolist()
    for number in range(arrivals.last.size):
        host_s = float(arrivals.host_s[number])
        low, high = bounds[number], bounds[number + 1]
        while len(quickest) > 1 and quickest[0][0] < host_s - WINDOW_S:
            quickest.popleft()
        while reported and reported[0][0] < host_s:
            reported.popleft()
        if quickest:
            behind_s = shift_s + quickest[0][1]
            step = (float(arrivals.ahead_s[number]) - behind_s) / round_s
            rounds = max(0, round(step))
            if high > low:
                row = int(traces[high - 1])
                if rounds:
                    lost[row] = rounds
                if why := _doubtful(arrivals, number, behind_s, step, round_s, high - low):
                    doubts.append(Doubt(row, rounds, True, why))
                shift_s += rounds * round_s
            elif rounds > (before := sum(count for _, count in reported)):
                # A trace that follows within the window is the place of the loss.
                alone = int(arrival_of[low]) >= number + int(arrivals.follow[number])
                if alone and _agree(arrivals, number, behind_s + rounds * round_s, round_s):
                    why = f"all stamps after it are later by {step - before:.2f} rounds and nothing shows a loss"
                    row = int(arrivals.last[number - 1]) + 1
                    doubts.append(Doubt(row, rounds - before, False, why))
                    reported.append((host_s + WINDOW_S, rounds - before))
        elif high > low:
            doubts.append(Doubt(int(traces[high - 1]), 0, True, "nothing came before it that stamps could tell it by"))
        late_s = float(arrivals.late_s[number]) - shift_s
        while quickest and quickest[-1][1] >= late_s:
            quickest.pop()
        quickest.append((host_s, late_s))
    return lost, tuple(doubts)


def _doubtful(arrivals: _Arrivals, number: int, behind_s: float, step: float, round_s: float, traces: int) -> str:
    """Why the number of rounds lost in an arrival is doubtful; empty where it is not."""
    rounds = max(0, round(step))
    if abs(step - rounds) > _SURE:
        return f"the quickest stamps after it are later by {step:.2f} rounds than those before"
    if not _agree(arrivals, number, behind_s + rounds * round_s, round_s):
        return f"fewer than {_FEWEST_ARRIVALS} quick stamps after it agree"
    if rounds and traces > 1:
        return f"of {traces} losses that were read together the last is taken to be the long one"
    return ""


def _agree(arrivals: _Arrivals, number: int, level_s: float, round_s: float) -> bool:
    """Whether more than one or two later arrivals are about as late."""
    late = arrivals.late_s[number : number + int(arrivals.follow[number])]
    return int(np.count_nonzero(late <= level_s + _SURE * round_s)) >= _FEWEST_ARRIVALS
