"""Writes and reads netCDF (HDF5) files, with an error message in words if a file cannot be read."""

import warnings
from collections.abc import Iterable, Mapping
from importlib import import_module
from io import FileIO
from pathlib import Path
from typing import Any, Final, NamedTuple

import numpy as np
from numpy.typing import NDArray

from gradcal_jax.tables.display import printable
from gradcal_jax.tables.sizes import check_size
from gradcal_jax.tables.writing import whole

_MOST_ENTRIES: Final = 10_000


class NetcdfError(ValueError):
    """A file that is no netCDF that can be read; the message says why, without the file's name."""


def load_netcdf(path: str | Path) -> Any:
    """The whole file as an `xarray.Dataset`; times stay plain numbers, never calendar dates.

    Errors: `NetcdfError` for damaged files as far as the HDF5 library notices, `OSError` where a file cannot be opened.
    """
    path = Path(path)
    with path.open("rb") as opened:
        begin = opened.read(4096)
    if not import_module("h5py").is_hdf5(path):
        text = bool(begin) and all(byte >= 32 or byte in b"\t\r\n" for byte in begin)
        hint = ", but a text file: name it .csv, and describe its columns with --columns" if text else ""
        raise NetcdfError(f"it is not a netCDF 4 file{hint}")
    try:
        _check(path)
        with warnings.catch_warnings():
            warnings.simplefilter(
                "ignore"
            )  # of what other programs' files lack; the reader of the contents judges them
            with import_module("xarray").open_dataset(path, engine="h5netcdf", decode_times=False) as opened:
                return opened.load()
    except NetcdfError:
        raise
    except Exception as error:  # whatever HDF5 makes of bytes that are no netCDF
        raise NetcdfError(f"it is damaged ({type(error).__name__})") from None


def save_netcdf(dataset: Any, path: str | Path) -> None:
    """Write an `xarray.Dataset` atomically. It is built in memory first, because the HDF5 library crashes the program
    where a file cannot grow. Errors: `OSError` that names the file.
    """
    contents = dataset.to_netcdf(engine="h5netcdf")
    with whole(path) as passing, passing.open("wb") as opened:
        opened.write(contents)


class NetcdfVariable(NamedTuple):
    """A variable of a file that is written in blocks."""

    dimensions: tuple[str, ...]
    kind: type[np.generic] | type[str]
    attributes: Mapping[str, str]


def write_netcdf(
    path: str | Path,
    dimensions: Mapping[str, int],
    variables: Mapping[str, NetcdfVariable],
    attributes: Mapping[str, str | int],
    contents: Iterable[tuple[str, tuple[slice, ...], NDArray[Any]]],
) -> None:
    """Write a file atomically whose `contents` come in blocks (variable, place, values), so that they are never in
    memory together. The file is what xarray makes of the same variables. Errors: `OSError` that names the file.
    """
    h5py: Any = import_module("h5py")
    with whole(path) as passing, _Growing(passing, "w+b") as growing:
        try:
            with import_module("h5netcdf").File(growing, "w") as file:
                file.dimensions = dict(dimensions)
                file.attrs.update(attributes)
                for name, variable in variables.items():
                    kind = h5py.string_dtype() if variable.kind is str else variable.kind
                    # Every value is written: HDF5 need not fill the file with NaN before.
                    fill = {"fillvalue": np.nan, "fill_time": "never"} if kind is np.float64 else {}
                    made = file.create_variable(name, variable.dimensions, kind, **fill)
                    made.attrs.update(variable.attributes)
                for name, place, values in contents:
                    file[name][place] = values
                    if growing.problem is not None:
                        break
        except Exception:
            if growing.problem is None:
                raise
        if growing.problem is not None:
            raise growing.problem


class _Growing(FileIO):
    """A file for HDF5, which crashes the program where a file cannot grow: it hears of no problem, this object keeps
    it."""

    problem: OSError | None = None

    def write(self, data: Any) -> int:
        left = memoryview(data).cast("B")
        size = len(left)
        try:
            while len(left) and self.problem is None:
                left = left[super().write(left) :]
        except OSError as problem:
            self.problem = problem
        return size

    def truncate(self, size: int | None = None) -> int:
        try:
            return super().truncate(size)
        except OSError as problem:
            self.problem = self.problem or problem
            return size or 0

    def readinto(self, buffer: Any) -> int:
        # What could not be written is read as zeros.
        view = memoryview(buffer).cast("B")
        count = super().readinto(view) or 0
        view[count:] = bytes(len(view) - count)
        return len(view)


def _check(path: Path) -> None:
    """Raise `NetcdfError` for data in other files, and for sizes that the file cannot hold."""
    h5py: Any = import_module("h5py")
    seen = declared = 0
    with h5py.File(path, "r") as file:
        # Read here: what xarray does when it gives up on a damaged file prints a traceback of its own.
        file.attrs.get("_nc3_strict")

        def fault(name: str, link: Any) -> str | None:
            nonlocal seen, declared
            seen += 1
            if seen > _MOST_ENTRIES:
                return f"it has more than {_MOST_ENTRIES} entries"
            if not isinstance(link, h5py.HardLink):
                return f"its entry '{printable(name)}' is a link to another place"
            if isinstance(entry := file[name], h5py.Dataset):
                if entry.external or entry.is_virtual:
                    return f"the data of '{printable(name)}' are in another file"
                declared += entry.size * entry.dtype.itemsize if entry.shape is not None else 0
            return None

        if (found := file.visititems_links(fault)) is not None:
            raise NetcdfError(found)
    try:
        check_size(declared, path.stat().st_size)
    except ValueError as error:
        raise NetcdfError(str(error)) from None
