"""A sweep from its file to labelled results: chunks of points, with finished chunks kept on disk.

The chunks follow from the sweep file alone, so the results do not depend on the number of workers, on their machines,
or on interruptions.
"""

import hashlib
import json
import os
import shutil
import time
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Final

import gradcal_jax
from gradcal_jax.information.verdicts import versions_of
from gradcal_jax.spec.changes import tables_of
from gradcal_jax.sweeps.points import Points
from gradcal_jax.sweeps.pool import JobProgress, Report, Task, TaskRunner, borrowed, unwatched
from gradcal_jax.sweeps.results import PointResult, results_as_json, results_from_json
from gradcal_jax.sweeps.sweep_file import Sweep
from gradcal_jax.tables.display import summary
from gradcal_jax.tables.locking import take
from gradcal_jax.tables.writing import write_whole

CHUNK: Final = {"predict": 64, "optimise": 1}
"""Points in a chunk: about a second of predictions, or a minute of optimisation."""
_VERSIONS: Final = ("jax", "jaxlib", "numpy", "scipy", "equinox", "optimistix")


@dataclass(frozen=True)
class SweepEstimate:
    """The result of `dry_run`: seconds of the first chunk, of a further one, and in all; of the first chunk's points
    `failing` have no result."""

    points: int
    failing: int
    chunks: int
    workers: int
    first_chunk_s: float
    next_chunk_s: float
    seconds: float
    first_failure: str = ""


@dataclass(frozen=True)
class Swept:
    """All results, in the order of the points; `failed` of them have no numbers; `seconds`: duration of this call."""

    results: tuple[PointResult, ...]
    seconds: float
    kept: int

    __repr__ = summary

    @property
    def failed(self) -> int:
        """The number of points without a result; each has the reason."""
        return sum(bool(result.failure) for result in self.results)


class SweepIncomplete(RuntimeError):
    """Workers were lost repeatedly before all was done; finished chunks are kept."""


class Store:
    """Finished chunks in a folder beside the output, from which an interrupted sweep resumes.

    The folder is locked as long as this object or its process lives. Errors: `ValueError` where it holds another
    sweep's parts, or another process writes into it.
    """

    _lock: int | None = None

    def __init__(self, output: Path, identity: dict[str, Any]):
        self.folder = output.with_name(output.name + ".parts")
        mark = self.folder / "sweep.json"
        if mark.is_file():
            try:
                there = json.loads(mark.read_text(encoding="utf-8"))
            except ValueError:
                there = {}
            if there != identity:
                changed = ", ".join(k for k in {**there, **identity} if there.get(k) != identity.get(k))
                raise ValueError(
                    f"the folder {self.folder} has parts of another sweep (which differs in {changed}); delete it "
                    "to start again, or choose another output"
                )
        elif self.folder.exists() and any(self.folder.iterdir()):
            raise ValueError(
                f"the folder {self.folder} exists and was not made by a sweep; move it away, or choose another output"
            )
        else:
            self.folder.mkdir(parents=True, exist_ok=True)
            write_whole(mark, json.dumps(identity, indent=1))
        self._lock = os.open(self.folder / "sweep.lock", os.O_RDWR | os.O_CREAT, 0o666)
        try:
            take(self._lock)
        except OSError:
            self._unlock()
            raise ValueError(
                f"another sweep is writing into {self.folder}: wait until it ends, or choose another output"
            ) from None

    def read(self, chunk: int) -> list[PointResult] | None:
        """A finished chunk; None where it is absent or damaged."""
        path = self._path(chunk)
        try:
            digest, _, body = path.read_text(encoding="utf-8").partition("\n")
            return results_from_json(body) if digest == hashlib.sha256(body.encode()).hexdigest() else None
        except (OSError, ValueError, TypeError):
            return None

    def write(self, chunk: int, results: list[PointResult]) -> None:
        """Write a finished chunk, atomically."""
        body = results_as_json(results)
        write_whole(self._path(chunk), f"{hashlib.sha256(body.encode()).hexdigest()}\n{body}")

    def remove(self) -> None:
        """Delete the folder, once its contents are in the output."""
        self._unlock()
        shutil.rmtree(self.folder, ignore_errors=True)

    def _unlock(self) -> None:
        lock, self._lock = self._lock, None
        if lock is not None:
            os.close(lock)

    def __del__(self) -> None:
        self._unlock()

    def _path(self, chunk: int) -> Path:
        return self.folder / f"chunk-{chunk:06d}.json"


def sweep(job: Sweep, output: str | Path, *, runner: TaskRunner | None = None, progress: Report = unwatched) -> Swept:
    """Do a sweep and write its results (netCDF, each variable with its unit) to `output`, for `read_dataset`.

    A call after an interruption resumes where it stopped.

    `runner`: a `LocalPool`, by default one worker a core, or a `cluster.Cluster`. Errors: `ValueError` where `output`
    exists already, where every point fails, and for the folder of another sweep; `SweepIncomplete` where
    workers are lost.
    """
    from gradcal_jax.sweeps.dataset import dataset_of
    from gradcal_jax.tables.netcdf import save_netcdf

    begun, output = time.monotonic(), Path(output)
    identity = identity_of(job)
    if already_finished(job, output):
        raise ValueError(f"{output} already has the results of this sweep; nothing remains to do")
    if output.exists():
        raise ValueError(f"{output} exists and belongs to another sweep; choose another output, or delete it")
    if not output.parent.is_dir():
        raise ValueError(f"the directory {output.parent} does not exist; make it first")
    points = Points(job)
    with borrowed(runner) as workers:
        chunks = chunks_of(len(points), CHUNK[job.file.do])
        store = Store(output, identity)
        results: dict[int, PointResult] = {}
        left: list[int] = []
        for number, chunk in enumerate(chunks):
            there = store.read(number)
            if there is None or [r.point for r in there] != list(chunk):
                left.append(number)
            else:
                results |= {r.point: r for r in there}
        kept = len(results)
        base = tables_of(job.base)
        begun_points = kept

        def tasks() -> Iterator[Task]:
            nonlocal begun_points
            for n in left:
                begun_points += len(chunks[n])
                progress(JobProgress(job.file.do, len(results), len(points), kept, begun=begun_points))
                yield Task(n, job.file.do, (base, [(i, points.changes(i)) for i in chunks[n]]))

        lost, reason = 0, ""
        for number, answer in workers.run(tasks()):
            if isinstance(answer, Exception):
                lost, reason = lost + len(chunks[number]), str(answer)
                continue
            store.write(number, answer)
            results |= {r.point: r for r in answer}
            progress(JobProgress(job.file.do, len(results), len(points), kept, begun=begun_points))
    if lost:
        raise SweepIncomplete(
            f"{lost} of {len(points)} points could not be computed ({reason}); the others are saved in "
            f"{store.folder}; call the same command again to compute the rest"
        )
    ordered = tuple(results[index] for index in range(len(points)))
    if all(result.failure for result in ordered):
        store.remove()
        raise ValueError(
            f"none of the {len(points)} points has a result; the reason at the first point: {ordered[0].failure}"
        )
    save_netcdf(dataset_of(job, points, ordered, identity), output)
    store.remove()
    return Swept(ordered, time.monotonic() - begun, kept)


def already_finished(job: Sweep, output: Path) -> bool:
    """Whether `output` holds all results of just this sweep."""
    from gradcal_jax.sweeps.dataset import identity_in

    return output.is_file() and identity_in(output) == identity_of(job)


def dry_run(job: Sweep, *, runner: TaskRunner | None = None, progress: Report = unwatched) -> SweepEstimate:
    """The size of a sweep and its expected duration, by computing the first chunk twice. Nothing is written."""
    points = Points(job)
    chunks = chunks_of(len(points), CHUNK[job.file.do])
    share = (tables_of(job.base), [(i, points.changes(i)) for i in chunks[0]])
    times, results = [0.0, 0.0], []
    with borrowed(runner) as workers:
        progress(JobProgress(job.file.do, 0, len(points)))
        for k in range(1 if job.file.do == "optimise" else 2):
            begun = time.monotonic()
            ((_, results),) = workers.run([Task(0, job.file.do, share)])
            if isinstance(results, Exception):
                raise ValueError(f"the first chunk of points cannot be computed: {results}")
            times[k:] = [time.monotonic() - begun] * (2 - k)
    failing = [result.failure for result in results if result.failure]
    rounds = -(-len(chunks) // workers.workers)
    sizes, seconds = (len(points), len(failing), len(chunks), workers.workers), times[0] + times[1] * (rounds - 1)
    return SweepEstimate(*sizes, times[0], times[1], seconds, failing[0] if failing else "")


def chunks_of(count: int, size: int) -> list[range]:
    """The numbers of the points, cut into chunks."""
    return [range(begin, min(begin + size, count)) for begin in range(0, count, size)]


def identity_of(job: Sweep) -> dict[str, Any]:
    """The identity of a sweep: its request, and the versions that compute it."""
    others = [[*key, tables] for key, tables in sorted(job.sections.items())]
    request = json.dumps([tables_of(job.file), tables_of(job.base), *others], sort_keys=True, ensure_ascii=False)
    return {
        "asked": hashlib.sha256(request.encode()).hexdigest(),
        "points": job.file.count,
        "chunk": CHUNK[job.file.do],
        **versions(),
    }


def versions() -> dict[str, str]:
    """Versions of this and the packages that compute the numbers."""
    return {"gradcal_jax": gradcal_jax.__version__, **versions_of(_VERSIONS)}
