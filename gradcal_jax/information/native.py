"""The filter and its derivative in machine code, for NumPy, and for JAX on a CPU.

XLA pays for every pass over N × p numbers what a whole product costs; `filter.cc` goes through the readings once. The
machine's own C++ compiler makes it at first use, a second for each number of noise states, and the user's cache
folder keeps it. Without a compiler, in programs for other devices, or with `GRADCAL_NATIVE=0` the same is computed by
XLA (`whitening.filter_columns`, `adjoint`): several times slower, and equal but for rounding.
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
from collections.abc import Callable
from importlib.metadata import version
from pathlib import Path
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jax.dtypes import canonicalize_dtype
from jaxtyping import Array, Float

from gradcal_jax.arrays import AnyArray
from gradcal_jax.cache import cache_folder
from gradcal_jax.information.noise_steps import NoiseSteps

_SOURCE = Path(__file__).with_name("filter.cc")
# Contractions to fused products stay on; nothing that reorders sums.
_OPTIONS = ("-std=gnu++17", "-O3", "-fno-math-errno", "-fno-trapping-math", "-w", "-shared", "-fPIC")
_LONGEST_S = 120.0
_REAL = {"float32": "float", "float64": "double"}
_ONE_AT_A_TIME = threading.Lock()


class Kept(NamedTuple):
    """What the derivative needs of the filter, at each reading: x and P before it, `P Hᵀ/S` and `1/√S`."""

    states: Float[AnyArray, "N n p"]
    covariances: Float[AnyArray, "N n n"]
    gains: Float[AnyArray, "N n"]
    per_std: Float[AnyArray, " N"]


class Native(NamedTuple):
    """The names under which JAX finds the compiled functions for one number of states and one precision."""

    filter: str
    pull: str

    def whiten(
        self,
        mean: Float[Array, "n p"],
        covariance: Float[Array, "n n"],
        steps: NoiseSteps,
        columns: Float[Array, "N p"],
    ) -> list[Array]:
        """Whitened rows `(N, p)`, and state and covariance after the last reading."""
        shapes = (columns.shape, mean.shape, covariance.shape)
        return _call(self.filter, shapes, (*steps[:5], mean, covariance, columns))

    def keep(self, steps: NoiseSteps, columns: Float[Array, "N p"]) -> tuple[Float[Array, "N p"], Kept]:
        """Whitened rows from states of zero, and what `cotangents` wants."""
        (count, n), p = steps.observation.shape, columns.shape[1]
        shapes = ((count, p), (n, p), (n, n), (count, n, p), (count, n, n), (count, n), (count,))
        zero = jnp.zeros((n, p), columns.dtype)
        rows, _, _, *kept = _call(self.filter, shapes, (*steps[:5], zero, steps.initial, columns))
        return rows, Kept(*kept)

    def cotangents(
        self, steps: NoiseSteps, rows: Float[Array, "N p"], kept: Kept, of_product: Float[Array, "p p"]
    ) -> list[Array]:
        """Of transition, covariance, observation, reading variance, initial and columns, for that of `rowsᵀ rows`."""
        weighed = rows @ ((of_product + of_product.T) / 2)
        shapes = [x.shape for x in (*steps[:4], steps.initial, rows)]
        return _call(self.pull, shapes, (*steps[:6], _stays(steps, jnp), rows, weighed, *kept))


class Plain(NamedTuple):
    """The compiled functions for NumPy's arrays of doubles."""

    filter: Callable[..., None]
    pull: Callable[..., None]

    def whiten(
        self,
        mean: Float[np.ndarray, "n p"],
        covariance: Float[np.ndarray, "n n"],
        steps: NoiseSteps,
        columns: Float[np.ndarray, "N p"],
        *,
        keep: bool = False,
    ) -> tuple[np.ndarray, np.ndarray, np.ndarray, Kept | None]:
        """Whitened rows `(N, p)`, state and covariance after the last reading, and what `cotangents` wants."""
        (count, n), p = steps.observation.shape, columns.shape[1]
        rows, after, covariance_after = np.empty((count, p)), np.empty((n, p)), np.empty((n, n))
        shapes = ((count, n, p), (count, n, n), (count, n), (count,))
        kept = Kept(*map(np.empty, shapes)) if keep else None
        made = [rows, after, covariance_after, *(kept or (None,) * 4)]
        _plainly(self.filter, count, p, (*steps[:5], mean, covariance, columns), made)
        return rows, after, covariance_after, kept

    def cotangents(self, steps: NoiseSteps, rows: np.ndarray, kept: Kept, of_product: np.ndarray) -> list[np.ndarray]:
        """As of `Native`."""
        weighed = rows @ ((of_product + of_product.T) / 2)
        made = [np.empty(np.shape(x)) for x in (*steps[:4], steps.initial, rows)]
        _plainly(self.pull, len(rows), rows.shape[1], (*steps[:6], _stays(steps, np), rows, weighed, *kept), made)
        return made


def _stays(steps: NoiseSteps, xp) -> AnyArray:
    return xp.zeros(steps.used.shape, bool) if steps.stays is None else xp.asarray(steps.stays)


def _plainly(function, count: int, p: int, arguments, results) -> None:
    alike = [np.ascontiguousarray(x, bool if np.asarray(x).dtype == bool else float) for x in arguments]
    addresses = [None if x is None else x.ctypes.data for x in (*alike, *results)]
    function(ctypes.c_int64(count), ctypes.c_int64(p), *map(ctypes.c_void_p, addresses))


def plain(states: int) -> Plain | None:
    """The machine code for NumPy's doubles, or None where there is none."""
    if os.environ.get("GRADCAL_NATIVE") == "0" or os.name != "posix" or not states:
        return None
    with _ONE_AT_A_TIME:
        made = _made(states, "double")
    return None if made is None else Plain(made[0].gradcal_filter_plain, made[0].gradcal_pull_plain)


def _call(name: str, shapes, arguments) -> list[Array]:
    dtype = canonicalize_dtype(arguments[0].dtype)
    results = [jax.ShapeDtypeStruct(shape, dtype) for shape in shapes]
    # The code takes bytes as they come: whatever JAX would still convert is converted here.
    alike = [x if x.dtype == bool else jnp.asarray(x, dtype) for x in arguments]
    return list(jax.ffi.ffi_call(name, results, vmap_method="broadcast_all")(*alike))


def native(steps: NoiseSteps, *others: Array) -> Native | None:
    """The machine code that serves these arrays in a program for a CPU, or None where there is none."""
    if os.environ.get("GRADCAL_NATIVE") == "0" or os.name != "posix":
        return None
    # What JAX makes of them: without its float64, NumPy's doubles become singles.
    kinds = {canonicalize_dtype(x.dtype).name for x in (*steps[:4], steps.initial, *others)}
    real = _REAL.get(kinds.pop()) if len(kinds) == 1 else None
    count, n = steps.observation.shape
    if real is None or not count or not n:
        return None
    with _ONE_AT_A_TIME:
        return _registered(n, real)


@functools.cache
def _registered(states: int, real: str) -> Native | None:
    made = _made(states, real)
    if made is None:
        return None
    library, key = made
    names = Native(f"gradcal_filter_{key}", f"gradcal_pull_{key}")
    for name, symbol in zip(names, ("gradcal_filter", "gradcal_pull"), strict=True):
        jax.ffi.register_ffi_target(name, jax.ffi.pycapsule(getattr(library, symbol)), platform="cpu")
    return names


@functools.cache
def _made(states: int, real: str) -> tuple[ctypes.CDLL, str] | None:
    """The compiled functions for one number of states and one precision, and what tells them from all others."""
    compiler = _compiler()
    if compiler is None:
        return None
    try:
        return _library(compiler, (f"-DSTATES={states}", f"-DREAL={real}"))
    except (OSError, subprocess.SubprocessError) as e:
        told = getattr(e, "stderr", None)
        warnings.warn(
            f"the filter could not be compiled, so JAX computes it, several times slower: {e}"
            f"{': ' + told.strip()[-500:] if told else ''} (CXX names another compiler; GRADCAL_NATIVE=0 tries none)",
            RuntimeWarning,
            stacklevel=2,
        )
        return None


def _compiler() -> list[str] | None:
    if named := os.environ.get("CXX"):
        return shlex.split(named)
    found = next(filter(None, map(shutil.which, ("c++", "g++", "clang++"))), None)
    return None if found is None else [found]


def _library(compiler: list[str], definitions: tuple[str, ...]) -> tuple[ctypes.CDLL, str]:
    """The compiled functions, from the cache folder if they are there, and what tells them from all others."""
    asked = subprocess.run([*compiler, "--version"], capture_output=True, text=True, check=True, timeout=_LONGEST_S)
    parts = (_SOURCE.read_text(), version("jaxlib"), *compiler, asked.stdout, *_OPTIONS, *definitions, _processor())
    key = hashlib.sha256("\n".join(parts).encode()).hexdigest()[:16]
    folder = cache_folder()
    if folder is None:
        with tempfile.TemporaryDirectory() as alone:
            return ctypes.CDLL(str(_compile(compiler, definitions, Path(alone) / "filter.so"))), key
    path = folder / f"filter-{key}.so"
    if path.exists():
        try:
            return ctypes.CDLL(str(path)), key
        except OSError:  # Cut short, by a full disk perhaps: made again.
            path.unlink(missing_ok=True)
    return ctypes.CDLL(str(_compile(compiler, definitions, path))), key


def _compile(compiler: list[str], definitions: tuple[str, ...], path: Path) -> Path:
    """Make `path`, at once and whole. Code for this very processor, unless the compiler does not know how."""
    with tempfile.TemporaryDirectory(dir=path.parent) as scratch:
        made = Path(scratch) / path.name
        command = [*compiler, *_OPTIONS, *definitions, f"-I{jax.ffi.include_dir()}", str(_SOURCE), "-o", str(made)]
        for tuned in (["-march=native"], []):
            done = subprocess.run([*command, *tuned], capture_output=True, text=True, check=False, timeout=_LONGEST_S)
            if done.returncode == 0:
                break
        done.check_returncode()
        made.replace(path)
    return path


def _processor() -> str:
    """What code for this very processor depends on: a home folder may be shared by unlike machines."""
    try:
        lines = Path("/proc/cpuinfo").read_text().splitlines()
    except OSError:
        lines = []
    told = next((line for line in lines if line.startswith(("flags", "Features"))), platform.processor())
    return f"{platform.system()} {platform.machine()} {told}"
