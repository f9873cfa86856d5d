"""Runners of tasks: worker processes on this machine, and a Dask cluster."""

import os
from abc import ABC, abstractmethod
from collections import Counter, deque
from collections.abc import Callable, Iterable, Iterator
from concurrent.futures import BrokenExecutor
from contextlib import AbstractContextManager, nullcontext
from typing import Any, Final, NamedTuple, Self

from gradcal_jax.sweeps.worker import ONE_THREAD, TaskFailed, begin, do

_TRIES: Final = 3


class WorkerEnded(RuntimeError):
    """A worker's process ended before it answered: killed, or out of memory."""


class Task(NamedTuple):
    """`name` of `evaluate.TASKS` with its arguments; `key` names it in the results."""

    key: int
    name: str
    arguments: tuple[Any, ...]


class TaskRunner(ABC):
    """Does tasks, and yields (key, result), or (key, exception) for one that could not be done, in any order."""

    workers: int

    @abstractmethod
    def run(self, tasks: Iterable[Task]) -> Iterator[tuple[int, Any]]: ...

    @abstractmethod
    def close(self) -> None: ...

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: object) -> None:
        self.close()


class JobProgress(NamedTuple):
    """`done` of `total` points or cases in a `stage`: "reading", "predict", "optimise".

    `kept` of them are from an earlier run; `begun`, those done included; `newest`: a line on the last result, where
    there is one.
    """

    stage: str
    done: int
    total: int
    kept: int = 0
    newest: str = ""
    begun: int | None = None


Report = Callable[[JobProgress], None]


def unwatched(_: JobProgress) -> None:
    """Ignore the progress."""


def borrowed(runner: TaskRunner | None) -> AbstractContextManager[TaskRunner]:
    """The caller's runner or, without one, a `LocalPool` that ends with the block."""
    return LocalPool() if runner is None else nullcontext(runner)


class LocalPool(TaskRunner):
    """Worker processes on this machine (loky), by default one for each core. `compiled`: a folder that keeps compiled
    programs."""

    def __init__(self, workers: int | None = None, compiled: str | None = None):
        self.workers = workers or cores()
        self._environment = dict(ONE_THREAD)
        if compiled is not None:
            self._environment |= {
                "JAX_COMPILATION_CACHE_DIR": compiled,
                "JAX_PERSISTENT_CACHE_MIN_COMPILE_TIME_SECS": "0.2",
            }
        self._executor: Any = None

    def run(self, tasks: Iterable[Task]) -> Iterator[tuple[int, Any]]:
        from loky import wait

        source, again = iter(tasks), deque[Task]()
        flying: dict[Any, Task] = {}
        tries: Counter[int] = Counter()
        while True:
            # No more than there are workers: where one of them is killed, all that fly are lost.
            while len(flying) < self.workers and (task := again.popleft() if again else next(source, None)):
                flying[self._started().submit(do, task.name, task.arguments)] = task
            if not flying:
                return
            done = wait(flying, return_when="FIRST_COMPLETED").done
            ended = False
            for future in done:
                task, error = flying.pop(future), future.exception()
                if not isinstance(error, BrokenExecutor):
                    yield task.key, future.result() if error is None else TaskFailed(str(error))
                    continue
                ended, tries[task.key] = True, tries[task.key] + 1
                if tries[task.key] < _TRIES:
                    again.appendleft(task)
                else:
                    yield task.key, WorkerEnded("a worker process ended before its work was done")
            if ended:
                self.close()

    def _started(self) -> Any:
        """The executor; a new one after the first that a killed worker broke."""
        if self._executor is None:
            from loky import ProcessPoolExecutor

            self._executor = ProcessPoolExecutor(
                self.workers, env=self._environment, initializer=begin, initargs=(os.getpid(),)
            )
        return self._executor

    def close(self) -> None:
        """Kill the workers."""
        if self._executor is not None:
            self._executor.shutdown(wait=True, kill_workers=True)
            self._executor = None


def cores() -> int:
    """Cores that this process may use."""
    from loky import cpu_count

    return cpu_count()


class Cluster(TaskRunner):
    """A `TaskRunner` on a Dask cluster (extra `cluster`), whose workers do their tasks in their own process, whatever
    that may use; Dask repeats the chunk of a killed worker on another one. Errors: `ValueError` without the extra, or
    where no scheduler answers."""

    def __init__(self, address: str, *, timeout_s: float = 20.0):
        try:
            from distributed import Client
        except ImportError:
            raise ValueError(
                "a cluster needs Dask: install gradcal_jax[cluster] on this machine and on the cluster's workers"
            ) from None
        try:
            self._client = Client(address, timeout=timeout_s, set_as_default=False)
        except (OSError, ValueError, TimeoutError) as error:
            raise ValueError(
                f"no Dask scheduler answers at {address} ({error}); to start one, call `dask scheduler` and "
                "`dask worker ADDRESS`"
            ) from None
        self.workers = max(1, sum(w["nthreads"] for w in self._client.scheduler_info(n_workers=-1)["workers"].values()))

    def run(self, tasks: Iterable[Task]) -> Iterator[tuple[int, Any]]:
        from distributed import as_completed

        futures = {self._client.submit(do_on_cluster, task, pure=False, retries=2): task.key for task in tasks}
        with self._client.as_current():
            completed = as_completed(futures)
        for future in completed:
            error = future.exception() if future.status != "finished" else None
            yield futures[future], future.result() if error is None else error
            future.release()

    def close(self) -> None:
        self._client.close()


def do_on_cluster(task: Task) -> Any:
    """Do a task in a Dask worker."""
    import jax

    jax.config.update("jax_enable_x64", True)
    return do(task.name, task.arguments)
