"""A page from files, as by `gradcal report`."""

from collections.abc import Sequence
from pathlib import Path

from gradcal_jax.files.writing import write_whole
from gradcal_jax.pages.page import page
from gradcal_jax.pages.report_data import ReportData, report_data_of
from gradcal_jax.pages.sources import Sources, read_sources


def report(
    sources: str | Path | Sequence[str | Path],
    output: str | Path,
    *,
    before: str | Path | None = None,
    limits: str | Path | None = None,
    panel: bool = False,
) -> ReportData:
    """Make one HTML page of a plan, a run or a calibration: plan, prediction, run, estimate and how to apply it.

    `sources`: the folder of a run (a calibration in it is taken with it), a recipe or a spec, a calibration, or those
    of them that belong together. `before`: a spec or recipe whose plan to compare with.
    `limits`: the output of `gradcal limit --json`. `panel`: sliders for other times, encoders and slopes. The page
    replaces `output`; it has no external resources.

    Returns every number of the page, once (`pages.report_data.ReportData`): ppm, deg/h, °C and deg/s, 1σ. Terms are
    those of IEEE 952, 1431 and 1780. Errors: `ValueError` for sources that cannot be read or do not belong on one page.
    """
    paths = [sources] if isinstance(sources, str | Path) else sources
    documents = read_sources(
        [Path(source) for source in paths],
        before=None if before is None else Path(before),
        limits=None if limits is None else Path(limits),
    )
    return write_page(documents, output, panel=panel)


def write_page(sources: Sources, output: str | Path, *, panel: bool = False) -> ReportData:
    """Write the page of `sources`."""
    data = report_data_of(sources)
    write_whole(output, page(sources, data, panel=panel))
    return data
