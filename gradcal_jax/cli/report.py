"""`gradcal report`: one page with plan, prediction, run and calibration, with a certificate to sign where wanted."""

from pathlib import Path
from typing import Annotated

from cyclopts import Parameter

from gradcal_jax.cli.output import Force, Json, Output, Switch, show, writable
from gradcal_jax.cli.precision import use_float64


def report(
    sources: Annotated[tuple[Path, ...], Parameter(negative="")],
    /,
    *,
    output: Output,
    certificate: Switch = False,
    rig: Path | None = None,
    number: str = "",
    customer: str = "",
    force: Force = False,
    json: Json = False,
) -> int:
    """Make one HTML page that describes a plan, a run or a calibration. The page needs no network and can be printed.

    Parameters
    ----------
    sources
        The folder of a run, a recipe, a spec or a calibration, or several of these that belong together. If the folder
        of a run has a calibration, the page includes it; if it has several, also name one of them.
    output
        The page to write (.html).
    certificate
        Put a certificate that a laboratory can sign in front of the page.
    rig
        The rig file with [laboratory] and [[reference]] for the certificate.
    number
        The number of the certificate.
    customer
        The customer on the certificate.
    json
        Also print every table of the page as JSON.
    """
    from gradcal_jax.pages.sources import read_sources

    if not certificate and (rig is not None or number or customer):
        raise ValueError("--rig, --number and --customer belong to --certificate")
    if output.suffix.lower() not in (".html", ".htm"):
        raise ValueError(f"{output}: the name of a page must end in .html; a browser prints it, or saves it as a PDF")
    writable(output, force)
    documents = read_sources(sources)
    use_float64()
    from gradcal_jax.pages.page import write_page

    words = {"number": number, "customer": customer}
    tables = write_page(documents, output, certificate=words if certificate else None, rig=rig)
    return show(f"wrote {output}", tables, json=json)
