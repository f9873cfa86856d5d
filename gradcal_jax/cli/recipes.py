"""`gradcal recipes`: a recommended recipe for every sensor, rig and requirement of a catalogue, and one table."""

from pathlib import Path
from typing import TYPE_CHECKING

from gradcal_jax.cli.console import complain, strong
from gradcal_jax.cli.output import Json, Output, as_json
from gradcal_jax.cli.progress import Bars
from gradcal_jax.cli.status import DONE, INTERRUPTED, NOT_AS_WISHED
from gradcal_jax.cli.workers import THIS_MACHINE, Workers
from gradcal_jax.pages.plain_text import amount, columns

if TYPE_CHECKING:
    from gradcal_jax.jobs.catalogue import Table


def recipes(catalogue: Path, /, *, output: Output, by: Workers = THIS_MACHINE, json: Json = False) -> int:
    """Optimise a plan for every sensor, rig, requirement and plan of a catalogue; write recipes and one table.

    What is finished is kept: killed at any time, the same command goes on where it was. The exit status is 1 where a
    case has no recipe, misses its target or did not converge; the table says which.

    Parameters
    ----------
    catalogue
        The catalogue file (gradcal-catalogue/1).
    output
        The folder for the recipes, summary.csv and summary.md; it is made where it is not there.
    json
        Print the table as JSON.
    """
    from gradcal_jax.files.catalogue import read_catalogue

    by.check()
    job = read_catalogue(catalogue)
    if output.exists() and not output.is_dir():
        raise ValueError(f"{output} is a file; name a folder")
    from gradcal_jax.jobs import catalogue as jobs

    try:
        with by.runner() as runner, Bars() as bars:
            table = jobs.recipes(job, output, runner=runner, progress=bars.show)
    except KeyboardInterrupt:
        complain(f"interrupted; what is finished is kept in {output}, and the same command goes on from there")
        return INTERRUPTED
    if json:
        print(as_json({"folder": str(output), "failed": table.failed, "rows": list(table.rows)}))
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
        rows.append((*case, *(amount(row[key], row["unit"]) for key in ("before", "now")), str(row["verdict"])))
        if not row["converged"]:
            remarks.append(f"{', '.join(case)}: {row['remark']}")
    return "\n".join([strong(title), columns(rows, indent=""), *remarks])
