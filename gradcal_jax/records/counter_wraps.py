"""How many samples are missing where an IMU's sample counter wraps, decided by the computer's clock.

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
from collections.abc import Iterator
from dataclasses import dataclass
from typing import Final

import numpy as np
from numpy.typing import NDArray

from gradcal_jax.records import spool
from gradcal_jax.records.spool import Rows, SampleSpool, Spool

WINDOW_S: Final = 60.0
_FEWEST_ARRIVALS: Final = 3
_SURE: Final = 0.25

Floats = NDArray[np.float64]
Whole = NDArray[np.int64]


@dataclass(frozen=True)
class Doubt:
    """A place where the number of missing samples is not known for certain, and why."""

    row: int
    """The first sample after this place."""
    rounds: int
    """The number of counter periods that are counted as missing or, without a trace, that the stamps suggest."""
    traced: bool
    why: str


# Samples that arrived together, represented by the last, which waited least. `late_s`: host time less device time, up
# to a constant how late; `traces` of a loss in them, the last before sample `trace`.
_ARRIVALS: Final = [
    ("last", np.int64),
    ("host_s", np.float64),
    ("late_s", np.float64),
    ("traces", np.int64),
    ("trace", np.int64),
]


@dataclass(frozen=True)
class _Window:
    """Arrivals in order, from one on, with what follows each within the window."""

    host_s: Floats
    late_s: Floats
    traces: Whole
    ahead_s: Floats
    """The smallest `late_s` of this arrival and of all later ones within the window."""
    follow: Whole
    """Number of these arrivals."""


def resolve_wraps(samples: SampleSpool, first: int, end: int, round_samples: int, sample_s: float) -> tuple[Doubt, ...]:
    """Correct the device's times and the gaps of the samples from `first` to before `end`: one stream, from its start.

    `round_samples`: the unit's counter wraps after so many samples (0: its stamps are absolute, and nothing changes);
    `sample_s`: the sampling interval by the unit's clock. The decoder's own number of rounds, from past samples only,
    is dropped. Rows of doubts count from `first`.
    """
    if not round_samples or end - first < 2:
        return ()
    with Spool(_ARRIVALS, samples.folder) as arrivals:
        _collect(samples, first, end, round_samples, sample_s, arrivals)
        lost, doubts = _lost_rounds(arrivals, round_samples * sample_s)
    places = np.array(sorted(lost), np.int64)
    counted, device_s = -1, 0.0
    for begin, block in samples.blocks(first, end):
        if begin == first:
            device_s = float(block["device_s"][0])
        gaps = _gaps(block, begin == first, round_samples)
        inside = places[(places >= begin - first) & (places < begin - first + len(block))]
        gaps[inside - (begin - first)] += np.array([lost[place] for place in inside.tolist()], np.int64) * round_samples
        since = _since(gaps, counted)
        counted = int(since[-1])
        block["gap"], block["device_s"] = gaps, device_s + since * sample_s
        samples.write(begin, block)
    return doubts


def _gaps(block: Rows, first: bool, round_samples: int) -> Whole:
    """The gaps that the counter shows; before the first sample of all that of the decoder."""
    gaps: Whole = block["gap"] % round_samples
    if first:
        gaps[0] = block["gap"][0]
    return gaps


def _since(gaps: Whole, counted: int) -> Whole:
    """The number of each sample in the unit's own count, where `counted` is that before; −1: there is none."""
    since = counted + np.cumsum(gaps + 1)
    return since if counted >= 0 else since - gaps[0]


def _collect(samples: SampleSpool, first: int, end: int, round_samples: int, sample_s: float, arrivals: Spool) -> None:
    counted, traces, trace = -1, 0, -1
    for begin, block, last in samples.arrivals(first, end):
        gaps = _gaps(block, begin == first, round_samples)
        since = _since(gaps, counted)
        counted = int(since[-1])
        marks = (gaps > 0) | block["disturbed"]
        marks[0] &= begin > first
        # Traces up to a row, and the last of them, from those of the arrival that an earlier block began.
        upto = traces + np.cumsum(marks)
        latest = np.maximum.accumulate(np.where(marks, np.arange(len(block)) + (begin - first), trace))
        host = block["host_s"][last]
        arrivals.append(
            last=last + (begin - first),
            host_s=host,
            late_s=host - since[last] * sample_s,
            traces=np.diff(upto[last], prepend=0),
            trace=latest[last],
        )
        traces, trace = int(upto[-1]) - (int(upto[last[-1]]) if len(last) else 0), int(latest[-1])


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


def _windows(arrivals: Spool) -> Iterator[tuple[int, Whole, Whole, _Window]]:
    """Blocks of arrivals and all that the window holds of what follows: how many they are, the last sample
    and the trace of each."""
    for first, block in arrivals.blocks():
        count = len(block)
        parts, ends = [block], first + count
        while ends < len(arrivals) and parts[-1]["host_s"][-1] <= block["host_s"][-1] + WINDOW_S:
            parts.append(arrivals.read(ends, ends + max(1, spool.BLOCK // 8)))
            ends += len(parts[-1])
        host, late, traces = (np.concatenate([part[name] for part in parts]) for name in ("host_s", "late_s", "traces"))
        follow = np.searchsorted(host, host + WINDOW_S, side="right") - np.arange(host.size)
        yield count, block["last"], block["trace"], _Window(host, late, traces, _minima(late, follow), follow)


def _lost_rounds(arrivals: Spool, round_s: float) -> tuple[dict[int, int], tuple[Doubt, ...]]:
    """Rounds lost before rows, and the doubtful numbers."""
    lost: dict[int, int] = {}
    doubts: list[Doubt] = []
    quickest: deque[tuple[float, float]] = deque()
    # The step that was reported and not counted, and until when the window behind still shows it.
    reported: deque[tuple[float, int]] = deque()
    shift_s, before_row = 0.0, -1
    for count, last, trace, window in _windows(arrivals):
        for number in range(count):
            host_s, traces = float(window.host_s[number]), int(window.traces[number])
            while len(quickest) > 1 and quickest[0][0] < host_s - WINDOW_S:
                quickest.popleft()
            while reported and reported[0][0] < host_s:
                reported.popleft()
            if quickest:
                behind_s = shift_s + quickest[0][1]
                step = (float(window.ahead_s[number]) - behind_s) / round_s
                rounds = max(0, round(step))
                if traces:
                    row = int(trace[number])
                    if rounds:
                        lost[row] = rounds
                    if why := _doubtful(window, number, behind_s, step, round_s, traces):
                        doubts.append(Doubt(row, rounds, True, why))
                    shift_s += rounds * round_s
                elif rounds > (before := sum(times for _, times in reported)):
                    # A trace that follows within the window is the place of the loss.
                    alone = not window.traces[number : number + int(window.follow[number])].any()
                    if alone and _agree(window, number, behind_s + rounds * round_s, round_s):
                        why = (
                            f"all samples after this place arrive {step - before:.2f} counter periods later than "
                            "the sample counter says, and nothing else indicates a loss"
                        )
                        doubts.append(Doubt(before_row + 1, rounds - before, False, why))
                        reported.append((host_s + WINDOW_S, rounds - before))
            elif traces:
                why = "there are no time stamps before this place to compare with"
                doubts.append(Doubt(int(trace[number]), 0, True, why))
            late_s = float(window.late_s[number]) - shift_s
            while quickest and quickest[-1][1] >= late_s:
                quickest.pop()
            quickest.append((host_s, late_s))
            before_row = int(last[number])
    return lost, tuple(doubts)


def _doubtful(window: _Window, number: int, behind_s: float, step: float, round_s: float, traces: int) -> str:
    """Why the number of rounds lost in an arrival is doubtful; empty where it is not."""
    rounds = max(0, round(step))
    if abs(step - rounds) > _SURE:
        return (
            f"relative to the sample counter, even the samples with the smallest delay arrive {step:.2f} counter "
            "periods later after this place than before it"
        )
    if not _agree(window, number, behind_s + rounds * round_s, round_s):
        return (
            f"after this place, too few arrivals of samples (fewer than {_FEWEST_ARRIVALS}) had a delay small "
            "enough to confirm this number of lost counter periods"
        )
    if rounds and traces > 1:
        return (
            f"one reading of the port contains {traces} losses of samples; the last of them is assumed to be the one "
            "that is longer than a counter period"
        )
    return ""


def _agree(window: _Window, number: int, level_s: float, round_s: float) -> bool:
    """Whether more than one or two later arrivals are about as late."""
    late = window.late_s[number : number + int(window.follow[number])]
    return int(np.count_nonzero(late <= level_s + _SURE * round_s)) >= _FEWEST_ARRIVALS
