"""What a step's samples lack: samples themselves, their rate, or the motion that the table made."""

import itertools
import math
from collections import deque
from dataclasses import dataclass

import numpy as np

from .roles import ImuDecoder
from .track import GyroErrors

# The window in which the rate of samples is measured is at least so long; what a unit's own clock may be off.
_WINDOW_S = 60.0
_RATE_OFF = 0.05
_LEAST_TURN_DEG = 90.0
_USUAL = GyroErrors()
_TOGETHER_S = 0.25


class StepNotDone(Exception):
    """A step was not executed as written; `unit`: the one whose samples it lacks."""

    def __init__(self, number: int, why: str, unit: str = "") -> None:
        Exception.__init__(self, why)
        self.number, self.unit = number, unit


@dataclass(frozen=True)
class ExecutedStep:
    number: int
    began_s: float
    ended_s: float


@dataclass
class _Arrival:
    """Samples that came together: until when, how many, what lacks before them, and how far the unit turned."""

    time_s: float
    received: int = 0
    missing: int = 0
    restarted: bool = False
    turned_deg: float = 0.0


class SampleLosses:
    """The samples of a unit: the stream is decoded once on arrival, and only their numbers are kept."""

    def __init__(self, decoder: ImuDecoder, sample_rate_hz: float, gyros: GyroErrors | None = _USUAL) -> None:
        self._decoder, self._sample_rate_hz, self._gyros = decoder, sample_rate_hz, gyros
        self._arrivals: deque[_Arrival] = deque(maxlen=1 << 16)
        self.received = self.missing = 0

    def begin_again(self, decoder: ImuDecoder) -> None:
        self._decoder = decoder
        self._arrivals.clear()

    def push(self, data: bytes, time_s: float) -> None:
        batch = self._decoder.push(data, time_s)
        missing, restarted = int(batch.gap_before.sum()), bool(batch.restarted.any())
        self.received, self.missing = self.received + len(batch), self.missing + missing
        if not len(batch):
            return
        newest = self._arrivals[-1] if self._arrivals else None
        if newest is None or restarted or time_s - newest.time_s > _TOGETHER_S:
            newest = _Arrival(time_s)
            self._arrivals.append(newest)
        newest.received += len(batch)
        newest.missing += missing
        newest.restarted = newest.restarted or restarted
        newest.turned_deg += float(np.nansum(np.linalg.norm(batch.gyro_dps, axis=1))) * self._decoder.sample_s

    def between(self, executed: ExecutedStep, share: float, latest_s: float, turned_deg: float | None) -> str:
        """A sentence where more than a share of a step's samples is missing, the IMU restarted in it or sends at
        another rate, or where its gyro shows another angle than the table turned (None: unknown).

        `latest_s`: how late the computer may read them.
        """
        known = list(self._arrivals)
        inside = [arrival for arrival in known if executed.began_s < arrival.time_s <= executed.ended_s]
        if any(arrival.restarted for arrival in inside):
            return "the IMU restarted during a step"
        lost, lasted_s = sum(arrival.missing for arrival in inside), executed.ended_s - executed.began_s
        if lost > share * lasted_s * self._sample_rate_hz:
            return f"{lost} of {lasted_s * self._sample_rate_hz:.0f} samples are lost"
        begins_s = min(executed.began_s, executed.ended_s - _WINDOW_S)
        begins_s = max([begins_s, *(one.time_s for one in known if one.restarted and one.time_s <= executed.ended_s)])
        window = [arrival for arrival in known if begins_s <= arrival.time_s <= executed.ended_s]
        if window and (span_s := window[-1].time_s - window[0].time_s) > 0.0:
            count = sum(arrival.received + arrival.missing for arrival in window[1:])
            if abs(count / self._sample_rate_hz - span_s) > _RATE_OFF * span_s + latest_s:
                return f"it sends {count / span_s:.1f} samples/s, and its setting is {self._sample_rate_hz:g}"
        gyros = self._gyros
        if gyros is None or turned_deg is None or turned_deg < _LEAST_TURN_DEG or not inside:
            return ""
        times_s = [executed.began_s, *(arrival.time_s for arrival in inside), executed.ended_s]
        late_s = max(after - before for before, after in itertools.pairwise(times_s))
        shown_deg = sum(arrival.turned_deg for arrival in inside)
        allowed_deg = (gyros.share + late_s / lasted_s) * turned_deg + gyros.bias_dps * lasted_s
        if math.isfinite(shown_deg) and abs(shown_deg - turned_deg) > allowed_deg:
            return f"its gyros measured {shown_deg:.0f} deg in total, and the table turned {turned_deg:.0f}"
        return ""
