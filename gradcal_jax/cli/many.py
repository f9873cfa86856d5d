"""`gradcal sweep`: many plans, on the cores of this machine or of a cluster."""

from collections import Counter
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any, Final

from cyclopts import Parameter

from gradcal_jax.cli.output import (
    DONE,
    FAILED,
    INTERRUPTED,
    NOT_AS_WISHED,
    Flag,
    Json,
    OptionalOutput,
    Plot,
    as_json,
    complain,
    drawable,
    save_figure,
    strong,
    writable,
)
from gradcal_jax.cli.precision import use_float64
from gradcal_jax.cli.progress import Bars
from gradcal_jax.tables.display import amount, columns
from gradcal_jax.units import count_text, time_text

if TYPE_CHECKING:
    import xarray

    from gradcal_jax.sweeps.pool import Cluster, LocalPool
    from gradcal_jax.sweeps.sweep import SweepEstimate
    from gradcal_jax.sweeps.sweep_file import Sweep

_VERDICTS = ("met", "missed", "unobservable")


@Parameter(name="*")
@dataclass(frozen=True)
class Workers:
    """The worker processes of a command.

    Parameters
    ----------
    scheduler
        Address of a Dask scheduler, such as tcp://host:8786; by default the cores of this computer are used.
    workers
        Number of worker processes on this computer; by default the number of its cores.
    """

    scheduler: str | None = None
    workers: int | None = None

    def check(self) -> None:
        """Raise `ValueError` for options that exclude each other."""
        if self.workers is not None and not 1 <= self.workers <= 1024:
            raise ValueError(f"--workers {self.workers}: must be from 1 to 1024")
        if self.workers is not None and self.scheduler is not None:
            raise ValueError("--workers cannot be used with --scheduler: the cluster sets the number of workers")

    def runner(self) -> "LocalPool | Cluster":
        """Worker processes of this machine, with the compilation cache of the other commands, or of a cluster."""
        if self.scheduler is not None:
            from gradcal_jax.sweeps.pool import Cluster

            return Cluster(self.scheduler)
        from gradcal_jax.cache import cache_folder
        from gradcal_jax.sweeps.pool import LocalPool

        folder = cache_folder()
        return LocalPool(self.workers, None if folder is None else str(folder))


THIS_MACHINE: Final = Workers()


def sweep(
    file: Path,
    /,
    *,
    output: OptionalOutput = None,
    recipes: Path | None = None,
    dry_run: Flag = False,
    by: Workers = THIS_MACHINE,
    json: Json = False,
    plot: Plot = None,
) -> int:
    """Predict (or optimise) the plan of a spec for many values of its keys, and write all results to a netCDF file.

    The results have labels and units. Finished points are saved next to the output file; if the sweep is interrupted,
    the same command continues it. The exit status is 1 if some points could not be computed; the results state the
    reasons.

    Parameters
    ----------
    file
        The sweep file (gradcal-sweep/1): a base spec, and values for its keys.
    output
        The results to write (.nc).
    recipes
        Write summary.csv, summary.md and a recipe for each optimised plan to this folder (created if necessary).
    dry_run
        Compute one chunk, print the size and the expected duration of the sweep, and write nothing.
    json
        Print the summary as JSON.
    plot
        Draw the results into this file (.png, .svg, .pdf).
    """
    from gradcal_jax.sweeps.sweep_file import read_sweep

    if output is None and not dry_run:
        raise ValueError("name the file for the results, such as -o results.nc, or use --dry-run")
    by.check()
    drawable(plot)
    job = read_sweep(file)
    if recipes is not None and job.file.do != "optimise":
        raise ValueError(f'--recipes: this sweep only predicts; to write recipes, set do = "optimise" in {file}')
    if recipes is not None and recipes.exists() and not recipes.is_dir():
        raise ValueError(f"{recipes} is a file; name a folder")
    from gradcal_jax.sweeps import sweep as jobs

    if dry_run:
        with by.runner() as runner, Bars() as bars:
            size = jobs.dry_run(job, runner=runner, progress=bars.show)
        print(as_json(_estimate(size)) if json else _estimated(size, job))
        return DONE
    assert output is not None
    if jobs.already_finished(job, output):
        if not json:
            print(f"{output} already has all results of this sweep")
    else:
        writable(output, force=True)
        if output.exists():
            raise ValueError(f"{output} exists and belongs to another sweep; choose another output, or delete it")
        try:
            with by.runner() as runner, Bars() as bars:
                jobs.sweep(job, output, runner=runner, progress=bars.show)
        except jobs.SweepIncomplete as error:
            complain(str(error))
            return FAILED
        except KeyboardInterrupt:
            complain(
                f"interrupted; the finished points are saved in {output}.parts, and the same command "
                "continues from there"
            )
            return INTERRUPTED
    from gradcal_jax.sweeps.dataset import read_dataset

    results = read_dataset(output)
    summary = summary_of(results)
    print(as_json({"output": str(output), **summary}) if json else sweep_text(summary, job, str(output)))
    if recipes is not None:
        use_float64()
        from gradcal_jax.sweeps.recipes_of_sweep import write_recipes

        count = sum(bool(row["recipe"]) for row in write_recipes(results, recipes))
        if not json:
            print(f"{count} recipes, summary.csv and summary.md in {recipes}")
    save_figure(lambda plots: plots.draw_sweep(results), plot, quiet=json)
    return NOT_AS_WISHED if summary["failed"] else DONE


def _estimate(size: "SweepEstimate") -> dict[str, Any]:
    return {
        "points": size.points,
        "failing_in_first_chunk": size.failing,
        "first_reason": size.first_failure or None,
        "chunks": size.chunks,
        "workers": size.workers,
        "first_chunk_s": round(size.first_chunk_s, 3),
        "further_chunk_s": round(size.next_chunk_s, 3),
        "expected_s": round(size.seconds, 1),
    }


def _estimated(size: "SweepEstimate", job: "Sweep") -> str:
    fails = f"; the reason at the first of them: {size.first_failure}" if size.failing else ""
    lines = [
        strong(job.file.title or "the sweep"),
        f"{count_text(size.points, 'point')} in {count_text(size.chunks, 'chunk')} on "
        f"{count_text(size.workers, 'worker')}",
        f"in the first chunk, {count_text(size.failing, 'point')} cannot be computed{fails}",
        f"the first chunk takes {time_text(size.first_chunk_s)}, each further one {time_text(size.next_chunk_s)}",
        f"expected duration: {time_text(max(size.seconds, 1.0))}",
    ]
    return "\n".join(lines)


def summary_of(results: "xarray.Dataset") -> dict[str, Any]:
    """Numbers of points, and for each requirement's own statistic its range, and the place of its minimum."""
    import numpy as np

    failed = int(np.count_nonzero(results["failure"].values != ""))
    reasons = Counter(str(reason) for reason in results["failure"].values.ravel() if reason)
    axes = [str(name) for name in results.coords]
    rows: list[dict[str, Any]] = []
    for name, variable in results.data_vars.items():
        if variable.attrs.get("decisive") != "yes":
            continue
        verdicts = results[variable.attrs["verdict"]].values
        values = variable.values
        row: dict[str, Any] = {
            "name": variable.attrs["requirement"],
            "statistic": variable.attrs["statistic"],
            "variable": str(name),
            "unit": variable.attrs["units"],
            "least": None,
        }
        if np.isfinite(values).any():
            best = np.unravel_index(int(np.nanargmin(values)), values.shape)
            at = dict(zip(map(str, variable.dims), best, strict=True))
            places = {axis: results[axis].values[at[str(results[axis].dims[0])]] for axis in axes}
            row |= {
                "least": float(values[best]),
                "median": float(np.nanmedian(values)),
                "most": float(np.nanmax(values)),
                "least_at": {a: float(v) if isinstance(v, np.floating) else str(v) for a, v in places.items()},
            }
        rows.append(row | {word: int(np.count_nonzero(verdicts == word)) for word in _VERDICTS})
    return {
        "status": results.attrs["status"],
        "points": int(results["failure"].size),
        "failed": failed,
        "commonest_reason": reasons.most_common(1)[0][0] if reasons else None,
        "requirements": rows,
    }


def sweep_text(summary: dict[str, Any], job: "Sweep", output: str) -> str:
    """The summary of a sweep as text."""
    points, failed = summary["points"], summary["failed"]
    lines = [strong(job.file.title or output), f"{points} points, {failed} of them failed"]
    if failed:
        lines.append(f"the most frequent reason: {summary['commonest_reason']}")
    table: list[tuple[str, ...]] = [("residual (1σ)", "least", "median", "most", " / ".join(_VERDICTS))]
    for row in summary["requirements"]:
        values = ("none",) * 3
        if row["least"] is not None:
            values = tuple(amount(row[k], row["unit"]) for k in ("least", "median", "most"))
        verdicts = " / ".join(str(row[word]) for word in _VERDICTS)
        table.append((f"{row['name']}, {row['statistic']}", *values, verdicts))
    lines += ["", columns(table, indent="")]
    for row in summary["requirements"]:
        if row["least"] is not None:
            places = row["least_at"].items()
            where = (f"{axis} {value:.6g}" if isinstance(value, float) else f"{axis} {value}" for axis, value in places)
            lines.append(f"{row['name']}: least at {', '.join(where)}")
    return "\n".join([*lines, f"results: {output}"])
