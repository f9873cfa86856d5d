"""Runners of tasks: worker processes on this machine, and the interface shared with a Dask cluster."""

import os
import queue
import threading
from abc import ABC, abstractmethod
from collections.abc import Callable, Iterable, Iterator
from contextlib import AbstractContextManager, nullcontext
from typing import Any, Final, NamedTuple, Self

from gradcal_jax.jobs.worker import TaskFailed, Worker, WorkerEnded

_TRIES: Final = 3


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

    `kept` of them are from an earlier run; `newest`: a line on the last result, where there is one.
    """

    stage: str
    done: int
    total: int
    kept: int = 0
    newest: str = ""


Report = Callable[[JobProgress], None]


def unwatched(_: JobProgress) -> None:
    """Ignore the progress."""


def borrowed(runner: TaskRunner | None) -> AbstractContextManager[TaskRunner]:
    """The caller's runner or, without one, a `LocalPool` that ends with the block."""
    return LocalPool() if runner is None else nullcontext(runner)


class LocalPool(TaskRunner):
    """Worker processes on this machine, by default one for each core."""

    def __init__(self, workers: int | None = None, compiled: str | None = None):
        self.workers = workers or cores()
        self._all = [Worker(compiled) for _ in range(self.workers)]

    def run(self, tasks: Iterable[Task]) -> Iterator[tuple[int, Any]]:
        waiting: queue.SimpleQueue[Task] = queue.SimpleQueue()
        done: queue.SimpleQueue[tuple[int, Any]] = queue.SimpleQueue()
        count = 0
        for task in tasks:
            waiting.put(task)
            count += 1

        def work(worker: Worker) -> None:
            while True:
                try:
                    task = waiting.get_nowait()
                except queue.Empty:
                    return
                done.put((task.key, tried(worker, task)))

        for worker in self._all[:count]:
            threading.Thread(target=work, args=(worker,), daemon=True).start()
        for _ in range(count):
            yield done.get()

    def answers(self, name: str, arguments: Iterable[tuple[Any, ...]]) -> list[Any]:
        """The results of one kind of task in order; raises the exception of a failed task."""
        results = dict(self.run(Task(k, name, of_task) for k, of_task in enumerate(arguments)))
        if error := next((answer for answer in results.values() if isinstance(answer, Exception)), None):
            raise error
        return [results[k] for k in range(len(results))]

    def close(self) -> None:
        for worker in self._all:
            worker.close()


def tried(worker: Worker, task: Task) -> Any:
    """The task's result, or its exception; a killed worker is restarted a few times."""
    error: Exception = WorkerEnded("never tried")
    for _ in range(_TRIES):
        try:
            return worker.ask(task.name, task.arguments)
        except WorkerEnded as ended:
            error = ended
        except TaskFailed as failed:
            return failed
    return error


def cores() -> int:
    """Cores that this process may use."""
    if hasattr(os, "sched_getaffinity"):
        return max(1, len(os.sched_getaffinity(0)))
    return os.cpu_count() or 1
