"""`gradcal recipes`: a recommended recipe for every sensor, rig and requirement of a catalogue, and one table."""

import json as as_json
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

from cyclopts import App, Parameter

from gradcal_jax.cli.console import columns, complain, is_plain, strong

if TYPE_CHECKING:
    from gradcal_jax.jobs.catalogue import Table

DONE, NOT_AS_WISHED = 0, 1


def register(app: App) -> None:
    """Add the commands of this family."""
    app.command(recipes)


def recipes(
    catalogue: Path,
    /,
    *,
    output: Annotated[Path, Parameter(name=["--output", "-o"])],
    scheduler: str | None = None,
    workers: int | None = None,
    json: Annotated[bool, Parameter(name="--json", negative="")] = False,
) -> int:
    """Optimise a plan for every sensor, rig, requirement and plan of a catalogue; write recipes and one table.

    What is finished is kept: killed at any time, the same command goes on where it was. The exit status is 1 where a
    case has no recipe, misses its target or did not converge; the table says which.

    Parameters
    ----------
    catalogue
        The catalogue file (gradcal-catalogue/1).
    output
        The folder for the recipes, summary.csv and summary.md; it is made where it is not there.
    scheduler
        Address of a Dask scheduler, such as tcp://host:8786; without it the cores of this machine do the work.
    workers
        Worker processes on this machine; as many as cores.
    json
        Print the table as JSON.
    """
    from gradcal_jax.cli.sweep import check_workers, runner_for
    from gradcal_jax.files.catalogue import read_catalogue

    check_workers(scheduler, workers)
    job = read_catalogue(catalogue)
    if output.exists() and not output.is_dir():
        raise ValueError(f"{output} is a file; name a folder")
    from gradcal_jax.jobs import catalogue as jobs

    try:
        with runner_for(scheduler, workers) as runner, _Bar() as report:
            table = jobs.recipes(job, output, runner=runner, progress=report)
    except KeyboardInterrupt:
        complain(f"interrupted; what is finished is kept in {output}, and the same command goes on from there")
        return 130
    if json:
        print(as_json.dumps({"folder": str(output), "failed": table.failed, "rows": list(table.rows)}, indent=2))
    else:
        print(text(table, job.file.title or str(catalogue)))
        print(f"{len(table.rows) - table.failed} recipes, summary.csv and summary.md in {output}")
    fine = all(row["recipe"] and row["converged"] and row["verdict"] in ("", "met") for row in table.rows)
    return DONE if fine else NOT_AS_WISHED


def text(table: "Table", title: str) -> str:
    """The table as people read it."""
    rows: list[tuple[str, ...]] = [("sensor", "rig", "requirement", "plan", "as written", "optimised", "verdict")]
    remarks: list[str] = []
    for row in table.rows:
        case = tuple(str(row[name]) for name in ("sensor", "rig", "requirement", "plan"))
        if not row["recipe"]:
            rows.append((*case, "", "no recipe", ""))
            remarks.append(f"{', '.join(case)}: {row['remark']}")
            continue
        before = "not observable" if row["before"] is None else f"{row['before']:.4g} {row['unit']}"
        rows.append((*case, before, f"{row['now']:.4g} {row['unit']}", str(row["verdict"])))
        if not row["converged"]:
            remarks.append(f"{', '.join(case)}: {row['remark']}")
    return "\n".join([strong(title), columns(rows, indent=""), *remarks])


class _Bar:
    """A bar on a terminal; one line a case on stderr away from it."""

    def __enter__(self) -> Any:
        import sys

        self._bar: Any = None
        if is_plain(sys.stderr):
            return lambda found: (
                found.last and print(f"{found.done}/{found.total} {found.last}", file=sys.stderr, flush=True)
            )
        from rich.console import Console
        from rich.progress import Progress

        self._bar = Progress(console=Console(stderr=True))
        self._task = self._bar.add_task("optimising", total=None)
        self._bar.start()
        return self._report

    def _report(self, found: Any) -> None:
        self._bar.update(self._task, total=found.total, completed=found.done)
        if found.last:
            self._bar.console.print(found.last, highlight=False, markup=False)

    def __exit__(self, *_: object) -> None:
        if self._bar is not None:
            self._bar.stop()
