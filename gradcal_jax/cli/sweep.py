"""`gradcal sweep`: many plans, on the cores of this machine."""

import sys
from collections import Counter
from pathlib import Path
from typing import TYPE_CHECKING, Any, Final

from gradcal_jax.cli.output import (
    DONE,
    FAILED,
    INTERRUPTED,
    NOT_AS_WISHED,
    Json,
    Output,
    Plot,
    as_json,
    complain,
    drawable,
    save_figure,
    strong,
)
from gradcal_jax.cli.progress import MovingLine
from gradcal_jax.tables.display import amount
from gradcal_jax.tables.table import Table

if TYPE_CHECKING:
    import xarray

_VERDICTS: Final = ("met", "missed", "unobservable")


def sweep(
    file: Path,
    /,
    *,
    output: Output,
    workers: int | None = None,
    json: Json = False,
    plot: Plot = None,
) -> int:
    """Predict (or optimise) the plan of a spec for many values of its keys, and write all results to a netCDF file.

    The results have labels and units. Finished points are kept next to the output file; if the sweep is interrupted,
    the same command continues it. The exit status is 1 if some points could not be computed; the results state the
    reasons.

    Parameters
    ----------
    file
        The sweep file (gradcal-sweep/1): a base spec, and values for its keys; gradcal start sweep writes an example.
    output
        The results to write (.nc).
    workers
        Number of worker processes on this computer; by default the number of its cores.
    json
        Print the summary as JSON.
    plot
        Draw the results into this file (.png, .svg, .pdf).
    """
    from gradcal_jax.sweeps.sweep_file import read_sweep

    if workers is not None and not 1 <= workers <= 1024:
        raise ValueError(f"--workers {workers}: must be from 1 to 1024")
    drawable(plot)
    job = read_sweep(file)
    from gradcal_jax.sweeps import sweep as room

    with MovingLine(sys.stderr) as line:

        def show(done: int, total: int) -> None:
            line.show(f"{done} of {total} points", done / total, number=10 * done // total)

        try:
            with room.local_workers(workers) as executors:
                results = room.sweep(job, output, workers=executors, most=workers, progress=show)
        except room.SweepIncomplete as error:
            complain(str(error))
            return FAILED
        except KeyboardInterrupt:
            complain(f"interrupted; finished points are in {output}.parts, and the same command continues from there")
            return INTERRUPTED
    summary = summary_of(results)
    if json:
        print(as_json({"output": str(output), **summary}))
    else:
        print(strong(job.file.title or str(output)))
        print(sweep_text(summary))
        print(f"results: {output}")
    save_figure(lambda plots: plots.draw_sweep(results), plot, quiet=json)
    return NOT_AS_WISHED if summary["failed"] else DONE


def summary_of(results: "xarray.Dataset") -> dict[str, Any]:
    """Numbers of points, and for each requirement's own statistic its range and the place of its minimum."""
    failures = [str(reason) for reason in results["failure"].values.ravel() if reason]
    reasons = Counter(failures).most_common(1)
    decisive = [name for name, variable in results.data_vars.items() if variable.attrs.get("decisive") == "yes"]
    return {
        "points": int(results["failure"].size),
        "failed": len(failures),
        "commonest_reason": reasons[0][0] if reasons else None,
        "requirements": [_summary_of_one(results, str(name)) for name in decisive],
    }


def _summary_of_one(results: "xarray.Dataset", name: str) -> dict[str, Any]:
    import numpy as np

    variable = results[name]
    values = variable.values
    about = variable.attrs
    row: dict[str, Any] = {"name": about["requirement"], "statistic": about["statistic"], "variable": name}
    row["unit"] = about["units"]
    if np.isfinite(values).any():
        best = np.unravel_index(int(np.nanargmin(values)), values.shape)
        at = dict(zip(map(str, variable.dims), best, strict=True))
        places = {str(axis): results[axis].values[at[str(results[axis].dims[0])]] for axis in results.coords}
        row["least"] = float(values[best])
        row["median"] = float(np.nanmedian(values))
        row["most"] = float(np.nanmax(values))
        row["least_at"] = {a: float(v) if isinstance(v, np.floating) else str(v) for a, v in places.items()}
    verdicts = results[about["verdict"]].values
    return row | {word: int(np.count_nonzero(verdicts == word)) for word in _VERDICTS}


def sweep_text(summary: dict[str, Any]) -> str:
    """The summary of a sweep as text."""
    lines = [f"{summary['points']} points, {summary['failed']} of them failed"]
    if summary["failed"]:
        lines.append(f"the most frequent reason: {summary['commonest_reason']}")
    rows: list[tuple[str, ...]] = []
    for row in summary["requirements"]:
        if "least" in row:
            verdicts = " / ".join(str(row[word]) for word in _VERDICTS)
            values = [amount(row[key], row["unit"]) for key in ("least", "median", "most")]
            where = [f"{a} {v:.6g}" if isinstance(v, float) else f"{a} {v}" for a, v in row["least_at"].items()]
            rows.append((f"{row['name']}, {row['statistic']}", *values, verdicts, ", ".join(where)))
    heads = ["residual (1σ)", "least", "median", "most", " / ".join(_VERDICTS), "least at"]
    return "\n".join([*lines, "", Table.of(heads, rows).text()])
