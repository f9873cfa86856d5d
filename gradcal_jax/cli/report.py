"""`gradcal report`: one page of what was planned, predicted, done and found, for people."""

from pathlib import Path
from typing import Annotated

from cyclopts import App, Parameter

from gradcal_jax.cli.output import Flag, Json, Output, as_json, writable
from gradcal_jax.cli.status import DONE


def register(app: App) -> None:
    """Add the commands of this family."""
    app.command(report)


def report(
    sources: Annotated[tuple[Path, ...], Parameter(negative="")],
    /,
    *,
    output: Output,
    before: Path | None = None,
    limits: Path | None = None,
    force: Flag = False,
    json: Json = False,
) -> int:
    """Make one HTML page of a recipe, a run, a calibration or a unit's plan: nothing is fetched, and it prints well.

    Parameters
    ----------
    sources
        The folder of a run, a recipe, a calibration, or those of them that belong together. A calibration.toml in the
        folder of a run is taken with it. Of a whole unit, its spec.
    output
        The page (.html).
    before
        A spec or recipe whose plan to compare with; without it, what the spec's priors say.
    limits
        What `gradcal limit --json` printed of the plan, kept in a file: the page says how near the plan comes.
    force
        Overwrite an existing file.
    json
        Print every number of the page as JSON.
    """
    from gradcal_jax.cli.precision import use_float64
    from gradcal_jax.pages.sources import read_sources

    writable(output, force)
    found = read_sources(sources, before=before, limits=limits)
    use_float64()
    from gradcal_jax.pages.facts import as_tables
    from gradcal_jax.pages.report import write_page

    facts = write_page(found, output)
    if json:
        print(as_json(as_tables(facts)))
    else:
        print(f"wrote {output}")
    return DONE
