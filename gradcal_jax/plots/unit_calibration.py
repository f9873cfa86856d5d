"""Figures of a whole unit's estimate: terms over temperature, and residuals of the rows or of gravity."""

from itertools import pairwise

import numpy as np
from matplotlib.axes import Axes
from matplotlib.collections import PathCollection
from matplotlib.figure import Figure
from matplotlib.lines import Line2D

from gradcal_jax.api.hand_estimate import HandReport
from gradcal_jax.api.path_dependence import BiasCurve
from gradcal_jax.api.unit_estimate import UnitReport
from gradcal_jax.api.unit_residual import UNITS_OF_TERMS
from gradcal_jax.information import segments_of
from gradcal_jax.plots.calibration_maps import draw_calibrated_term, panels_of
from gradcal_jax.plots.style import PALETTE, new_axes
from gradcal_jax.units import G


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


def draw_loop(curve: BiasCurve, *, ax: Axes | None = None) -> tuple[Axes, list[Line2D]]:
    """The bias of a channel beyond its map over temperature, on every leg: measured, and the model with ± 2 standard
    deviations of it."""
    ax = new_axes(ax)
    unit, factor = UNITS_OF_TERMS[curve.si_unit]
    lines: list[Line2D] = []
    for first, end in legs_of(curve.temperature_c):
        own = slice(first, end)
        heats = curve.temperature_c[end - 1] > curve.temperature_c[first]
        at, colour = curve.temperature_c[own], PALETTE[1 if heats else 0]
        seen, fitted = ((v - curve.map)[own] * factor for v in (curve.measured, curve.model))
        std = curve.std[own] * factor
        lines += ax.plot(at, seen, ".", markersize=3, color=colour)
        dash = "-" if heats else "--"
        lines += ax.plot(at, fitted, dash, color=colour, label="heating" if heats else "cooling")
        ax.fill_between(at, fitted - 2.0 * std, fitted + 2.0 * std, alpha=0.15, color=colour)
    handles, labels = ax.get_legend_handles_labels()
    by_label = dict(zip(labels, handles, strict=True))
    ax.legend(by_label.values(), by_label.keys(), fontsize="small")
    ax.set(xlabel="temperature, °C", ylabel=unit, title=f"{curve.channel.replace('_', ' ')}: bias beyond its map")
    return ax, lines


def legs_of(temperature: np.ndarray) -> list[tuple[int, int]]:
    """Rows `first … end − 1` of every heating or cooling leg of more than a twentieth of the range."""
    least, legs = 0.05 * float(np.ptp(temperature)), [0]
    highest = lowest = 0
    # A leg ends where the temperature has returned by that from its extreme.
    way = 0
    for k, t in enumerate(temperature):
        highest, lowest = (k if t > temperature[highest] else highest), (k if t < temperature[lowest] else lowest)
        if way >= 0 and temperature[highest] - t > least:
            legs, way, lowest = [*legs, highest], -1, k
        elif way <= 0 and t - temperature[lowest] > least:
            legs, way, highest = [*legs, lowest], 1, k
    edges = [*legs, len(temperature) - 1]
    return [(a, b + 1) for a, b in pairwise(edges) if abs(temperature[b] - temperature[a]) >= least]


def draw_unit_estimate(report: UnitReport) -> Figure:
    """The terms of a calibration, the loops over temperature where it has any, and the residuals."""
    calibration = report.calibration
    panels = panels_of(calibration)
    loops = report.curves if report.path is not None or calibration.path else ()
    rows = (len(panels) + len(loops) + 1) // 2 + 1
    figure = Figure(figsize=(10.0, 3.2 * rows), layout="constrained")
    grid = figure.add_gridspec(rows, 2)
    for k, (kind, name) in enumerate(panels):
        draw_calibrated_term(calibration, kind, name, ax=figure.add_subplot(grid[k // 2, k % 2]))
    for k, curve in enumerate(loops, start=len(panels)):
        draw_loop(curve, ax=figure.add_subplot(grid[k // 2, k % 2]))
    draw_unit_residuals(report, ax=figure.add_subplot(grid[rows - 1, :]))
    simulated = ", SIMULATED" if calibration.simulated else ""
    figure.suptitle(f"calibration of {calibration.serial_number}{simulated}")
    return figure
