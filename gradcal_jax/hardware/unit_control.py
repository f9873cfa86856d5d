"""The samples of a unit in a run: how many came, and what a step lacks of them.

A step may lack samples themselves, their rate, or the motion that the table made; then it is repeated.
"""

import itertools
import math
from bisect import bisect, bisect_left
from collections import deque
from dataclasses import dataclass
from typing import Final, NamedTuple

import numpy as np

from gradcal_jax.hardware.interlocks import InterlockLimits
from gradcal_jax.hardware.roles import ImuDecoder
from gradcal_jax.hardware.track import GyroErrors

# The rate of samples is measured over at least so long, beside each step's own count.
_WINDOW_S: Final = 60.0
# What a unit's own clock may be off, and how late the last samples of a step may be.
_RATE_OFF: Final = 0.05
_SLACK_S: Final = 0.5
_LEAST_TURN_DEG: Final = 90.0
_TOGETHER_S: Final = 0.25
# Samples of a step's end have come when later ones have; a burst comes in pieces.
_ARRIVAL_S, _PIECES_S = 0.1, 0.2


@dataclass(frozen=True)
class ExecutedStep:
    """A step of the track, and how far the axes turned in it, all turns added up (None: nothing turned)."""

    number: int
    began_s: float
    ended_s: float
    turned_deg: float | None = None


class _Arrival(NamedTuple):
    """Samples that came together, the first of them at `begins_s`, and the last at `time_s`; the rest are sums since
    the stream was started: samples that came, and that lack between them, restarts of the unit, and its turning."""

    begins_s: float
    time_s: float
    received: int = 0
    missing: int = 0
    restarts: int = 0
    turned_deg: float = 0.0


class SampleLosses:
    """The samples of a unit since `start_s`: the stream is decoded once on arrival, and only numbers are kept.

    A sample without any finite rate or force is none.
    """

    def __init__(self, decoder: ImuDecoder, sample_rate_hz: float, gyros: GyroErrors | None, start_s: float) -> None:
        self._decoder, self._sample_rate_hz, self._gyros = decoder, sample_rate_hz, gyros
        self.begin(start_s)

    def begin(self, start_s: float) -> None:
        """Count the samples from here on."""
        self._arrivals: deque[_Arrival] = deque([_Arrival(start_s, start_s)], maxlen=1 << 16)

    @property
    def newest(self) -> _Arrival:
        """The newest samples, or when the stream was started."""
        return self._arrivals[-1]

    def push(self, data: bytes, time_s: float) -> None:
        batch = self._decoder.push(data, time_s)
        usable = np.isfinite(batch.gyro_dps).any(axis=1) | np.isfinite(batch.acceleration_g).any(axis=1)
        if not usable.any():
            return
        before, restarts = self.newest, int(batch.restarted.sum())
        begins_s = time_s
        if before.received > 0 and not restarts and time_s - before.begins_s <= _TOGETHER_S:
            begins_s = before.begins_s
            self._arrivals.pop()
        newest = _Arrival(
            begins_s,
            time_s,
            before.received + int(usable.sum()),
            before.missing + int(batch.gap_before.sum()),
            before.restarts + restarts,
            before.turned_deg + float(np.nansum(np.linalg.norm(batch.gyro_dps, axis=1))) * self._decoder.sample_s,
        )
        self._arrivals.append(newest)

    def complete(self, ended_s: float, now_s: float) -> bool:
        """Whether all samples of a step that ended then have come, as far as one can know."""
        soon_s = ended_s + _ARRIVAL_S
        heard_s = next((arrival.begins_s for arrival in self._since(soon_s) if arrival.time_s >= soon_s), math.inf)
        return max(heard_s, soon_s) + _PIECES_S <= now_s

    def _since(self, time_s: float) -> list[_Arrival]:
        """The arrivals from the last one before a time on."""
        known = list(self._arrivals)
        return known[max(bisect(known, time_s, key=lambda arrival: arrival.time_s) - 1, 0) :]

    def between(self, executed: ExecutedStep, limits: InterlockLimits) -> str:
        """A sentence where a step lacks samples: too many are missing, fewer or more came than the unit's rate makes in
        its time, the IMU restarted, or its gyro shows another angle than the table turned."""
        began_s, ended_s = executed.began_s, executed.ended_s
        known = self._since(min(began_s, ended_s - _WINDOW_S))
        times_s = [arrival.time_s for arrival in known]

        def before(time_s: float) -> _Arrival:
            return known[max(bisect(times_s, time_s) - 1, 0)]

        first, last = before(began_s), before(ended_s)
        if last.restarts > first.restarts:
            return "the IMU restarted during a step"
        lost, lasted_s = last.missing - first.missing, ended_s - began_s
        if lost > limits.lost_share * lasted_s * self._sample_rate_hz:
            return f"{lost} of {lasted_s * self._sample_rate_hz:.0f} samples are lost"
        # A longer time shows smaller errors of the rate; it begins after the last restart.
        since_s = next(arrival.time_s for arrival in known if arrival.restarts == last.restarts)
        for longest_s in (lasted_s, max(lasted_s, _WINDOW_S)):
            # From the last arrival before to the first after, or to the end where nothing came any more.
            begin = before(max(ended_s - longest_s, since_s))
            place = bisect_left(times_s, ended_s)
            after, last_s = (known[place], times_s[place]) if place < len(known) else (known[-1], ended_s)
            received, span_s = after.received - begin.received, last_s - begin.time_s
            count = received + after.missing - begin.missing
            late_s = count / self._sample_rate_hz - span_s
            if not -_RATE_OFF * span_s - _SLACK_S <= late_s <= _RATE_OFF * span_s + limits.latest_s:
                rate = f"{count / span_s:.1f} samples/s, but its setting is {self._sample_rate_hz:g}"
                return f"the IMU sent {received} samples in {span_s:.1f} s: {rate}"
        gyros, turned_deg = self._gyros, executed.turned_deg
        if gyros is None or turned_deg is None or turned_deg < _LEAST_TURN_DEG:
            return ""
        inside_s = [began_s, *(time_s for time_s in times_s if began_s < time_s <= ended_s), ended_s]
        late_s = max(after - before for before, after in itertools.pairwise(inside_s))
        shown_deg = last.turned_deg - first.turned_deg
        allowed_deg = (gyros.share + late_s / lasted_s) * turned_deg + gyros.bias_dps * lasted_s
        if abs(shown_deg - turned_deg) > allowed_deg:
            return f"the IMU's gyros measured {shown_deg:.0f} deg in total, but the table turned {turned_deg:.0f}"
        return ""
