"""Writing netCDF (HDF5) files, and reading them, with a sentence where they cannot be read."""

import warnings
from importlib import import_module
from pathlib import Path
from typing import Any, BinaryIO, Final

from gradcal_jax.files.writing import whole

_SIGNATURE: Final = b"\x89HDF\r\n\x1a\n"


class NetcdfError(ValueError):
    """A file that is no netCDF that can be read; the message says why, without the file's name."""


def load_netcdf(path: str | Path) -> Any:
    """The whole file as an `xarray.Dataset`; times stay plain numbers, never calendar dates.

    Errors: `NetcdfError` for damaged files as far as the HDF5 library notices, `OSError` where a file cannot be opened.
    """
    path = Path(path)
    with path.open("rb") as opened:
        if not _signed(opened):
            opened.seek(0)
            begin = opened.read(4096)
            text = bool(begin) and all(byte >= 32 or byte in b"\t\r\n" for byte in begin)
            hint = ", but text: name it .csv, and say with --columns what its columns mean" if text else ""
            raise NetcdfError(f"it is no netCDF 4 file{hint}")
    try:
        return _load(path)
    except Exception as error:  # whatever HDF5 makes of bytes that are no netCDF
        raise NetcdfError(f"it is damaged ({type(error).__name__})") from None


def save_netcdf(dataset: Any, path: str | Path) -> None:
    """Write an `xarray.Dataset` atomically. It is built in memory first, because the HDF5 library crashes the program
    where a file cannot grow. Errors: `OSError` that names the file.
    """
    contents = dataset.to_netcdf(engine="h5netcdf")
    with whole(path) as passing, passing.open("wb") as opened:
        opened.write(contents)


def _signed(opened: BinaryIO) -> bool:
    """HDF5's signature is at byte 0, or after a user block of 512, 1024, 2048, … bytes."""
    at = 0
    while True:
        opened.seek(at)
        begin = opened.read(len(_SIGNATURE))
        if begin == _SIGNATURE:
            return True
        if len(begin) < len(_SIGNATURE):
            return False
        at = max(512, 2 * at)


def _load(path: Path) -> Any:
    # h5py first: what xarray does when it gives up on a damaged file prints a traceback of its own.
    with import_module("h5py").File(path, "r") as damaged:
        damaged.attrs.get("_nc3_strict")
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")  # of what other programs' files lack; the reader of the contents judges them
        with import_module("xarray").open_dataset(path, engine="h5netcdf", decode_times=False) as opened:
            return opened.load()
