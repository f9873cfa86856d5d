"""Rows in a temporary file: the samples of a day do not fit into the memory that a computer can spare."""

import tempfile
from collections.abc import Iterator
from pathlib import Path
from typing import Any, Final, Protocol, Self

import numpy as np
from numpy.typing import NDArray

from gradcal_jax.hardware.roles import ImuBatch

BLOCK: Final = 1 << 15
"""Rows that are in memory at once."""
Rows = NDArray[Any]
"""A structured array."""


class StoredColumn(Protocol):
    """Numbers that are read a slice at a time: an array, or a column of a spool."""

    def __len__(self) -> int: ...
    def __getitem__(self, rows: slice, /) -> NDArray[np.float64]: ...


class Spool:
    """Rows of one structured `kind`, in a file without a name that ends with this object or the process.

    `folder`: where the file lies. Errors: `OSError` that names the folder, where it cannot be written.
    """

    def __init__(self, kind: list[Any], folder: Path | None = None) -> None:
        self.kind = np.dtype(kind)
        self.folder = folder
        self._file = tempfile.TemporaryFile(dir=folder, buffering=0)  # noqa: SIM115
        self._count = 0

    def __len__(self) -> int:
        return self._count

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: object) -> None:
        self._file.close()

    def append(self, **columns: NDArray[Any]) -> None:
        rows = np.empty(len(next(iter(columns.values()))), self.kind)
        for name, values in columns.items():
            rows[name] = values
        self.write(self._count, rows)

    def write(self, first: int, rows: Rows) -> None:
        left = memoryview(rows.tobytes())
        try:
            self._file.seek(first * self.kind.itemsize)
            while len(left):
                left = left[self._file.write(left) :]
        except OSError as problem:
            where = str(self.folder or tempfile.gettempdir())
            raise type(problem)(problem.errno, problem.strerror or str(problem), where) from None
        self._count = max(self._count, first + len(rows))

    def read(self, first: int, end: int) -> Rows:
        data = bytearray(max(0, min(end, self._count) - first) * self.kind.itemsize)
        view, done = memoryview(data), 0
        self._file.seek(first * self.kind.itemsize)
        while done < len(view):
            done += self._file.readinto(view[done:])
        return np.frombuffer(data, self.kind)

    def blocks(self, first: int = 0, end: int | None = None) -> Iterator[tuple[int, Rows]]:
        """All rows from `first` to before `end` in order: the number of a block's first row, and the block."""
        end = self._count if end is None else end
        for begin in range(first, end, BLOCK):
            yield begin, self.read(begin, min(begin + BLOCK, end))

    def column(self, name: str) -> StoredColumn:
        return _SpoolColumn(self, name)


class _SpoolColumn:
    def __init__(self, spool: Spool, name: str) -> None:
        self._spool, self._name = spool, name

    def __len__(self) -> int:
        return len(self._spool)

    def __getitem__(self, rows: slice) -> NDArray[np.float64]:
        first, end, _ = rows.indices(len(self._spool))
        return np.ascontiguousarray(self._spool.read(first, end)[self._name])


class SampleSpool(Spool):
    """Samples of a unit with `axes` gyro axes: of an `ImuBatch` what a log needs."""

    def __init__(self, axes: int = 3, folder: Path | None = None) -> None:
        real, whole = np.float64, np.int64
        super().__init__(
            [
                ("host_s", real),
                ("device_s", real),
                ("gyro_dps", real, (axes,)),
                ("acceleration_g", real, (3,)),
                ("temperature_c", real),
                ("second_c", real),
                ("status", whole),
                ("gap", whole),
                ("disturbed", np.bool_),
            ],
            folder,
        )

    def arrivals(self, first: int, end: int) -> Iterator[tuple[int, Rows, NDArray[np.int64]]]:
        """Blocks as of `blocks`, and the places in each of the last samples that came together, which waited least."""
        for begin, block in self.blocks(first, end):
            stop = begin + len(block)
            after = self.read(stop, stop + 1)["host_s"] if stop < end else np.array([np.inf])
            yield begin, block, np.flatnonzero(np.diff(block["host_s"], append=after) > 0.0)

    def push(self, batch: ImuBatch) -> None:
        self.append(
            host_s=batch.host_time_s,
            device_s=batch.device_time_s,
            gyro_dps=batch.gyro_dps,
            acceleration_g=batch.acceleration_g,
            temperature_c=batch.temperature_c.mean(axis=1),
            second_c=batch.second_c,
            status=batch.status,
            gap=batch.gap_before,
            disturbed=batch.disturbed,
        )
