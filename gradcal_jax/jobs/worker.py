"""A worker: a process with one thread that does tasks from its standard input until that closes.

    python -m gradcal_jax.jobs.worker

Every sweep is computed in such processes, on one machine and on a cluster, so that the same task gives the same bits.
Messages are pickles: (name, arguments) in, ("done", result) or ("failed", sentence) out.
"""

import contextlib
import os
import pickle
import subprocess
import sys
import threading
from collections.abc import Mapping
from typing import Any, BinaryIO, Final

ONE_THREAD: Final[Mapping[str, str]] = {
    "JAX_PLATFORMS": "cpu",
    "JAX_ENABLE_X64": "1",
    "XLA_FLAGS": "--xla_cpu_multi_thread_eigen=false intra_op_parallelism_threads=1",
    "OMP_NUM_THREADS": "1",
    "OPENBLAS_NUM_THREADS": "1",
    "MKL_NUM_THREADS": "1",
}


class WorkerEnded(RuntimeError):
    """A worker's process ended before it answered: killed, or out of memory."""


class TaskFailed(RuntimeError):
    """A task raised an exception."""


class Worker:
    """A worker's process, started on first use. `compiled`: a folder that keeps compiled programs."""

    def __init__(self, compiled: str | None = None):
        self._environment = {**os.environ, **ONE_THREAD}
        if compiled is not None:
            self._environment |= {
                "JAX_COMPILATION_CACHE_DIR": compiled,
                "JAX_PERSISTENT_CACHE_MIN_COMPILE_TIME_SECS": "0.2",
            }
        self._process: subprocess.Popen[bytes] | None = None
        self._closed = False
        self._lock = threading.Lock()

    def ask(self, name: str, arguments: tuple[Any, ...]) -> Any:
        """Do one task and return its result. Raises `WorkerEnded`, and `TaskFailed` with what the task raised."""
        process = self._started()
        assert process.stdin is not None
        assert process.stdout is not None
        try:
            _send(process.stdin, (name, arguments))
            what, answer = pickle.load(process.stdout)
        except (OSError, EOFError, ValueError, pickle.UnpicklingError) as error:
            self._process = None
            _end(process)
            raise WorkerEnded("a worker's process ended before its work was done") from error
        if what == "failed":
            raise TaskFailed(answer)
        return answer

    def _started(self) -> "subprocess.Popen[bytes]":
        with self._lock:
            if self._closed:
                raise WorkerEnded("the worker has been closed")
            if self._process is None:
                self._process = subprocess.Popen(
                    [sys.executable, "-m", "gradcal_jax.jobs.worker"],
                    stdin=subprocess.PIPE,
                    stdout=subprocess.PIPE,
                    env=self._environment,
                    start_new_session=True,  # an interrupt at the keyboard is for the caller, not for its workers
                )
            return self._process

    def close(self) -> None:
        """Kill the process."""
        with self._lock:
            self._closed = True
            process, self._process = self._process, None
        if process is not None:
            _end(process)


def _end(process: "subprocess.Popen[bytes]") -> None:
    process.kill()
    process.wait()
    for stream in (process.stdin, process.stdout):
        if stream is not None:
            with contextlib.suppress(OSError):
                stream.close()


def _send(stream: BinaryIO | Any, message: Any) -> None:
    # Pickled first, so that an object that cannot be pickled leaves no part of a message in the stream.
    stream.write(pickle.dumps(message, protocol=pickle.HIGHEST_PROTOCOL))
    stream.flush()


def main() -> None:
    """Do tasks until standard input closes."""
    # Output of packages must not get between the replies.
    answers = os.fdopen(os.dup(1), "wb")
    os.dup2(2, 1)
    questions = sys.stdin.buffer
    from gradcal_jax.jobs.evaluate import TASKS
    from gradcal_jax.jobs.results import one_line

    while True:
        try:
            name, arguments = pickle.load(questions)
        except (EOFError, pickle.UnpicklingError):
            return
        try:
            answer = ("done", TASKS[name](*arguments))
        except Exception as error:
            answer = ("failed", one_line(error))
        try:
            _send(answers, answer)
        except OSError:
            return


if __name__ == "__main__":
    main()
