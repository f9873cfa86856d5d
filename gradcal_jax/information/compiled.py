"""C++ code for programs of JAX: the machine's own compiler compiles it at first use; the user's cache folder keeps it.

The compiler runs in parallel to the caller: the code is awaited when a program is lowered, not when it is traced.

Without a compiler, in programs for other devices, or with `GRADCAL_NATIVE=0` XLA computes the same several times
slower, equal up to rounding.
"""

import ctypes
import functools
import hashlib
import os
import platform
import shlex
import shutil
import subprocess
import tempfile
import threading
import warnings
from concurrent.futures import Future, ThreadPoolExecutor
from importlib.metadata import version
from pathlib import Path
from typing import NamedTuple

import jax
import jax.numpy as jnp
from jax.dtypes import canonicalize_dtype
from jaxtyping import Array

from gradcal_jax.cache import cache_folder

# Folder of the headers that all sources include.
_HEADERS = Path(__file__).parent
# Fused multiply-add stays on; no option that reorders sums.
_OPTIONS = ("-std=gnu++17", "-O3", "-fno-math-errno", "-fno-trapping-math", "-w", "-shared", "-fPIC")
_LONGEST_S = 120.0
# C++ names of the supported precisions.
_REAL = {"float32": "float", "float64": "double"}
_ONE_AT_A_TIME = threading.Lock()
_BESIDE = ThreadPoolExecutor(2, "gradcal-compiler")


class NotCompiled(Exception):
    """The compiler failed; a warning was issued."""


class Library(NamedTuple):
    """The loaded library, and the names of its functions in JAX."""

    loaded: ctypes.CDLL
    names: tuple[str, ...]


class CompiledSource(NamedTuple):
    """The functions of a source whose compilation may still be running."""

    work: "Future[Library]"
    what: str

    def wait(self) -> Library:
        """The library. Raises `NotCompiled` after a warning that names `what` and the reason."""
        try:
            return self.work.result()
        except (OSError, subprocess.SubprocessError) as e:
            output = getattr(e, "stderr", None)
            warnings.warn(
                f"{self.what} could not be compiled, so JAX computes it (several times slower): "
                f"{e}{': ' + output.strip()[-500:] if output else ''} (set the environment variable CXX to use "
                "another compiler, or GRADCAL_NATIVE=0 to use none)",
                RuntimeWarning,
                stacklevel=2,
            )
            raise NotCompiled(self.what) from e


def double_or_single(*arrays) -> str | None:
    """C++ name of the precision of all arrays in JAX; None where they differ or it is not supported."""
    kinds = {canonicalize_dtype(x.dtype).name for x in arrays}
    return _REAL.get(kinds.pop()) if len(kinds) == 1 else None


def compiled(source: Path, *definitions: str, symbols: tuple[str, ...], what: str) -> CompiledSource | None:
    """Start compilation of a source, once; None without a compiler."""
    if os.environ.get("GRADCAL_NATIVE") == "0" or os.name != "posix":
        return None
    with _ONE_AT_A_TIME:
        return _begun(source, definitions, symbols, what)


@functools.cache
def _begun(source: Path, definitions: tuple[str, ...], symbols: tuple[str, ...], what: str) -> CompiledSource | None:
    command = compiler()
    return (
        None
        if command is None
        else CompiledSource(_BESIDE.submit(_library, command, source, definitions, symbols), what)
    )


def call(name: str, shapes, arguments) -> list[Array]:
    """Results of a registered function, with these shapes and the precision of the first argument."""
    dtype = canonicalize_dtype(arguments[0].dtype)
    results = [jax.ShapeDtypeStruct(shape, dtype) for shape in shapes]
    # The code reads raw bytes, so that conversions of JAX have to happen here.
    alike = [x if x.dtype == bool else jnp.asarray(x, dtype) for x in arguments]
    return list(jax.ffi.ffi_call(name, results, vmap_method="broadcast_all")(*alike))


def compiler() -> list[str] | None:
    """The command of the machine's C++ compiler, or None."""
    if named := os.environ.get("CXX"):
        return shlex.split(named)
    command = next(filter(None, map(shutil.which, ("c++", "g++", "clang++"))), None)
    return None if command is None else [command]


def _library(command: list[str], source: Path, definitions: tuple[str, ...], symbols: tuple[str, ...]) -> Library:
    """The compiled functions, registered in JAX by unique names."""
    loaded, key = _loaded(command, source, definitions)
    names = tuple(f"{symbol}_{key}" for symbol in symbols)
    for name, symbol in zip(names, symbols, strict=True):
        jax.ffi.register_ffi_target(name, jax.ffi.pycapsule(getattr(loaded, symbol)), platform="cpu")
    return Library(loaded, names)


def is_at_hand(source: Path, *definitions: str) -> bool:
    """Whether the cache folder has a source's functions, without waiting for a compiler."""
    if os.environ.get("GRADCAL_NATIVE") == "0" or os.name != "posix" or (command := compiler()) is None:
        return False
    path, _ = _place(tuple(command), source, definitions)
    return path is not None and path.exists()


@functools.cache
def _place(command: tuple[str, ...], source: Path, definitions: tuple[str, ...]) -> tuple[Path | None, str]:
    """The path of a library in the cache folder, and its unique key."""
    texts = [path.read_text() for path in (source, *sorted(_HEADERS.glob("*.h")))]
    parts = (*texts, version("jaxlib"), *command, _version(*command), *_OPTIONS, *definitions, _processor())
    key = hashlib.sha256("\n".join(parts).encode()).hexdigest()[:16]
    folder = cache_folder()
    return None if folder is None else folder / f"{source.stem}-{key}.so", key


def _loaded(command: list[str], source: Path, definitions: tuple[str, ...]) -> tuple[ctypes.CDLL, str]:
    """The compiled functions, from the cache folder if they are there, and their unique key."""
    path, key = _place(tuple(command), source, definitions)
    if path is None:
        with tempfile.TemporaryDirectory() as alone:
            return ctypes.CDLL(str(_compile(command, source, definitions, Path(alone) / f"{source.stem}.so"))), key
    if path.exists():
        try:
            return ctypes.CDLL(str(path)), key
        except OSError:  # Truncated, by a full disk perhaps: compiled again.
            path.unlink(missing_ok=True)
    return ctypes.CDLL(str(_compile(command, source, definitions, path))), key


def _compile(command: list[str], source: Path, definitions: tuple[str, ...], path: Path) -> Path:
    """Compile to `path`, atomically; for this processor unless the compiler does not support that."""
    with tempfile.TemporaryDirectory(dir=path.parent) as scratch:
        library = Path(scratch) / path.name
        folders = [f"-I{jax.ffi.include_dir()}", f"-I{_HEADERS}"]
        whole = [*command, *_OPTIONS, *definitions, *folders, str(source), "-o", str(library)]
        for tuned in (["-march=native"], []):
            done = subprocess.run([*whole, *tuned], capture_output=True, text=True, check=False, timeout=_LONGEST_S)
            if done.returncode == 0:
                break
        done.check_returncode()
        library.replace(path)
    return path


@functools.cache
def _version(*command: str) -> str:
    asked = subprocess.run([*command, "--version"], capture_output=True, text=True, check=True, timeout=_LONGEST_S)
    return asked.stdout


def _processor() -> str:
    """Identification of the processor: machines with different ones may share a home folder."""
    try:
        lines = Path("/proc/cpuinfo").read_text().splitlines()
    except OSError:
        lines = []
    features = next((line for line in lines if line.startswith(("flags", "Features"))), platform.processor())
    return f"{platform.system()} {platform.machine()} {features}"
