"""`gradcal report`: one page with plan, prediction, run and calibration."""

from pathlib import Path
from typing import Annotated

from cyclopts import Parameter

from gradcal_jax.cli.output import Flag, Force, Json, Output, as_json, writable
from gradcal_jax.cli.precision import use_float64
from gradcal_jax.cli.status import DONE


def report(
    sources: Annotated[tuple[Path, ...], Parameter(negative="")],
    /,
    *,
    output: Output,
    before: Path | None = None,
    limits: Path | None = None,
    panel: Flag = False,
    certificate: Flag = False,
    rig: Path | None = None,
    number: str = "",
    customer: str = "",
    operator: str = "",
    performed: str = "",
    dcc: Path | None = None,
    force: Force = False,
    json: Json = False,
) -> int:
    """Make one HTML page of a plan, a run or a calibration: nothing is fetched, and it prints well.

    Parameters
    ----------
    sources
        The folder of a run, a recipe or a spec, a calibration, or those of them that belong together. A calibration in
        the folder of a run is taken with it, calibration.toml before others.
    output
        The page (.html).
    before
        A spec or recipe whose plan to compare with; without it, the spec's priors.
    limits
        The output of `gradcal limit --json` for the plan, in a file: the page shows the plan's efficiency.
    panel
        Sliders on the page: the residuals for another time, encoder or slope, from 75 predictions.
    certificate
        A certificate of a calibration for a laboratory to sign, in the place of the whole page.
    rig
        The rig file, whose [laboratory] and [[reference]] a certificate names.
    number
        The number of the certificate.
    customer
        The customer on the certificate.
    operator
        The operator of the calibration; without it the rig file's.
    performed
        The date of the calibration, such as 2026-11-22 or 2026-11-21..2026-11-22; without it the day of the run.
    dcc
        Write the certificate as a Digital Calibration Certificate (PTB's XML), too.
    json
        Print every number of the page as JSON.
    """
    from gradcal_jax.pages.sources import read_sources

    writable(output, force)
    if dcc is not None:
        writable(dcc, force)
    documents = read_sources(sources, before=before, limits=limits)
    use_float64()
    if certificate:
        from gradcal_jax.files.rig import read_rig
        from gradcal_jax.pages import certificate as room

        read = None if rig is None else read_rig(rig)
        words = {"number": number, "customer": customer, "operator": operator, "performed": performed}
        document = room.certificate_of(documents, read, **words)
        if dcc is not None:
            from gradcal_jax.pages.dcc import write_dcc

            write_dcc(document, read, dcc)
        room.write_certificate(document, output)
        print(
            as_json(room.certificate_tables(document))
            if json
            else f"wrote {output}" + (f" and {dcc}" if dcc is not None else "")
        )
        return DONE
    if rig is not None or dcc is not None or number or customer or operator or performed:
        raise ValueError("--rig, --number, --customer, --operator, --performed and --dcc belong to --certificate")
    from gradcal_jax.pages.report import write_page
    from gradcal_jax.pages.report_data import as_tables

    data = write_page(documents, output, panel=panel)
    if json:
        print(as_json(as_tables(data)))
    else:
        print(f"wrote {output}")
    return DONE
