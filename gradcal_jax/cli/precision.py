"""Settings of JAX and of the process for the command line: float64, interrupts, one thread for small matrices, retained
memory, few garbage collections, and a cache of compiled programs.

The library itself never changes JAX's global switches.
"""

import ctypes
import gc
import os
import signal
import sys
import threading
from types import FrameType

_SOON_S = 0.05
# mallopt's options by <malloc.h>: M_MMAP_MAX, M_TRIM_THRESHOLD and M_TOP_PAD (bytes), M_ARENA_MAX: the heaps that other
# threads get of their own are returned to the system whatever the threshold.
_HEAP = {-4: 0, -1: 1 << 30, -2: 64 << 20, -8: 1}
# Modules and traced programs are many objects and hardly any garbage, which Python would scan a hundred times.
_COLLECT = (100_000, 50, 100)


def use_float64() -> None:
    """Switch JAX to float64 and keep compiled programs in the user's cache folder; call it before any computation."""
    # JAX factors and solves by SciPy's OpenBLAS, which starts threads even for a few columns: with some tens of
    # columns they wait for one another ten times as long as one thread takes. OpenBLAS reads this when it is loaded.
    os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")
    # Likewise XLA's threads, which share out kernels of microseconds: a search has a thread for each core of its own.
    os.environ.setdefault("XLA_FLAGS", "--xla_cpu_multi_thread_eigen=false intra_op_parallelism_threads=1")
    _keep_memory()
    import jax

    from gradcal_jax.cache import cache_folder

    _let_interrupts_through()
    jax.config.update("jax_enable_x64", True)
    folder = cache_folder()
    already = jax.config.jax_compilation_cache_dir  # pyright: ignore[reportAttributeAccessIssue]
    if folder is not None and already is None:
        jax.config.update("jax_compilation_cache_dir", str(folder))
        jax.config.update("jax_persistent_cache_min_compile_time_secs", 0.2)


def _keep_memory() -> None:
    """Collect garbage less often, and let the process retain freed memory, if its C library is GNU's.

    Arrays of some megabytes would otherwise be returned to the system after every call and cleared by it before the
    next: a third of the time of a search with thousands of readings. A process that has already imported JAX is left
    as it is.
    """
    if "jax" in sys.modules:
        return
    gc.set_threshold(*_COLLECT)
    try:
        allow = ctypes.CDLL(None).mallopt
    except (AttributeError, OSError, TypeError):
        return
    for option, value in _HEAP.items():
        allow(option, value)


def _let_interrupts_through() -> None:
    """Send a Ctrl-C again that arrives in JAX's garbage-collection callback, where exceptions are printed and lost."""
    if threading.current_thread() is not threading.main_thread():
        return
    if signal.getsignal(signal.SIGINT) is signal.default_int_handler:
        signal.signal(signal.SIGINT, _interrupt)


def _interrupt(number: int, frame: FrameType | None) -> None:
    if frame is not None and frame.f_code.co_name == "_xla_gc_callback":
        threading.Timer(_SOON_S, signal.raise_signal, (number,)).start()
    else:
        signal.default_int_handler(number, frame)
