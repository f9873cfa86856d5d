"""`gradcal sweep`: many plans, on the cores of this machine."""

import sys
from collections import Counter
from pathlib import Path
from typing import TYPE_CHECKING, Any

from gradcal_jax.cli.output import FAILED, INTERRUPTED, Json, Output, Plot, complain, drawable, show, strong
from gradcal_jax.cli.progress import MovingLine
from gradcal_jax.tables.table import Cell, Table

if TYPE_CHECKING:
    import xarray


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

        def progress(done: int, total: int) -> None:
            line.show(f"{done} of {total} points", done / total, number=10 * done // total)

        try:
            with room.local_workers(workers) as executors:
                results = room.sweep(job, output, workers=executors, most=workers, progress=progress)
        except room.SweepIncomplete as error:
            complain(str(error))
            return FAILED
        except KeyboardInterrupt:
            complain(f"interrupted; finished points are in {output}.parts, and the same command continues from there")
            return INTERRUPTED
    table = summary_of(results)
    failures = [str(reason) for reason in results["failure"].values.ravel() if reason]
    done = f"{results['failure'].size} points"
    if failures:
        reasons = Counter(failures).most_common()
        more = f" (and {len(reasons) - 1} other reasons, in the results)" if len(reasons) > 1 else ""
        done += f"; {len(failures)} of them failed: {reasons[0][0]}{more}"
    lines = [strong(job.file.title or str(output)), done, "", table.text(), f"results: {output}"]
    if plot is not None:
        from gradcal_jax.plots import draw_sweep, save

        save(draw_sweep(results), plot)
        lines.append(f"wrote {plot}")
    record = {"output": str(output), "points": int(results["failure"].size), "failures": failures}
    record["requirements"] = table.json()
    return show("\n".join(lines), record, json=json, wished=not failures)


def summary_of(results: "xarray.Dataset") -> Table:
    """For each requirement's own statistic the range of its values, how many meet the target, and the place of the
    least."""
    import numpy as np

    rows: list[tuple[Cell, ...]] = []
    for variable in results.data_vars.values():
        values, about = variable.values, variable.attrs
        if about.get("decisive") == "yes" and np.isfinite(values).any():
            best = np.unravel_index(int(np.nanargmin(values)), values.shape)
            at = dict(zip(variable.dims, best, strict=True))
            places = {axis: results[axis].values[at[results[axis].dims[0]]] for axis in results.coords}
            where = [_place(str(axis), value, results[axis].attrs.get("units", "1")) for axis, value in places.items()]
            sizes = (float(of(values)) for of in (np.nanmin, np.nanmedian, np.nanmax))
            verdicts = Counter(results[about["verdict"]].values.ravel())
            met = verdicts["met"] if {"met", "missed"} & verdicts.keys() else None  # without a target
            name = f"{about['requirement']}, {about['statistic']}"
            rows.append((name, *sizes, str(about["units"]), met, ", ".join(where)))
    return Table.of(["residual (1σ)", "least", "median", "most", "unit", "met", "least at"], rows)


def _place(axis: str, value: Any, unit: str) -> str:
    """A value of an axis: "gradient 0.5 K/min"."""
    number = str(value) if isinstance(value, str) else f"{value:.6g}"
    return f"{axis} {number}" + f" {unit}" * (unit != "1")
