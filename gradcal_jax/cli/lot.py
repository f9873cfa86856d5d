"""`gradcal lot`: what the calibrations of a number of IMUs say of their type."""

from pathlib import Path
from typing import TYPE_CHECKING, Annotated

from cyclopts import Parameter

from gradcal_jax.cli.console import strong
from gradcal_jax.cli.output import (
    ForceOutput,
    JsonNumbers,
    OptionalOutput,
    Plot,
    as_json,
    drawable,
    save_figure,
    writable,
)
from gradcal_jax.cli.status import DONE, NOT_AS_WISHED
from gradcal_jax.pages.plain_text import columns

if TYPE_CHECKING:
    from gradcal_jax.api.lot import Lot


def lot(
    calibrations: Annotated[tuple[Path, ...], Parameter(negative="")],
    /,
    *,
    output: OptionalOutput = None,
    force: ForceOutput = False,
    json: JsonNumbers = False,
    plot: Plot = None,
) -> int:
    """Compute the mean and the spread of a type of IMU from calibrations of several IMUs, map by map.

    The spread excludes the uncertainty of each calibration. A chi-squared test at 1 % gives the number of shapes that
    repeat; further tests report groups, and outliers at 1 % over the whole lot. The exit status is 1 if there are
    outliers or groups, or if priors are requested and no shape repeats.

    Parameters
    ----------
    calibrations
        Calibration files, one for each IMU, estimated with the same spec; three or more.
    output
        Write priors for the spec of the next IMU to this file (.toml), if the shapes repeat.
    plot
        Draw the maps of all IMUs, their mean and their shapes into this file (.png, .svg, .pdf).
    """
    from gradcal_jax.files.calibration import read_calibration

    if output is not None:
        writable(output, force)
    drawable(plot)
    read = [read_calibration(path) for path in calibrations]
    from gradcal_jax.api import lot as work

    found = work.lot(read)
    print(as_json(work.lot_tables(found)) if json else lot_text(found))
    save_figure(lambda plots: plots.draw_lot(found), plot, quiet=json)
    status = NOT_AS_WISHED if any(one.strangers or one.groups for one in found.maps) else DONE
    if output is None:
        return status
    if all(one.prior is None for one in found.maps):
        from gradcal_jax.cli.console import complain

        complain(f"no prior is written into {output}: no map of this lot repeats")
        return NOT_AS_WISHED
    from gradcal_jax.files.writing import write_whole

    write_whole(output, work.lot_priors(found))
    if not json:
        print(f"wrote {output}")
    return status


def lot_text(found: "Lot") -> str:
    """A lot for people: a row for each map, then what each says in sentences."""
    rows = [("map", "IMUs", "mean, rms", "spread, rms", "", "shapes")]
    for one in found.maps:
        numbers = f"{one.mean_rms:.4g}", f"{one.spread_rms:.3g}", one.unit
        name = f"{one.channel} {one.term.replace('_', ' ')}"
        rows.append((name, f"{len(one.serial_numbers) - len(one.strangers)}", *numbers, one.shapes_in_words))
    simulated = ", SIMULATED" if found.simulated else ""
    lines = [strong(f"lot of {len(found.serial_numbers)} IMUs{simulated}"), columns(rows, indent="", right=(1, 2, 3))]
    for one in found.maps:
        for sentence in one.findings:
            lines.append(sentence)
    return "\n".join([*lines, *(f"note: {note}" for note in found.notes)])
