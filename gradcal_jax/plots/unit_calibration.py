"""Figures of a whole unit's estimate: terms over temperature, and residuals of the rows or of gravity."""

import numpy as np
from matplotlib.axes import Axes
from matplotlib.collections import PathCollection
from matplotlib.figure import Figure
from matplotlib.lines import Line2D

from gradcal_jax.api.hand_estimate import HandReport
from gradcal_jax.api.unit_estimate import UnitReport
from gradcal_jax.api.unit_residual import UNITS_OF_TERMS
from gradcal_jax.files.unit_calibration import CalibratedTerm, UnitCalibration
from gradcal_jax.files.unit_correction import term_values
from gradcal_jax.information import segments_of
from gradcal_jax.model import AXIS_NAMES
from gradcal_jax.plots.style import PALETTE, draw_band, new_axes
from gradcal_jax.units import G

_POINTS = 81
# Kind, term and title of the panels, in order.
_PANELS = (
    ("gyro", "bias", "gyro bias"),
    ("gyro", "scale_factor", "gyro scale factor, slowly turned"),
    ("accelerometer", "bias", "accelerometer bias"),
    ("accelerometer", "scale_factor", "accelerometer scale factor"),
)


def panels_of(calibration: UnitCalibration) -> list[tuple[str, str, str]]:
    """Kind, term and title of the panels of a calibration."""
    return [
        panel
        for panel in _PANELS
        if any(c.kind == panel[0] and c.term_of(panel[1]) is not None for c in calibration.channel)
    ]


def draw_unit_term(
    calibration: UnitCalibration, kind: str, name: str, title: str = "", *, ax: Axes | None = None
) -> tuple[Axes, list[Line2D]]:
    """A term of all channels of a kind over temperature, each with a band of ± 1σ."""
    ax = new_axes(ax)
    low, high = (float(t) for t in calibration.valid_temperature)
    temperature, lines, unit = np.linspace(low, high, _POINTS), [], ""
    for axis in AXIS_NAMES:
        channel = calibration.channel_of(kind, axis)
        term = None if channel is None else channel.term_of(name)
        if channel is None or term is None:
            continue
        unit, factor = UNITS_OF_TERMS.get(term.unit, (term.unit, 1.0))
        value = term_values(term, temperature, np.zeros(_POINTS)) * factor
        std = _deviation(calibration, channel.name, term, temperature) * factor
        index = AXIS_NAMES.index(axis)
        lines.append(draw_band(ax, temperature, value, std, index, axis))
    ax.set(xlabel="temperature, °C", ylabel=f"value ± 1σ, {unit}", title=title or f"{kind} {name}".replace("_", " "))
    ax.legend(title="axis")
    return ax, lines


def _deviation(calibration: UnitCalibration, channel: str, term: CalibratedTerm, temperature: np.ndarray) -> np.ndarray:
    """Standard deviation of a term's map; 0 for a file without covariance, NaN for a term without it."""
    if calibration.covariance is None:
        return np.zeros(len(temperature))
    names = [f"{channel}.{name}" for name in term.coefficients]
    place = {name: k for k, name in enumerate(calibration.covariance.names)}
    if any(name not in place for name in names):
        return np.full(len(temperature), np.nan)
    where = [place[name] for name in names]
    block = np.array(calibration.covariance.matrix)[np.ix_(where, where)]
    each = [
        term.model_copy(update={"coefficients": {n: float(n == name) for n in term.coefficients}})
        for name in term.coefficients
    ]
    functions = np.stack([term_values(one, temperature, np.zeros(len(temperature))) for one in each], axis=1)
    return np.sqrt(np.einsum("ti,ij,tj->t", functions, block, functions))


def draw_unit_residuals(report: UnitReport, *, ax: Axes | None = None) -> tuple[Axes, list[PathCollection]]:
    """Whitened residuals of every channel over time; nearly all lie within ± 3."""
    ax = new_axes(ax)
    at = segments_of(report.executed.motion, report.built.model)
    line = report.executed.motion.line
    time = (line.start + line.duration)[at.last][at.row_segment][report.solution.used] / 3600.0
    channel = at.row_channel[report.solution.used]
    drawn = []
    for k, c in enumerate(report.built.model.channels):
        own = channel == k
        residual = report.solution.estimate.residuals[0][own]
        marker = "o" if c.kind == "gyro" else "^"
        name = c.name.replace("_", " ")
        drawn.append(
            ax.scatter(time[own], residual, s=6, marker=marker, color=PALETTE[k % 6], label=name, rasterized=True)
        )
    for level in (-3.0, 3.0):
        ax.axhline(level, color="black", linewidth=0.7, linestyle=":")
    ax.set(xlabel="time, h", ylabel="whitened residual, σ", title="residuals of the rows")
    ax.legend(ncols=2, fontsize="small")
    return ax, drawn


def draw_gravity_left(report: HandReport, *, ax: Axes | None = None) -> tuple[Axes, PathCollection]:
    """|f| − g over each position, µg."""
    ax = new_axes(ax)
    left = report.solution.accelerometer.left / G * 1e6
    drawn = ax.scatter(np.arange(1, len(left) + 1), left, s=14, color=PALETTE[0])
    ax.axhline(0.0, color="black", linewidth=0.7)
    title = f"the norm of gravity: {np.sqrt(np.mean(left**2)):.3g} µg rms"
    ax.set(xlabel="position", ylabel="|f| - g, µg", title=title)
    return ax, drawn


def draw_turns_left(report: HandReport, *, ax: Axes | None = None) -> tuple[Axes, list[PathCollection]]:
    """The error of gravity's direction after each turn, in two directions across it, mrad."""
    ax = new_axes(ax)
    left = 1e3 * report.solution.gyro.left.reshape(-1, 2)
    number = np.arange(1, len(left) + 1)
    drawn = [ax.scatter(number, left[:, k], s=14, marker="o^"[k], color=PALETTE[k + 1]) for k in range(2)]
    ax.axhline(0.0, color="black", linewidth=0.7)
    rms = np.sqrt(np.mean(left**2))
    ax.set(xlabel="turn", ylabel="error of direction, mrad", title=f"gravity turned by the gyros: {rms:.3g} mrad rms")
    return ax, drawn


def draw_by_hand(report: HandReport) -> Figure:
    """The residuals of gravity's norm, and of its direction after turns."""
    figure = Figure(figsize=(9.0, 3.4), layout="constrained")
    first, second = figure.subplots(1, 2)
    draw_gravity_left(report, ax=first)
    draw_turns_left(report, ax=second)
    figure.suptitle(f"unit {report.unit}" + (", SIMULATED" if report.calibration.simulated else ""))
    return figure


def draw_unit_estimate(report: UnitReport) -> Figure:
    """The terms of a calibration, and the residuals."""
    calibration = report.calibration
    panels = panels_of(calibration)
    rows = (len(panels) + 1) // 2 + 1
    figure = Figure(figsize=(10.0, 3.2 * rows), layout="constrained")
    grid = figure.add_gridspec(rows, 2)
    for k, (kind, name, title) in enumerate(panels):
        draw_unit_term(calibration, kind, name, title, ax=figure.add_subplot(grid[k // 2, k % 2]))
    draw_unit_residuals(report, ax=figure.add_subplot(grid[rows - 1, :]))
    simulated = ", SIMULATED" if calibration.simulated else ""
    figure.suptitle(f"calibration of {calibration.serial_number}{simulated}")
    return figure
