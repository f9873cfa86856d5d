"""A sweep: the plan of a spec predicted (or optimised) at many points, in parallel, as labelled arrays with units.

A point is one task, one record, and one line of the file `OUTPUT.parts`, from which an interrupted sweep resumes. The
records follow from the sweep file alone, so they depend neither on the workers nor on interruptions.
"""

import hashlib
import itertools
import json
import os
import re
import signal
import threading
import time
from collections import deque
from collections.abc import Callable, Iterator, Mapping
from concurrent.futures import FIRST_COMPLETED, BrokenExecutor, Executor, wait
from contextlib import contextmanager
from functools import lru_cache
from pathlib import Path
from typing import Any, Final

import numpy as np
import xarray

import gradcal_jax
from gradcal_jax.cache import cache_folder
from gradcal_jax.information import STATISTICS
from gradcal_jax.information.prediction import requirement_rows
from gradcal_jax.information.verdicts import versions_of
from gradcal_jax.spec.changes import changed, tables_of
from gradcal_jax.spec.requirement import QUANTITIES
from gradcal_jax.spec.spec import spec_of
from gradcal_jax.sweeps.sweep_file import Sweep, SweptAxis
from gradcal_jax.tables.locking import take
from gradcal_jax.tables.netcdf import NetcdfError, load_netcdf, save_netcdf
from gradcal_jax.tables.writing import to_toml

FORMAT: Final = "gradcal-sweep-results/1"
Record = dict[str, Any]
Executors = Callable[[], Executor]
"""Gives the executor of the tasks; a new one after a worker was killed."""
# What a record has beside the requirements, with its unit: the last three of optimised plans.
_VARIABLES: Final = {
    "duration": ("s", "the whole plan"),
    "soak": ("s", "the part of the plan at constant temperature"),
    "motion": ("s", "the part of the plan in which the temperature changes"),
    "failure": ("", "reason why the point has no result; empty if it has a result"),
    "convergence": ("", "report of the optimiser"),
    "optimised_spec": ("", "gradcal-spec/1 with the optimised plan"),
    "objective_before": ("", "the objective of the plan in the spec before optimisation, in its unit"),
}
_VERSIONS: Final = ("jax", "jaxlib", "numpy", "scipy", "equinox")
_TRIES: Final = 3
# Of a worker, which has one thread.
_ENVIRONMENT: Final = {
    "OMP_NUM_THREADS": "1",
    "OPENBLAS_NUM_THREADS": "1",
    "JAX_PLATFORMS": "cpu",
    "XLA_FLAGS": "--xla_cpu_multi_thread_eigen=false intra_op_parallelism_threads=1",
    "JAX_PERSISTENT_CACHE_MIN_COMPILE_TIME_SECS": "0.2",
    "LOKY_MAX_MEMORY_LEAK_SIZE": "4e9",
}


class SweepIncomplete(RuntimeError):
    """Workers were lost repeatedly before all was done; finished points are kept."""


# --- points -----------------------------------------------------------------------------------------------------------


def changes_of(job: Sweep) -> list[dict[str, object]]:
    """The changes of the base at each point, of which the last axis is fastest: whole sections of other specs first,
    then single keys."""
    points = list[dict[str, object]]()
    for values in itertools.product(*(axis.listed() for axis in job.file.axis)):
        of_axes = sorted(zip(job.file.axis, values, strict=True), key=lambda one: one[0].section is None)
        points.append(
            {
                key: value if axis.section is None else job.sections[axis.section, str(value)]
                for axis, value in of_axes
                for key in axis.changes
            }
        )
    return points


# --- one point, in a worker -------------------------------------------------------------------------------------------


def evaluate(do: str, base: str, changes: Mapping[str, object]) -> Record:
    """The record of a point. A point that fails has the reason in it, and nothing else."""
    import jax

    jax.config.update("jax_enable_x64", True)
    try:
        spec = changed(_base(base), changes)
        record = Record(failure="")
        if do == "optimise":
            from gradcal_jax.design.optimise import optimise

            best = optimise(spec)
            spec = best.spec
            record |= {"convergence": best.sentence, "optimised_spec": to_toml(spec), "objective_before": best.before}
        record |= {name: getattr(spec.schedule, name) for name in ("duration", "soak", "motion")}
        for k, row in enumerate(requirement_rows(spec)):
            record |= {f"{k} {name}": getattr(row, name.replace(" ", "_")) for name in STATISTICS}
            record |= {f"{k} residual": row.judged, f"{k} verdict": row.verdict or ""}
        return record
    except Exception as error:
        text = " ".join(str(error).split()) or type(error).__name__
        return {"failure": text if isinstance(error, ValueError | OSError) else f"{type(error).__name__}: {text}"}


@lru_cache(maxsize=2)
def _base(text: str) -> Any:
    return spec_of(json.loads(text))


def _begin(parent: int) -> None:
    """In a worker: a Ctrl-C is for its parent, printed text must not get into the parent's, and it ends with it."""
    signal.signal(signal.SIGINT, signal.SIG_IGN)
    os.dup2(2, 1)

    def end_with_parent() -> None:
        while os.getppid() == parent:
            time.sleep(1.0)
        os._exit(1)

    threading.Thread(target=end_with_parent, daemon=True).start()


@contextmanager
def local_workers(count: int | None = None) -> Iterator[Executors]:
    """Processes of this machine, by default one for each core."""
    import loky

    environment = dict(_ENVIRONMENT)
    if (compiled := cache_folder()) is not None:
        environment["JAX_COMPILATION_CACHE_DIR"] = str(compiled)

    def start() -> Any:  # loky is without types
        reusable: Any = loky.get_reusable_executor
        return reusable(
            count or loky.cpu_count(), timeout=None, env=environment, initializer=_begin, initargs=(os.getpid(),)
        )

    try:
        yield start
    finally:
        start().shutdown(kill_workers=True)


def completed(workers: Executors, tasks: Mapping[int, tuple[Any, ...]], most: int) -> Iterator[tuple[int, Record]]:
    """The records of `tasks` as they are done, at most `most` at a time. The work of a killed worker is repeated; what
    kills several workers is left out."""
    waiting, tries, flying = deque(tasks), dict.fromkeys(tasks, 0), dict[Any, int]()
    while waiting or flying:
        while waiting and len(flying) < most:
            key = waiting.popleft()
            flying[workers().submit(evaluate, *tasks[key])] = key
        for future in wait(flying, return_when=FIRST_COMPLETED).done:
            key = flying.pop(future)
            if (fault := future.exception()) is None:
                yield key, future.result()
                continue
            if not isinstance(fault, BrokenExecutor):
                raise fault  # of this program: `evaluate` returns the faults of points
            tries[key] += 1
            if tries[key] < _TRIES:
                waiting.appendleft(key)


# --- what is kept -----------------------------------------------------------------------------------------------------


def identity_of(job: Sweep) -> dict[str, Any]:
    """What decides the results of a sweep: its request, and the versions that compute it."""
    request = [tables_of(job.file), tables_of(job.base)]
    request += [[*key, tables] for key, tables in sorted(job.sections.items())]
    text = json.dumps(request, sort_keys=True, ensure_ascii=False)
    return {
        "asked": hashlib.sha256(text.encode()).hexdigest(),
        "points": job.file.count,
        "gradcal_jax": gradcal_jax.__version__,
        **versions_of(_VERSIONS),
    }


@contextmanager
def kept_records(path: Path, identity: Mapping[str, Any]) -> Iterator[tuple[dict[int, Record], Callable[..., None]]]:
    """The records in a file of finished points, and how to add one. The file is locked, and removed where the block
    ends without an exception. Errors: `ValueError` for the file of another sweep, or one in use."""
    with path.open("a+", encoding="utf-8") as file:
        try:
            take(file.fileno())
        except OSError:
            raise ValueError(f"another sweep is writing into {path}: wait, or choose another output") from None
        file.seek(0)
        lines = file.read().split("\n")
        if lines == [""]:
            file.write(json.dumps(identity) + "\n")
        elif lines[0] != json.dumps(identity):
            raise ValueError(f"{path} has points of another sweep: delete it, or choose another output")
        elif lines[-1]:
            file.write("\n")  # a line that was torn by a kill is closed, and not read
        # Only a whole line ends in a line break.
        records = dict(json.loads(line) for line in lines[1:-1] if line.endswith("}]"))

        def add(key: int, record: Record) -> None:
            file.write(json.dumps([key, record], allow_nan=False) + "\n")
            file.flush()

        yield records, add
    path.unlink()


# --- the sweep --------------------------------------------------------------------------------------------------------


def sweep(
    job: Sweep,
    output: str | Path,
    *,
    workers: Executors | None = None,
    most: int | None = None,
    progress: Callable[[int, int], None] = lambda done, total: None,
) -> xarray.Dataset:
    """Do a sweep and write its results (netCDF, each variable with its unit) to `output`; a call after an interruption
    resumes where it stopped. `workers`: gives an executor, such as that of a Dask client, by default processes of this
    machine; `most`: how many points are waiting at a time. Errors: `ValueError` where `output` exists, or every point
    fails; `SweepIncomplete`."""
    output = Path(output)
    if output.exists():
        raise ValueError(f"{output} exists; choose another output, or delete it")
    if not output.absolute().parent.is_dir():
        raise ValueError(f"there is no directory {output.parent}; make it first")
    if workers is None:
        with local_workers() as own:
            return sweep(job, output, workers=own, most=most, progress=progress)
    points, base = changes_of(job), json.dumps(tables_of(job.base))
    with kept_records(output.with_name(f"{output.name}.parts"), identity_of(job)) as (records, add):
        left = {i: (job.file.do, base, changes) for i, changes in enumerate(points) if i not in records}
        progress(len(records), len(points))
        for key, record in completed(workers, left, most or 2 * (os.cpu_count() or 1)):
            add(key, record)
            records[key] = record
            progress(len(records), len(points))
        if lost := len(points) - len(records):
            raise SweepIncomplete(f"{lost} of {len(points)} points could not be computed; call again for the rest")
        ordered = [records[i] for i in range(len(points))]
        if all(record["failure"] for record in ordered):
            raise ValueError(f"none of the {len(points)} points has a result; the first: {ordered[0]['failure']}")
        results = dataset_of(job, ordered)
        save_netcdf(results, output)
    return results


def variable_name(text: str) -> str:
    """A name that programs can use: letters, digits and underscores."""
    plain = re.sub(r"\W+", "_", text).strip("_")
    return plain if plain.isidentifier() else f"v_{plain}"


def dimension_of(axis: SweptAxis) -> str:
    """The name of an axis of the results; the whole key where a variable has the name, as for "plan.soak"."""
    name = variable_name(axis.label)
    return variable_name(axis.changes[0]) if name in _VARIABLES else name


def dataset_of(job: Sweep, records: list[Record]) -> xarray.Dataset:
    """The results over the axes. Requirements give `<name>_residual`, as `gradcal predict` prints it, by the terms of
    the file alone `<name>_<statistic>` (1σ; NaN: no result, or not observable), and `<name>_verdict`; `failure` says
    why a point has no result."""
    dims = tuple(dimension_of(axis) for axis in job.file.axis)
    shape = [len(axis.listed()) for axis in job.file.axis]
    coordinates, variables = dict[str, Any](), dict[str, Any]()
    for axis, name in zip(job.file.axis, dims, strict=True):
        numbers = [axis.number_of(value) for value in axis.listed()]
        attributes = {"long_name": axis.label, "keys": ", ".join(axis.changes), "spacing": axis.spacing}
        if None in numbers:
            column = np.array([str(value) for value in axis.listed()], dtype=object)
        else:
            column = np.array(numbers, dtype=float)
            attributes["units"] = axis.unit or "1"
        coordinates[name] = ((name,), column, attributes)

    def add(name: str, key: str, words: str, **attributes: str) -> None:
        column = [record.get(key) for record in records]
        text = any(isinstance(value, str) for value in column)
        values = np.array([v or "" for v in column] if text else column, dtype=object if text else float)
        variables[name] = (dims, values.reshape(shape), {"long_name": words} | attributes)

    for k, requirement in enumerate(job.base.requirement):
        name, quantity = variable_name(requirement.name), requirement.quantity
        name = f"{name}_{k}" if f"{name}_verdict" in variables else name
        same = {"units": QUANTITIES[quantity].unit, "requirement": requirement.name, "verdict": f"{name}_verdict"}
        what = f"{requirement.name}: residual {quantity.replace('_', ' ')}, 1 sigma"
        judged = same | {"statistic": requirement.statistic, "decisive": "yes"}
        add(f"{name}_residual", f"{k} residual", f"{what}, as the verdict counts it", **judged)
        for statistic in STATISTICS:
            if statistic != "mean of max" or quantity == "gyro_scale_factor":
                words = f"{what}, {statistic}, by the terms of the file alone"
                add(f"{name}_{variable_name(statistic)}", f"{k} {statistic}", words, **same, statistic=statistic)
        add(f"{name}_verdict", f"{k} verdict", f"{requirement.name}: verdict, if there is a target")
    for key, (unit, what) in _VARIABLES.items():
        if any(key in record for record in records):
            add(key, key, what, **({"units": unit} if unit else {}))
    failed = sum(bool(record["failure"]) for record in records)
    attributes = {
        "format": FORMAT,
        "title": job.file.title or "",
        "status": f"complete: {len(records)} points, {failed} of them failed",
        "sweep": job.text,
        "base": to_toml(job.base),
        "identity": json.dumps(identity_of(job)),
        "note": "residuals are predictions by the model of the base spec, as one standard deviation",
    }
    return xarray.Dataset(variables, coordinates, attributes)


def read_dataset(path: str | Path) -> xarray.Dataset:
    """The results of a sweep from its file at `path`, each variable with its unit.

    Errors: `ValueError` for another kind of file.
    """
    try:
        results = load_netcdf(path)
    except NetcdfError as error:
        raise ValueError(f"{path} is not a result file of a sweep: {error}") from None
    if results.attrs.get("format") != FORMAT:
        raise ValueError(f"{path} was not written by gradcal sweep, so it is not a result file")
    return results
