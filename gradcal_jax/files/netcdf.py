"""Writing netCDF (HDF5) files, and reading those that may be damaged.

One wrong byte in a file's addresses can make the HDF5 library loop for ever, crash, or allocate all memory, which the
calling program cannot catch. So a file is read here only if its bytes are those that were written: `save_netcdf` puts
their checksum after the data, where HDF5 ignores it. A file without one, of another program, is first read in a
separate process that can be stopped.
"""

import hashlib
import subprocess
import sys
import warnings
from importlib import import_module
from pathlib import Path
from typing import Any, BinaryIO, Final

_SIGNATURE: Final = b"\x89HDF\r\n\x1a\n"
_CHECKSUM: Final = b"\ngradcal_jax sha256 "
_SLOWEST_BYTES_PER_S: Final = 10e6


class NetcdfError(ValueError):
    """A file that is no netCDF that can be read; the message says why, without the file's name."""


def load_netcdf(path: str | Path, trial_s: float = 30.0) -> Any:
    """The whole file as an `xarray.Dataset`; times stay plain numbers, never calendar dates.

    `trial_s` is the time-out of the trial, plus a tenth of a second for each megabyte. Errors: `NetcdfError` for
    damaged files, `OSError` where a file cannot be opened.
    """
    path = Path(path)
    with path.open("rb") as opened:
        if not _signed(opened):
            opened.seek(0)
            begin = opened.read(4096)
            text = bool(begin) and all(byte >= 32 or byte in b"\t\r\n" for byte in begin)
            hint = ", but text: name it .csv, and say with --columns what its columns mean" if text else ""
            raise NetcdfError(f"it is no netCDF 4 file{hint}")
        if _is_as_written(opened):
            return _load(path)
    trial = subprocess.Popen(
        # -P: the modules beside this one must not hide others of the same name.
        [sys.executable, "-P", __file__, str(path)],
        stdin=subprocess.DEVNULL,
        stdout=subprocess.PIPE,
        stderr=subprocess.DEVNULL,
        text=True,
    )
    with trial:
        try:
            import_module("xarray")  # while the trial imports it, too
            reply, _ = trial.communicate(timeout=trial_s + path.stat().st_size / _SLOWEST_BYTES_PER_S)
        except subprocess.TimeoutExpired:
            raise NetcdfError("it is damaged, reading it comes to no end") from None
        finally:
            trial.kill()
    if trial.returncode < 0:
        raise NetcdfError(f"it is damaged, the HDF5 library does not survive it (signal {-trial.returncode})")
    if trial.returncode > 0:
        raise NetcdfError(reply.strip() or "the program that tries it first could not run")
    return _load(path)


def save_netcdf(dataset: Any, path: str | Path) -> None:
    """Write an `xarray.Dataset` atomically. It is built in memory first, because the HDF5 library crashes the program
    where a file cannot grow. Errors: `OSError` that names the file.
    """
    # Imported here, because this file is also run as a script, for the trial.
    from gradcal_jax.files.writing import whole

    contents = dataset.to_netcdf(engine="h5netcdf")
    with whole(path) as passing, passing.open("wb") as opened:
        opened.write(contents)
        opened.write(_CHECKSUM + hashlib.sha256(contents).hexdigest().encode())


def _is_as_written(opened: BinaryIO) -> bool:
    """Whether the file ends in the checksum of all bytes before it."""
    length = opened.seek(0, 2) - len(_CHECKSUM) - 2 * hashlib.sha256().digest_size
    if length <= 0:
        return False
    opened.seek(length)
    end = opened.read()
    if not end.startswith(_CHECKSUM):
        return False
    opened.seek(0)
    checksum = hashlib.sha256()
    while length > 0 and (part := opened.read(min(length, 1 << 20))):
        checksum.update(part)
        length -= len(part)
    return end == _CHECKSUM + checksum.hexdigest().encode()


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


def _load(path: str | Path) -> Any:
    # h5py first: what xarray does when it gives up on a damaged file prints a traceback of its own.
    with import_module("h5py").File(path, "r") as damaged:
        damaged.attrs.get("_nc3_strict")
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")  # of what other programs' files lack; the reader of the contents judges them
        with import_module("xarray").open_dataset(path, engine="h5netcdf", decode_times=False) as opened:
            return opened.load()


if __name__ == "__main__":
    try:
        _load(sys.argv[1])
    except Exception as error:  # whatever HDF5 makes of bytes that are no netCDF
        print(f"it is damaged ({type(error).__name__})")
        sys.exit(1)
