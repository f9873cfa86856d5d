"""What `gradcal estimate` says of a whole unit."""

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

from gradcal_jax.cli.console import strong
from gradcal_jax.cli.output import as_json, save_figure
from gradcal_jax.cli.recordings import described
from gradcal_jax.cli.status import DONE, NOT_AS_WISHED
from gradcal_jax.pages.plain_text import amount
from gradcal_jax.pages.plain_text import columns as table

if TYPE_CHECKING:
    from gradcal_jax.api.hand_estimate import HandReport
    from gradcal_jax.api.unit_estimate import UnitReport
    from gradcal_jax.files.log import Log
    from gradcal_jax.files.unit_spec import UnitSpec


def estimate_of_units(
    spec: "UnitSpec",
    logs: "Sequence[Log]",
    names: Sequence[str],
    units: Sequence[str],
    *,
    options: Mapping[str, Any],
    files: Mapping[str, Path],
    sources: dict[str, str],
    plot: Path | None,
    json: bool,
) -> int:
    """Estimate, print, write. The exit status: see `gradcal estimate`."""
    from gradcal_jax.api.estimate_options import Options
    from gradcal_jax.api.unit_estimate import estimate_units, unit_estimate_rows

    reports = estimate_units(spec, logs, units=units, options=Options(**options), sources=sources)
    if json:
        print(as_json({"units": [unit_estimate_rows(report) for report in reports]}))
    else:
        print("\n".join(described(log, name) for log, name in zip(logs, names, strict=True)))
        for report in reports:
            print(_text(report))
    write_calibrations(reports, files, quiet=json)
    if plot is not None:
        from gradcal_jax.plots.unit_calibration import draw_unit_estimate

        save_figure(draw_unit_estimate(reports[0]), plot, quiet=json)
    return DONE if all(report.as_wished for report in reports) else NOT_AS_WISHED


def write_calibrations(
    reports: "Sequence[UnitReport] | Sequence[HandReport]", files: Mapping[str, Path], *, quiet: bool
) -> None:
    """Write the calibration of every unit that has a file to go to."""
    from gradcal_jax.files.unit_calibration import write_unit_calibration

    for report in reports:
        if (path := files.get(report.unit)) is not None:
            write_unit_calibration(report.calibration, path)
            if not quiet:
                print(f"wrote {path}")


def _text(report: "UnitReport") -> str:
    import numpy as np

    from gradcal_jax.api.unit_residual import UNITS_OF_TERMS
    from gradcal_jax.units import G

    found, model = report.calibration, report.built.model
    lines = ["", strong(f"unit {report.unit}" + (", SIMULATED" if found.simulated else ""))]
    low, high = found.valid_temperature
    fastest = np.degrees(float(found.valid_rate[1]))
    rows = int(np.count_nonzero(report.found.used))
    lines.append(f"{rows} rows of {len(model.channels)} channels; covers {low} … {high}, up to {fastest:.4g} deg/s")
    lines.append(f"frame: {found.frame}")
    shown = [("requirement", "statistic", "residual (1σ)", "of", "target", "verdict")]
    for result, row in zip(found.result, report.requirements, strict=True):
        target = "" if row.target is None else amount(row.target, row.unit)
        worst = (row.limited_by or "").removeprefix("axis ")
        shown.append((row.name, row.statistic, amount(result.value, row.unit), worst, target, row.verdict or ""))
    lines += ["", table(shown, indent="")]
    spread = _sizes(report)
    lines += ["", "what was found, at most over the temperatures:", table(spread, right=(1, 2))]
    if report.internal:
        inside = [("between the axes", "value", "1σ", "")]
        inside += [(m.name, f"{m.value * 1e6:.2f}", f"{m.std * 1e6:.2g}", "µrad") for m in report.internal]
        lines += [table(inside, right=(1, 2))]
    if found.table:
        of_table: list[tuple[str, ...]] = [("what the run says of the table", "value", "1σ", "known to", "")]
        for error in found.table:
            unit, factor = UNITS_OF_TERMS.get(error.unit, (error.unit, 1.0))
            numbers = (f"{v * factor:.4g}" for v in (error.value, error.standard_deviation, error.prior))
            of_table.append((error.name.replace("_", " "), *numbers, unit))
        lines += [table(of_table, right=(1, 2, 3))]
    tests = [("test", "statistic", "degrees", "chance")]
    tests += [(t.name.replace("_", " "), f"{t.statistic:.1f}", str(t.degrees), f"{t.chance:.2g}") for t in found.fit]
    lines += [table(tests, right=(1, 2, 3))]
    if report.gravity is not None:
        before, after = (1e6 * v / G for v in report.gravity)
        lines.append(f"|f| - g over the rests: {before:.4g} µg rms as measured, {after:.4g} µg corrected")
    return "\n".join([*lines, *(f"note: {message}" for message in report.messages)])


def _sizes(report: "UnitReport") -> list[tuple[str, ...]]:
    """Of every channel's terms: the largest value over temperature (and rate)."""
    import numpy as np

    from gradcal_jax.api.unit_residual import UNITS_OF_TERMS
    from gradcal_jax.files.unit_correction import term_values

    found = report.calibration
    low, high = (float(t) for t in found.valid_temperature)
    slow, fast = (float(r) for r in found.valid_rate)
    temperature, rate = (x.ravel() for x in np.meshgrid(np.linspace(low, high, 41), np.linspace(slow, fast, 21)))
    rows = [("term", "largest", "at 20 °C", "")]
    for channel in found.channel:
        for term in channel.term:
            unit, factor = UNITS_OF_TERMS.get(term.unit, (term.unit, 1.0))
            values = term_values(term, temperature, rate) * factor
            middle = term_values(term, np.array([np.clip(20.0, low, high)]), np.zeros(1))[0] * factor
            name = f"{channel.name} {term.name}".replace("_", " ")
            rows.append((name, f"{np.max(np.abs(values)):.5g}", f"{middle:.5g}", unit))
    return rows
