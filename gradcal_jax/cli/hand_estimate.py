"""What `gradcal estimate --gravity` says of a unit that was held and turned by hand."""

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

from gradcal_jax.cli.console import strong
from gradcal_jax.cli.output import as_json, save_figure
from gradcal_jax.cli.recordings import described
from gradcal_jax.cli.status import DONE, NOT_AS_WISHED
from gradcal_jax.cli.unit_estimate import write_calibrations
from gradcal_jax.pages.plain_text import columns as table

if TYPE_CHECKING:
    from gradcal_jax.api.hand_estimate import HandReport
    from gradcal_jax.files.log import Log


def estimate_of_held_units(
    log: "Log",
    name: str,
    gravity: float,
    units: Sequence[str],
    *,
    options: Mapping[str, Any],
    files: Mapping[str, Path],
    plot: Path | None,
    json: bool,
) -> int:
    """Estimate, print, write. The exit status: see `gradcal estimate`."""
    from gradcal_jax.api.estimate_options import Options
    from gradcal_jax.api.hand_estimate import estimate_by_hand, hand_estimate_rows

    sources = {"log": Path(name).name}
    reports = estimate_by_hand(log, gravity, units=units, options=Options(**options), sources=sources)
    if json:
        print(as_json({"units": [hand_estimate_rows(report) for report in reports]}))
    else:
        print("\n".join([described(log, name), *(_text(report) for report in reports)]))
    write_calibrations(reports, files, quiet=json)
    if plot is not None:
        from gradcal_jax.plots.unit_calibration import draw_by_hand

        save_figure(draw_by_hand(reports[0]), plot, quiet=json)
    return DONE if all(report.as_wished for report in reports) else NOT_AS_WISHED


def _text(report: "HandReport") -> str:
    import numpy as np

    from gradcal_jax.api.unit_residual import UNITS_OF_TERMS
    from gradcal_jax.units import G

    found = report.calibration
    lines = ["", strong(f"unit {report.unit}" + (", SIMULATED" if found.simulated else ""))]
    low, high = found.valid_temperature
    fastest = np.degrees(float(found.valid_rate[1]))
    count = len(report.found.positions.duration)
    lines.append(f"{count} positions, {report.found.turns} turns; covers {low} … {high}, up to {fastest:.4g} deg/s")
    lines.append(f"frame: {found.frame}")
    covariance = found.covariance
    assert covariance is not None
    std = {name: float(np.sqrt(covariance.matrix[k][k])) for k, name in enumerate(covariance.names)}
    rows = [("parameter", "value", "1σ", "")]
    for channel in found.channel:
        gain = (report.found.gyro if channel.kind == "gyro" else report.found.accelerometer).gain
        for term in channel.term:
            unit, factor = UNITS_OF_TERMS[term.unit]
            add = 0.0
            if gain != 1.0 and term.name == "bias":
                unit, factor = "counts", 1.0
            elif gain != 1.0 and term.name == "scale_factor":
                unit, factor, add = "counts per " + ("rad/s" if channel.kind == "gyro" else "m/s^2"), 1.0, 1.0
            elif gain != 1.0:  # in proportion to it
                factor /= gain
            for name, value in term.coefficients.items():
                known = std.get(f"{channel.name}.{name}")
                error = "not observable" if known is None else f"{known * factor:.3g}"
                what = f"{channel.name} {term.name}".replace("_", " ")
                rows.append((what, f"{value * factor + add:.6g}", error, unit))
    lines += ["", table(rows, right=(1, 2))]
    tests = [("test", "statistic", "degrees", "chance")]
    tests += [(t.name, f"{t.statistic:.1f}", str(t.degrees), f"{t.chance:.2g}") for t in found.fit]
    lines += ["", table(tests, right=(1, 2, 3))]
    lines.append(f"left of |f| - g over the positions: {report.gravity_left / G * 1e6:.4g} µg rms")
    lines.append(f"left of gravity's direction after the turns: {report.turns_left * 1e6:.4g} µrad rms")
    return "\n".join([*lines, *(f"note: {message}" for message in report.messages)])
