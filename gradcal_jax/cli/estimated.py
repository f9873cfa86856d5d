"""Results of `gradcal estimate` as text: of a log with a spec, or of an IMU turned by hand (`--gravity`)."""

import math
from collections.abc import Sequence
from typing import TYPE_CHECKING

from gradcal_jax.cli.console import strong
from gradcal_jax.pages.plain_text import columns as table
from gradcal_jax.units import PPM, G

if TYPE_CHECKING:
    from gradcal_jax.api.contradictions import MeasuredDiscrepancy
    from gradcal_jax.api.estimate import SensorEstimate
    from gradcal_jax.api.hand_estimate import HandReport
    from gradcal_jax.estimation import Group
    from gradcal_jax.files.contracts import RequirementRow

# More coefficients than these are read in the file.
_MOST_COEFFICIENTS = 30


def _head(report: "SensorEstimate | HandReport", counted: str) -> list[str]:
    calibration = report.calibration
    low, high = calibration.valid_temperature
    fastest = math.degrees(float(calibration.valid_rate[1]))
    return [
        "",
        strong(f"unit {report.unit}" + (", SIMULATED" if calibration.simulated else "")),
        f"{counted}; covers {low} … {high}, up to {fastest:.4g} deg/s",
        f"frame: {calibration.frame}",
    ]


def _tests(report: "SensorEstimate | HandReport") -> str:
    rows = [("test", "statistic", "degrees", "chance")]
    for test in report.calibration.fit:
        name = test.name.replace("_", " ")
        rows.append((name, f"{test.statistic:.1f}", str(test.degrees), f"{test.chance:.2g}"))
    return table(rows, right=(1, 2, 3))


def requirement_lines(rows: "Sequence[RequirementRow]") -> list[str]:
    """The requirements as an estimate meets them, and the rules of their verdicts."""
    names = [f"{row.name}, {row.limited_by or f'axis {row.axis}'}" for row in rows]
    from gradcal_jax.files.requirement_table import requirement_table

    shown = requirement_table(rows, names)
    return ["", table(shown, indent=""), *(f"{n}: {row.rule}" for n, row in zip(names, rows, strict=True) if row.rule)]


def text_of_estimate(report: "SensorEstimate") -> str:
    from gradcal_jax.api.imu_residual import UNITS_OF_TERMS
    from gradcal_jax.model import SCALE_FACTOR
    from gradcal_jax.pages.coefficients import estimated_coefficients

    calibration, model = report.calibration, report.built.model
    readings, channels = len(report.solution.weights), len(model.channels)
    counted = f"{readings} readings" + (f" of {channels} channels" if channels > 1 else "")
    lines = _head(report, counted)
    lines.append("rows: " + ", ".join(f"{count} {reason}" for reason, count in report.counts.items()))
    lines += requirement_lines(report.requirements)
    if len(calibration.values()) <= _MOST_COEFFICIENTS:
        rows, right = estimated_coefficients(calibration)
        lines += ["", table(rows, right=right)]
    if report.smoothness is not None:
        stds = (
            (f"{channel} {name}".replace("_", " "), std, *UNITS_OF_TERMS["1" if name == SCALE_FACTOR else "rad/s"])
            for (channel, name), std in report.smoothness.stds.items()
        )
        words = ", ".join(f"{name} {std * factor:.3g} {unit}" for name, std, unit, factor in stds)
        lines.append(f"smoothness (1σ of neighbours' differences): {words}")
    spread = _sizes(report)
    lines += ["", "the largest value of each term over the temperatures:", table(spread, right=(1, 2))]
    if calibration.path:
        of_path: list[tuple[str, ...]] = [("in addition to the maps", "value", "1σ", "")]
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
    tests = report.consistency
    lines += [
        _tests(report),
        f"  residuals are {tests.noise_scale:.3f} times the noise of the spec; {tests.beyond_three:.2%} beyond "
        f"3σ, the largest {tests.largest:.1f}σ",
    ]
    lines += [_neighbours(name, groups) for name, groups in report.neighbours.items()]
    if report.gravity is not None:
        before, after = (1e6 * v / G for v in report.gravity)
        lines.append(f"|f| - g over the rests: {before:.4g} µg rms as measured, {after:.4g} µg corrected")
    return "\n".join([*lines, *(f"note: {message}" for message in report.messages)])


def _neighbours(channel: str, groups: "Sequence[Group]") -> str:
    shown = [(channel.replace("_", " "), "mean rate", "moves", "without a map", "1σ", "the map", "unit")]
    for g in groups:
        where = (f"{g.temperature_c:.1f} °C", f"{math.degrees(g.rate_rad_per_s):.4g} deg/s", str(g.moves))
        error = "" if g.standard_error is None else f"{g.standard_error * PPM:.3g}"
        shown.append((*where, f"{g.scale_factor * PPM:.5g}", error, f"{g.of_map * PPM:.5g}", "ppm"))
    return table(shown, right=(1, 2, 3, 4, 5))


def discrepancy_lines(row: "MeasuredDiscrepancy") -> list[str]:
    """The size of a measured discrepancy, and its table for a spec."""
    several = f", {row.units} IMUs together" if row.units > 1 else ""
    high = "∞" if row.high is None else f"{row.high:.3g}"
    heading = (
        f"discrepancy of the {row.quantity.replace('_', ' ')}, axis {row.axis}{several}: {row.standard_deviation:.3g} "
        f"{row.unit} (95 % interval {row.low:.3g} … {high})"
    )
    return ["", heading, *([f"  {line}" for line in row.block.splitlines()] if row.low > 0.0 else [])]


def _sizes(report: "SensorEstimate") -> list[tuple[str, ...]]:
    """The largest value of every channel's terms over temperature (and rate)."""
    # Imported where they are used: the help of all commands imports this.
    import numpy as np

    from gradcal_jax.api.imu_residual import UNITS_OF_TERMS
    from gradcal_jax.files.calibration.correction import term_values

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
    from gradcal_jax.api.imu_residual import UNITS_OF_TERMS

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
