"""`gradcal report`: one page with plan, prediction, run and calibration."""

import itertools
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

from cyclopts import Parameter

from gradcal_jax.cli.output import DONE, Flag, Force, Json, Output, as_json, writable
from gradcal_jax.cli.precision import use_float64

if TYPE_CHECKING:
    from gradcal_jax.pages.sources import Sources


def report(
    sources: Annotated[tuple[Path, ...], Parameter(negative="")],
    /,
    *,
    output: Output,
    before: Path | None = None,
    limits: Path | None = None,
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
    limits
        A file with the output of `gradcal limit --json` for the plan; the page then also shows the efficiency of the
        plan.
    certificate
        Instead of the page, make a certificate that a laboratory can sign.
    rig
        The rig file with [laboratory] and [[reference]] for the certificate.
    number
        The number of the certificate.
    customer
        The customer on the certificate.
    operator
        The operator of the calibration on the certificate; by default that of the rig file.
    performed
        The date of the calibration, such as 2026-11-22 or 2026-11-21..2026-11-22; by default the day of the run.
    dcc
        Also write the certificate as a Digital Calibration Certificate (PTB's XML).
    json
        Also print every number of the page as JSON.
    """
    from gradcal_jax.pages.sources import calibrations_in, read_sources

    if not certificate and (rig is not None or dcc is not None or number or customer or operator or performed):
        raise ValueError("--rig, --number, --customer, --operator, --performed and --dcc belong to --certificate")
    several = calibrations_in(sources[0]) if len(sources) == 1 and sources[0].is_dir() else []
    names = {one: one.stem.removeprefix("calibration").strip("-_") or one.stem for one in several}
    each = [((*sources, one), f"-{name}") for one, name in names.items()] if len(several) > 1 else [(sources, "")]
    files = [tuple(p and p.with_stem(p.stem + more) for p in (output, dcc)) for _, more in each]
    for path in itertools.chain(*files):
        if path is not None:
            writable(path, force)
    words = {"number": number, "customer": customer, "operator": operator, "performed": performed}
    tables: list[Any] = []
    for (of, _), (page, xml) in zip(each, files, strict=True):
        assert page is not None
        documents = read_sources(of, before=before, limits=limits)
        use_float64()
        if certificate:
            tables.append(_certificate(documents, page, xml, rig, words))
        else:
            from gradcal_jax.pages.page import write_page
            from gradcal_jax.pages.report_data import as_tables

            tables.append(as_tables(write_page(documents, page)))
        if not json:
            print(f"wrote {page}" + (f" and {xml}" if xml is not None else ""))
    if json:
        print(as_json(tables if len(each) > 1 else tables[0]))
    return DONE


def _certificate(documents: "Sources", page: Path, xml: Path | None, rig: Path | None, words: dict[str, str]) -> Any:
    """Write a certificate, and a DCC; what `--json` prints of it."""
    from gradcal_jax.pages import certificate as room
    from gradcal_jax.spec.rig import read_rig

    read = None if rig is None else read_rig(rig)
    document = room.certificate_of(documents, read, **words)
    if xml is not None:
        from gradcal_jax.pages.dcc import write_dcc

        write_dcc(document, xml)
    room.write_certificate(document, page)
    return room.certificate_tables(document)
