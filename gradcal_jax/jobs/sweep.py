"""A sweep from its file to labelled results: survey, groups, chunks, and what is kept on the way.

What belongs to one chunk, and the room that its plans are computed in, follow from the sweep file alone. Workers only
decide when a chunk is done and by whom, so the results do not depend on how many there are, on where they are, or on
how often the sweep was killed and begun again.
"""

import hashlib
import json
import time
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Final, NamedTuple

import gradcal_jax
from gradcal_jax.assemble.versions import versions_of
from gradcal_jax.files import tables_of
from gradcal_jax.files.sweep import Sweep, tables_of_sweep
from gradcal_jax.jobs.points import Points
from gradcal_jax.jobs.pool import LocalPool, Runner, Task
from gradcal_jax.jobs.progress import Progress, Report, unwatched
from gradcal_jax.jobs.results import Result
from gradcal_jax.jobs.room import OWN_SHAPE, Counts, Surveyed, room_for
from gradcal_jax.jobs.store import Store

CHUNK: Final = {"predict": 64, "optimise": 1}
"""Points in a chunk: a second's work, or a minute's."""
_SURVEY_CHUNK: Final = 250
_VERSIONS: Final = ("jax", "jaxlib", "numpy", "scipy", "equinox", "optimistix")


class Chunk(NamedTuple):
    """Points that are computed together, and the room of each of their channels."""

    points: tuple[int, ...]
    rooms: tuple[Counts, ...]


@dataclass(frozen=True)
class Estimate:
    """What `dry_run` found: seconds of one chunk the first time and once compiled, programs to compile, all in all."""

    points: int
    failing: int
    chunks: int
    programs: int
    workers: int
    first_chunk_s: float
    next_chunk_s: float
    seconds: float
    first_failure: str = ""


@dataclass(frozen=True)
class Swept:
    """All results, in the order of the points; `failed` of them have no numbers, `seconds` the time it took now."""

    results: tuple[Result, ...]
    seconds: float
    kept: int

    @property
    def failed(self) -> int:
        """Points that could not be computed; each says why."""
        return sum(bool(result.failure) for result in self.results)


class SweepIncomplete(RuntimeError):
    """Workers were lost, again and again, before all was done; what is finished is kept."""


def sweep(
    job: Sweep,
    output: str | Path,
    *,
    runner: Runner | None = None,
    progress: Report = unwatched,
) -> Swept:
    """Do a sweep and write its results (netCDF, each variable with its unit) to `output`, for `read_dataset`.

    Begun again after a kill it goes on where it was.

    `runner`: a `LocalPool`, by default one worker a core, or a `cluster.Cluster`. Errors: `ValueError` where `output`
    exists already, where every point fails, and for the folder of another sweep; `SweepIncomplete` where
    workers are lost.
    """
    from gradcal_jax.jobs.dataset import dataset_of, write_dataset

    begun, output = time.monotonic(), Path(output)
    identity = identity_of(job)
    if finished(job, output):
        raise ValueError(f"{output} holds the finished results of just this sweep; nothing is left to do")
    if output.exists():
        raise ValueError(f"{output} exists and is not of this sweep; choose another output, or delete it")
    if not output.parent.is_dir():
        raise ValueError(f"there is no directory {output.parent}; make it first")
    points = Points(job)
    own = runner is None
    runner = runner or LocalPool()
    try:
        surveyed = survey(job, points, runner, progress)
        chunks = chunks_of(surveyed, CHUNK[job.file.do])
        store = Store(output, identity)
        results: dict[int, Result] = {
            index: Result(index, found.failure) for index, found in enumerate(surveyed) if found.failure
        }
        left: list[int] = []
        for number, chunk in enumerate(chunks):
            there = store.read(number)
            if there is None or [r.point for r in there] != list(chunk.points):
                left.append(number)
            else:
                results |= {r.point: r for r in there}
        kept = len(results)
        base = tables_of(job.base)
        progress(Progress(job.file.do, len(results), len(points), kept))
        tasks = [
            Task(n, job.file.do, (base, [(i, points.changes(i)) for i in chunks[n].points], chunks[n].rooms))
            for n in _each_group_first(chunks, left)
        ]
        lost, reason = 0, ""
        for number, found in runner.run(tasks):
            if isinstance(found, Exception):
                lost, reason = lost + len(chunks[number].points), str(found)
                continue
            store.write(number, found)
            results |= {r.point: r for r in found}
            progress(Progress(job.file.do, len(results), len(points), kept))
    finally:
        if own:
            runner.close()
    if lost:
        raise SweepIncomplete(
            f"{lost} of {len(points)} points could not be computed ({reason}); the others are kept in {store.folder}, "
            "and the same command goes on from there"
        )
    ordered = tuple(results[index] for index in range(len(points)))
    write_dataset(dataset_of(job, points, ordered, identity), output)
    store.remove()
    return Swept(ordered, time.monotonic() - begun, kept)


def finished(job: Sweep, output: Path) -> bool:
    """Whether `output` holds all results of just this sweep."""
    from gradcal_jax.jobs.dataset import identity_in

    return output.is_file() and identity_in(output) == identity_of(job)


def dry_run(job: Sweep, *, runner: Runner | None = None, progress: Report = unwatched) -> Estimate:
    """How large a sweep is and how long it will take, by its largest group's first chunk, done twice. Nothing is
    written.
    """
    points = Points(job)
    own = runner is None
    runner = runner or LocalPool()
    try:
        begun = time.monotonic()
        surveyed = survey(job, points, runner, progress)
        reading = time.monotonic() - begun
        chunks = chunks_of(surveyed, CHUNK[job.file.do])
        times = [0.0, 0.0]
        if chunks:
            largest = max(chunks, key=lambda chunk: sum(sum(map(sum, room)) for room in chunk.rooms))
            if job.file.do == "optimise":
                largest = chunks[0]
            base = tables_of(job.base)
            share = (base, [(i, points.changes(i)) for i in largest.points], largest.rooms)
            progress(Progress(job.file.do, 0, len(points)))
            for k in range(1 if job.file.do == "optimise" else 2):
                begun = time.monotonic()
                ((_, found),) = runner.run([Task(0, job.file.do, share)])
                if isinstance(found, Exception):
                    raise ValueError(f"the first chunk cannot be done: {found}")
                times[k:] = [time.monotonic() - begun] * (2 - k)
    finally:
        if own:
            runner.close()
    programs = len({chunk.rooms for chunk in chunks})
    compiling = max(times[0] - times[1], 0.0) * -(-programs // runner.workers)
    failing = [found.failure for found in surveyed if found.failure]
    return Estimate(
        len(points), len(failing), len(chunks), programs, runner.workers, times[0], times[1],
        reading + compiling + times[1] * -(-len(chunks) // runner.workers), failing[0] if failing else "",
    )  # fmt: skip


def _each_group_first(chunks: list[Chunk], left: list[int]) -> list[int]:
    """Every group's first chunk, then every group's second, …: workers compile different programs, not the same one."""
    ranks: dict[tuple[Counts, ...], int] = {}
    order: list[tuple[int, int]] = []
    for number in left:
        rooms = chunks[number].rooms
        ranks[rooms] = ranks.get(rooms, 0) + 1
        order.append((ranks[rooms], number))
    return [number for _, number in sorted(order)]


def survey(job: Sweep, points: Points, runner: Runner, progress: Report = unwatched) -> list[Surveyed]:
    """Every point, read. Errors: `ValueError` where not one of them is a spec."""
    count = len(points)
    base = tables_of(job.base)
    parts = [range(begin, min(begin + _SURVEY_CHUNK, count)) for begin in range(0, count, _SURVEY_CHUNK)]
    tasks = [Task(k, "survey", (base, [points.changes(i) for i in part])) for k, part in enumerate(parts)]
    found: dict[int, Any] = {}
    done = 0
    progress(Progress("reading", 0, count))
    for key, answer in runner.run(tasks):
        if isinstance(answer, Exception):
            raise RuntimeError(f"the points could not be read: {answer}")
        found[key] = answer
        done += len(answer)
        progress(Progress("reading", done, count))
    surveyed = [one for key in range(len(parts)) for one in found[key]]
    if all(one.failure for one in surveyed):
        raise ValueError(f"not one of the {count} points is a spec; the first says: {surveyed[0].failure}")
    return surveyed


def chunks_of(surveyed: list[Surveyed], size: int) -> list[Chunk]:
    """Points by groups, in the order in which the groups appear, cut into chunks; and each group's room."""
    groups: dict[str, list[int]] = {}
    for index, found in enumerate(surveyed):
        if not found.failure:
            groups.setdefault(found.group, []).append(index)
    chunks: list[Chunk] = []
    for group, members in groups.items():
        rooms: tuple[Counts, ...] = ()
        if group != OWN_SHAPE:
            by_channel = zip(*(surveyed[index].counts for index in members), strict=True)
            rooms = tuple(room_for(list(dict.fromkeys(counts))) for counts in by_channel)
        chunks += [Chunk(tuple(members[begin : begin + size]), rooms) for begin in range(0, len(members), size)]
    return chunks


def identity_of(job: Sweep) -> dict[str, Any]:
    """What makes two sweeps the same: what is asked, and what computes it."""
    asked = json.dumps([tables_of_sweep(job.file), tables_of(job.base)], sort_keys=True, ensure_ascii=False)
    return {
        "asked": hashlib.sha256(asked.encode()).hexdigest(),
        "points": job.file.count,
        "chunk": CHUNK[job.file.do],
        **versions(),
    }


def versions() -> dict[str, str]:
    """Versions of what the numbers come from."""
    return {"gradcal_jax": gradcal_jax.__version__, **versions_of(_VERSIONS)}


__all__ = [
    "CHUNK",
    "Chunk",
    "Estimate",
    "SweepIncomplete",
    "Swept",
    "chunks_of",
    "dry_run",
    "finished",
    "identity_of",
    "survey",
    "sweep",
]
