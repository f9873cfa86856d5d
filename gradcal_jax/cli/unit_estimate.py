"""Results of `gradcal estimate` for whole units as text: on a table, or turned by hand (`--gravity`)."""

from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any, TypeVar

import numpy as np

from gradcal_jax.cli.console import strong
from gradcal_jax.cli.output import as_json
from gradcal_jax.cli.status import DONE, NOT_AS_WISHED
from gradcal_jax.files.calibration import write_calibration
from gradcal_jax.files.calibration.correction import term_values
from gradcal_jax.files.requirement_table import requirement_table
from gradcal_jax.pages.plain_text import columns as table
from gradcal_jax.units import G

if TYPE_CHECKING:
    from gradcal_jax.api.hand_estimate import HandReport
    from gradcal_jax.api.unit_estimate import UnitReport
    from gradcal_jax.files.contracts import RequirementRow

Report = TypeVar("Report", "UnitReport", "HandReport")


def say_units(
    reports: "Sequence[Report]",
    descriptions: Sequence[str],
    text: "Callable[[Report], str]",
    rows: "Callable[[Report], dict[str, Any]]",
    files: Mapping[str, Path],
    *,
    json: bool,
) -> int:
    """Print and write estimates of whole units, after `descriptions` of their logs; returns the exit status."""
    print(as_json({"units": list(map(rows, reports))}) if json else "\n".join([*descriptions, *map(text, reports)]))
    for report in reports:
        if (path := files.get(report.unit)) is not None:
            write_calibration(report.calibration, path)
            if not json:
                print(f"wrote {path}")
    return DONE if all(report.as_wished for report in reports) else NOT_AS_WISHED


def _head(report: "UnitReport | HandReport", counted: str) -> list[str]:
    calibration = report.calibration
    low, high = calibration.valid_temperature
    fastest = np.degrees(float(calibration.valid_rate[1]))
    return [
        "",
        strong(f"unit {report.unit}" + (", SIMULATED" if calibration.simulated else "")),
        f"{counted}; covers {low} … {high}, up to {fastest:.4g} deg/s",
        f"frame: {calibration.frame}",
    ]


def _tests(report: "UnitReport | HandReport") -> str:
    rows = [("test", "statistic", "degrees", "chance")]
    for test in report.calibration.fit:
        name = test.name.replace("_", " ")
        rows.append((name, f"{test.statistic:.1f}", str(test.degrees), f"{test.chance:.2g}"))
    return table(rows, right=(1, 2, 3))


def requirement_lines(rows: "Sequence[RequirementRow]") -> list[str]:
    """The requirements as an estimate meets them, and the rules of their verdicts."""
    names = [f"{row.name}, {row.limited_by or f'axis {row.axis}'}" for row in rows]
    shown = requirement_table(rows, names)
    return ["", table(shown, indent=""), *(f"{n}: {row.rule}" for n, row in zip(names, rows, strict=True) if row.rule)]


def text_of_estimate(report: "UnitReport") -> str:
    from gradcal_jax.api.unit_residual import UNITS_OF_TERMS

    calibration, model = report.calibration, report.built.model
    lines = _head(report, f"{np.count_nonzero(report.solution.used)} rows of {len(model.channels)} channels")
    lines += requirement_lines(report.requirements)
    spread = _sizes(report)
    lines += ["", "the terms, at most over the temperatures:", table(spread, right=(1, 2))]
    if calibration.path:
        of_path: list[tuple[str, ...]] = [("beside the maps", "value", "1σ", "")]
        for one in calibration.path:
            unit, factor = UNITS_OF_TERMS.get(one.unit, (one.unit, 1.0))
            numbers = f"{one.value * factor:.4g}", f"{one.standard_deviation * factor:.2g}"
            of_path.append((f"{one.channel} {one.name}".replace("_", " "), *numbers, unit))
        lines += [table(of_path, right=(1, 2))]
    if report.internal:
        inside = [("between the axes", "value", "1σ", "")]
        inside += [(m.name, f"{m.value * 1e6:.2f}", f"{m.std * 1e6:.2g}", "µrad") for m in report.internal]
        lines += [table(inside, right=(1, 2))]
    if calibration.table:
        of_table: list[tuple[str, ...]] = [("error of the table", "value", "1σ", "known to", "")]
        for error in calibration.table:
            unit, factor = UNITS_OF_TERMS.get(error.unit, (error.unit, 1.0))
            numbers = (f"{v * factor:.4g}" for v in (error.value, error.standard_deviation, error.prior))
            of_table.append((error.name.replace("_", " "), *numbers, unit))
        lines += [table(of_table, right=(1, 2, 3))]
    lines += [_tests(report)]
    if report.gravity is not None:
        before, after = (1e6 * v / G for v in report.gravity)
        lines.append(f"|f| - g over the rests: {before:.4g} µg rms as measured, {after:.4g} µg corrected")
    return "\n".join([*lines, *(f"note: {message}" for message in report.messages)])


def _sizes(report: "UnitReport") -> list[tuple[str, ...]]:
    """The largest value of every channel's terms over temperature (and rate)."""
    from gradcal_jax.api.unit_residual import UNITS_OF_TERMS

    calibration = report.calibration
    low, high = (float(t) for t in calibration.valid_temperature)
    slow, fast = (float(r) for r in calibration.valid_rate)
    temperature, rate = (x.ravel() for x in np.meshgrid(np.linspace(low, high, 41), np.linspace(slow, fast, 21)))
    rows = [("term", "largest", "at 20 °C", "")]
    for channel in calibration.channel:
        for term in channel.term:
            unit, factor = UNITS_OF_TERMS.get(term.unit, (term.unit, 1.0))
            values = term_values(term, temperature, rate) * factor
            middle = term_values(term, np.array([np.clip(20.0, low, high)]), np.zeros(1))[0] * factor
            name = f"{channel.name} {term.name}".replace("_", " ")
            rows.append((name, f"{np.max(np.abs(values)):.5g}", f"{middle:.5g}", unit))
    return rows


def text_of_held(report: "HandReport") -> str:
    from gradcal_jax.api.contract_rows import deviations_of
    from gradcal_jax.api.unit_residual import UNITS_OF_TERMS

    calibration = report.calibration
    lines = _head(report, f"{len(report.solution.positions.duration)} positions, {report.solution.turns} turns")
    std = deviations_of(calibration.covariance)
    rows = [("parameter", "value", "1σ", "")]
    for channel in calibration.channel:
        gain = (report.solution.gyro if channel.kind == "gyro" else report.solution.accelerometer).gain
        for term in channel.term:
            unit, factor = UNITS_OF_TERMS[term.unit]
            add = 0.0
            if gain != 1.0 and term.name == "bias":
                unit, factor = "counts", 1.0
            elif gain != 1.0 and term.name == "scale_factor":
                unit, factor, add = "counts per " + ("rad/s" if channel.kind == "gyro" else "m/s^2"), 1.0, 1.0
            elif gain != 1.0:  # proportional to the gain
                factor /= gain
            for name, value in term.coefficients.items():
                known = std.get(f"{channel.name}.{name}")
                error = "not observable" if known is None else f"{known * factor:.3g}"
                what = f"{channel.name} {term.name}".replace("_", " ")
                rows.append((what, f"{value * factor + add:.6g}", error, unit))
    lines += ["", table(rows, right=(1, 2))]
    lines += ["", _tests(report)]
    lines.append(f"residual of |f| - g over the positions: {report.gravity_left / G * 1e6:.4g} µg rms")
    lines.append(f"residual of gravity's direction after the turns: {report.turns_left * 1e6:.4g} µrad rms")
    return "\n".join([*lines, *(f"note: {message}" for message in report.messages)])
