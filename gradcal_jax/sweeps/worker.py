"""What a worker's process does: one task after the other, with one thread, until its parent ends."""

import os
import signal
import sys
import threading
import time
from collections.abc import Mapping
from typing import Any, Final

ONE_THREAD: Final[Mapping[str, str]] = {
    "JAX_PLATFORMS": "cpu",
    "JAX_ENABLE_X64": "1",
    "XLA_FLAGS": "--xla_cpu_multi_thread_eigen=false intra_op_parallelism_threads=1",
    "OMP_NUM_THREADS": "1",
    "OPENBLAS_NUM_THREADS": "1",
    "MKL_NUM_THREADS": "1",
    # Compiled programs and plans of other sizes are no leak for which a worker would begin anew.
    "LOKY_MAX_MEMORY_LEAK_SIZE": "4e9",
}
"""Environment of every worker, so that the same task gives the same bits."""


class TaskFailed(RuntimeError):
    """A task raised an exception; its sentence."""


def begin(parent: int) -> None:
    """The first thing in a worker: `parent` is the process that it works for."""
    # An interrupt at the keyboard is for the parent, and what packages print must not get into its JSON.
    signal.signal(signal.SIGINT, signal.SIG_IGN)
    os.dup2(2, 1)

    def end_with_parent() -> None:
        while os.getppid() == parent:
            time.sleep(1.0)
        os._exit(1)

    if sys.platform != "win32":
        threading.Thread(target=end_with_parent, daemon=True).start()


def do(name: str, arguments: tuple[Any, ...]) -> Any:
    """A task of `evaluate.TASKS`: its result, or `TaskFailed`, which always passes to another process."""
    from gradcal_jax.sweeps.evaluate import TASKS
    from gradcal_jax.sweeps.results import one_line

    try:
        return TASKS[name](*arguments)
    except Exception as error:
        return TaskFailed(one_line(error))
