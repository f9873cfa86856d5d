"""Shared by the decoders of IMU streams: building and joining batches, and counting missing samples."""

from collections import deque
from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from ..roles import ImuBatch

STANDARD_GRAVITY = 9.80665  # m/s² in one g of every data sheet here
_ARRIVALS = 256


def join(batches: Sequence[ImuBatch]) -> ImuBatch:
    """One batch of several; an empty one of none."""
    if not batches:
        return ImuBatch(
            host_time_s=np.zeros(0),
            device_time_s=np.zeros(0),
            gyro_dps=np.zeros((0, 3)),
            acceleration_g=np.zeros((0, 3)),
            temperature_c=np.zeros((0, 3)),
            raw_gyro=np.zeros((0, 3), np.int32),
            status=np.zeros(0, np.int64),
            gap_before=np.zeros(0, np.int64),
            disturbed=np.zeros(0, np.bool_),
            restarted=np.zeros(0, np.bool_),
        )
    names = ImuBatch.__dataclass_fields__
    return ImuBatch(**{name: np.concatenate([getattr(batch, name) for batch in batches]) for name in names})


class GapCounter:
    """Unwraps a sample counter and says how many samples are missing before each one.

    A counter that wraps after `modulus` samples cannot show the loss of a whole number of wraps by itself. After a
    disturbance of the stream the host's clock gives the number of wraps; without one, a late chunk is only late. The
    host's clock is compared with the quickest of the recent arrivals, because a busy computer stamps bytes late.

    This uses the past only, and is right where the chunk after a disturbance is later than the quickest of the
    `_ARRIVALS` before it by less than half a wrap. A log uses the later samples, too (`decoding.counter_wraps`).
    """

    def __init__(self, *, step: int, modulus: int, ticks_per_s: float) -> None:
        self._step, self._modulus, self._ticks_per_s = step, modulus, ticks_per_s
        self._count = 0
        self._last_raw: int | None = None
        self._offsets_s: deque[float] = deque(maxlen=_ARRIVALS)

    def push(
        self, raw: NDArray[np.int64], host_time_s: float, *, disturbed: bool
    ) -> tuple[NDArray[np.int64], NDArray[np.int64]]:
        """Unwrapped counts and gaps of samples that came together; `disturbed`: bytes were lost before the first."""
        previous = raw[0] - self._step if self._last_raw is None else self._last_raw
        delta = np.mod(np.diff(raw, prepend=previous), self._modulus)
        delta[delta == 0] = self._modulus
        if disturbed and self._offsets_s:
            # The last sample has waited least: the counter's value when the host has it.
            now = (host_time_s - min(self._offsets_s)) * self._ticks_per_s
            lost = (now - float(self._count + delta.sum())) / self._modulus
            delta[0] += self._modulus * max(0, round(lost))
        counts = self._count + np.cumsum(delta)
        self._count, self._last_raw = int(counts[-1]), int(raw[-1])
        self._offsets_s.append(host_time_s - self._count / self._ticks_per_s)
        return counts, delta // self._step - 1
