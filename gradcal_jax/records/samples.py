"""The samples of a run, in a file that is mapped into memory: those of a day may take more memory than there is."""

import tempfile
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any, Final, Self

import numpy as np
from numpy.typing import NDArray

from gradcal_jax.hardware.roles import STANDARD_GRAVITY, ImuBatch
from gradcal_jax.records.log import Reason

_BLOCK: Final = 1 << 16
"""Rows that are copied at once."""
Rows = NDArray[Any]
"""A structured array."""


class SampleFile:
    """Samples of an IMU with `axes` gyros on a table of `table_axes`, in a nameless file in `folder`.

    A context that closes the file; the samples that `rows` maps, each a row with all columns of a log, stay. Errors:
    `OSError` that names the folder where it cannot be written.
    """

    def __init__(self, folder: Path, axes: int = 3, table_axes: int = 0) -> None:
        floats = ("time_s", "host_s", "temperature_c", "second_c")
        columns: list[Any] = [(name, float) for name in floats]
        columns += [("rate", float, (axes,)), ("force", float, (3,)), ("table_rate", float, (table_axes,))]
        columns += [(name, np.int64) for name in ("gap", "standstill", "mounting")]
        columns += [("status", np.uint16), ("disturbed", np.bool_), ("restarted", np.bool_)]
        self.kind = np.dtype(columns)
        self._folder = folder
        self._count = 0
        self._file = self._tried(tempfile.TemporaryFile, dir=folder, buffering=0)

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: object) -> None:
        self._file.close()

    def __len__(self) -> int:
        return self._count

    def push(self, batch: ImuBatch) -> None:
        """The samples of a batch."""
        rows = np.zeros(len(batch), self.kind)
        rows["time_s"] = batch.device_time_s
        rows["host_s"] = batch.host_time_s
        rows["rate"] = np.radians(batch.gyro_dps)
        rows["force"] = batch.acceleration_g * STANDARD_GRAVITY
        rows["temperature_c"] = batch.temperature_c.mean(axis=1)
        rows["second_c"] = batch.second_c
        rows["gap"] = batch.gap_before
        rows["status"] = np.where(batch.status != 0, Reason.MARKED.value, 0)
        rows["disturbed"] = batch.disturbed
        rows["restarted"] = batch.restarted
        self.write(rows)

    def write(self, rows: Rows) -> None:
        """Rows as they are."""
        left = memoryview(rows.tobytes())
        while len(left):
            left = left[self._tried(self._file.write, left) :]
        self._count += len(rows)

    def rows(self) -> Rows:
        """All samples; what is assigned to them is in the file."""
        if not self._count:
            return np.zeros(0, self.kind)
        return np.memmap(self._file, self.kind, "r+", shape=(self._count,))

    def _tried(self, action: Callable[..., Any], *given: Any, **named: Any) -> Any:
        try:
            return action(*given, **named)
        except OSError as problem:
            name = str(self._folder)
            raise type(problem)(problem.errno, problem.strerror or str(problem), name) from None


def compacted(rows: Rows, ranges: Sequence[tuple[int, int]]) -> Rows:
    """The rows of the increasing `ranges` alone, moved to the beginning."""
    count = 0
    for first, end in ranges:
        for begin in range(first, end, _BLOCK):
            block = rows[begin : min(begin + _BLOCK, end)].copy()
            rows[count : count + len(block)] = block
            count += len(block)
    return rows[:count]
