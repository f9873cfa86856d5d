"""How the command line uses JAX: in float64, interruptible, without threads for small matrices or memory given back and
forth, with few collections of garbage, and without compiling tomorrow what it compiled today.

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
# Of <malloc.h>: allocations that are maps of their own, bytes that are kept at the heap's end, and bytes taken ahead.
_HEAP = {-4: 0, -1: 256 << 20, -2: 64 << 20}
# Modules and programs being traced are many objects and hardly any garbage: Python looks through them a hundred times.
_COLLECT = (100_000, 50, 100)


def use_float64() -> None:
    """Switch JAX to float64 and keep compiled programs in the user's cache folder;
    call it before anything is computed.
    """
    # JAX's factors and solves are SciPy's OpenBLAS, which sets threads to a few columns already: for some tens of them
    # they wait for one another ten times as long as one takes. It reads this as it is loaded.
    os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")
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
    _begin_compiling()


def _begin_compiling() -> None:
    """At first use the machine's compiler makes the sums meanwhile: the other rooms take as long to load."""
    from gradcal_jax.machine import begin_sums

    begin_sums()


def _keep_memory() -> None:
    """Garbage is looked for less often, and freed memory stays with the process, where the C library is GNU's.

    A program's arrays of some megabytes are otherwise given back after every call and cleared by the system before the
    next: a third of the time of a search whose readings are thousands. A process that has JAX already is not ours.
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
    """Whatever is raised in JAX's callback on garbage collection is printed and lost; Ctrl-C there is sent again."""
    if threading.current_thread() is not threading.main_thread():
        return
    if signal.getsignal(signal.SIGINT) is signal.default_int_handler:
        signal.signal(signal.SIGINT, _interrupt)


def _interrupt(number: int, frame: FrameType | None) -> None:
    if frame is not None and frame.f_code.co_name == "_xla_gc_callback":
        threading.Timer(_SOON_S, signal.raise_signal, (number,)).start()
    else:
        signal.default_int_handler(number, frame)
