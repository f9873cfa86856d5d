"""The rows of a log in a spool of samples, and their times by the computer's clock."""

import bisect
from collections.abc import Iterator, Sequence
from typing import Any, Final

import numpy as np
from numpy.typing import NDArray

from gradcal_jax.records import spool
from gradcal_jax.records.clockmap import ClockMap
from gradcal_jax.records.spool import SampleSpool

_STEP: Final = 1 << 12
Floats = NDArray[np.float64]


class RowTimes:
    """The samples of the `ranges` (first, end) of a spool are the rows of a log; their times increase."""

    def __init__(self, samples: SampleSpool, clock: ClockMap, ranges: Sequence[tuple[int, int]]) -> None:
        self._samples, self._clock, self._ranges = samples, clock, ranges
        ends = np.cumsum([end - first for first, end in ranges])
        self._count = int(ends[-1])
        self._firsts: list[int] = [0, *ends[:-1].tolist()]
        # Every so many rows the time of one: a search reads one piece.
        self._index = [self.host_s(row) for row in range(0, self._count, _STEP)]
        self._piece, self._piece_s = -1, np.zeros(0)

    def __len__(self) -> int:
        return self._count

    def seams(self) -> list[int]:
        return self._firsts.copy()

    def read(self, first: int, end: int) -> tuple[Floats, NDArray[Any]]:
        """The times (s) of the rows from `first` to before `end`, and their samples."""
        number = bisect.bisect_right(self._firsts, first) - 1
        parts: list[NDArray[Any]] = []
        while first < end:
            begin, stop = self._ranges[number]
            at = begin + first - self._firsts[number]
            parts.append(self._samples.read(at, min(stop, at + end - first)))
            first, number = first + len(parts[-1]), number + 1
        rows = parts[0] if len(parts) == 1 else np.concatenate(parts)
        return self._clock.host_time_s(rows["device_s"]), rows

    def blocks(self) -> Iterator[tuple[int, Floats, NDArray[Any]]]:
        for first in range(0, self._count, spool.BLOCK):
            yield first, *self.read(first, min(first + spool.BLOCK, self._count))

    def host_s(self, row: int) -> float:
        return float(self.read(row, row + 1)[0][0])

    def device_s(self, row: int) -> float:
        return float(self.read(row, row + 1)[1]["device_s"][0])

    def search(self, time_s: float, side: Any = "left") -> int:
        """As `numpy.searchsorted` in the times of all rows."""
        after = bisect.bisect_left(self._index, time_s) if side == "left" else bisect.bisect_right(self._index, time_s)
        piece = max(0, after - 1)
        if piece != self._piece:
            first = piece * _STEP
            self._piece, self._piece_s = piece, self.read(first, min(first + _STEP, self._count))[0]
        return piece * _STEP + int(np.searchsorted(self._piece_s, time_s, side))
