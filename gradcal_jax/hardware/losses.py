"""Missing samples of a step."""

from collections import deque
from dataclasses import dataclass

from .roles import ImuDecoder


class StepNotDone(Exception):
    """A step was not executed as written."""

    def __init__(self, number: int, why: str) -> None:
        Exception.__init__(self, why)
        self.number = number


@dataclass(frozen=True)
class ExecutedStep:
    """A step by its number, on the run's clock."""

    number: int
    began_s: float
    ended_s: float


class SampleLosses:
    """Missing samples of a unit: the stream is decoded once on arrival, and only the losses are kept."""

    def __init__(self, decoder: ImuDecoder, sample_rate_hz: float) -> None:
        self._decoder, self._sample_rate_hz = decoder, sample_rate_hz
        self._losses: deque[tuple[float, int, bool]] = deque(maxlen=1 << 16)
        self.received = self.missing = 0

    def push(self, data: bytes, time_s: float) -> None:
        batch = self._decoder.push(data, time_s)
        missing, restarted = int(batch.gap_before.sum()), bool(batch.restarted.any())
        self.received, self.missing = self.received + len(batch), self.missing + missing
        if missing or restarted:
            self._losses.append((time_s, missing, restarted))

    def between(self, executed: ExecutedStep, share: float) -> str:
        """A sentence where more than a share of a step's samples is missing, or the unit restarted in it."""
        inside = [loss for loss in list(self._losses) if executed.began_s < loss[0] <= executed.ended_s]
        if any(restarted for _, _, restarted in inside):
            return "the unit began anew in mid-step"
        lost = sum(missing for _, missing, _ in inside)
        whole = (executed.ended_s - executed.began_s) * self._sample_rate_hz
        return f"{lost} of {whole:.0f} samples are lost" if lost > share * whole else ""
