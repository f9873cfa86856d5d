"""`gradcal report`: one page with plan, prediction, run and calibration, with a certificate to sign where wanted."""

from pathlib import Path
from typing import Annotated, Any

from cyclopts import Parameter

from gradcal_jax.cli.output import DONE, Flag, Force, Json, Output, as_json, writable
from gradcal_jax.cli.precision import use_float64


def report(
    sources: Annotated[tuple[Path, ...], Parameter(negative="")],
    /,
    *,
    output: Output,
    before: Path | None = None,
    certificate: Flag = False,
    rig: Path | None = None,
    number: str = "",
    customer: str = "",
    performed: str = "",
    force: Force = False,
    json: Json = False,
) -> int:
    """Make one HTML page that describes a plan, a run or a calibration. The page needs no network and can be printed.

    Parameters
    ----------
    sources
        The folder of a run, a recipe, a spec or a calibration, or several of these that belong together. If the folder
        of a run has a calibration, the page includes it; if the folder has several calibrations, each of them gets a
        page of its own.
    output
        The page to write (.html). For several pages, the part after "calibration-" in the name of each calibration is
        added to the file name.
    before
        A spec or recipe whose predicted errors the page shows for comparison; by default, the errors before a
        calibration, from the priors of the spec.
    certificate
        Put a certificate that a laboratory can sign in front of the page.
    rig
        The rig file with [laboratory] and [[reference]] for the certificate.
    number
        The number of the certificate.
    customer
        The customer on the certificate.
    performed
        The date of the calibration, such as 2026-11-22 or 2026-11-21..2026-11-22; by default the day of the run.
    json
        Also print every table of the page as JSON.
    """
    from gradcal_jax.pages.sources import calibrations_in, read_sources

    if not certificate and (rig is not None or number or customer or performed):
        raise ValueError("--rig, --number, --customer and --performed belong to --certificate")
    several = calibrations_in(sources[0]) if len(sources) == 1 and sources[0].is_dir() else []
    pages: dict[Path, tuple[Path, ...]] = {output: sources}
    if len(several) > 1:
        names = {one: one.stem.removeprefix("calibration").strip("-_") or one.stem for one in several}
        pages = {output.with_stem(f"{output.stem}-{name}"): (*sources, one) for one, name in names.items()}
    for path in pages:
        writable(path, force)
    tables: list[Any] = []
    for path, of in pages.items():
        documents = read_sources(of, before=before)
        use_float64()
        from gradcal_jax.pages.page import write_page

        words = {"number": number, "customer": customer, "performed": performed}
        tables.append(write_page(documents, path, certificate=words if certificate else None, rig=rig))
        if not json:
            print(f"wrote {path}")
    if json:
        print(as_json(tables if len(pages) > 1 else tables[0]))
    return DONE
