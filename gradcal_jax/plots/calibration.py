"""Figures of estimates: terms over temperature and rate, and residuals of the rows or of gravity."""

import numpy as np
from matplotlib.axes import Axes
from matplotlib.collections import PathCollection
from matplotlib.figure import Figure, SubFigure

from gradcal_jax.calibration import CalibratedChannel, Calibration
from gradcal_jax.estimation.estimate import EstimateReport, SensorEstimate
from gradcal_jax.estimation.hand_estimate import HandReport
from gradcal_jax.information import segments_of
from gradcal_jax.plots.calibration_maps import draw_calibrated_scale_factor, draw_calibrated_term, panels_of
from gradcal_jax.plots.style import PALETTE, new_axes
from gradcal_jax.units import G

_MOST_SENSORS = 12


def draw_residuals_over_time(report: SensorEstimate, *, ax: Axes | None = None) -> tuple[Axes, list[PathCollection]]:
    """Whitened residuals of every channel over time: if the model is right, nearly all are within ± 3. Readings with a
    reduced weight are marked."""
    ax = new_axes(ax)
    at = segments_of(report.executed.motion, report.built.model)
    line = report.executed.motion.line
    time = (line.start + line.duration)[at.last][at.row_segment][report.solution.used] / 3600.0
    channel = at.row_channel[report.solution.used]
    drawn = []
    for k, c in enumerate(report.built.model.channels):
        own = channel == k
        residual = report.solution.residuals[own]
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


def draw_by_hand(report: HandReport) -> Figure:
    """|f| − g of each position, and the error of gravity's direction after each turn, in the two directions
    perpendicular to gravity."""
    figure = Figure(figsize=(9.0, 3.4), layout="constrained")
    sizes = report.solution.left[0][:, None] / G * 1e6
    turns = 1e3 * report.solution.left[1].reshape(-1, 2)
    panels = (("position", "|f| - g", "µg", sizes), ("turn", "direction of gravity", "mrad", turns))
    for ax, (each, what, unit, left) in zip(figure.subplots(1, 2), panels, strict=True):
        for k in range(left.shape[1]):
            ax.scatter(np.arange(1, len(left) + 1), left[:, k], s=14, marker="o^"[k], color=PALETTE[k])
        ax.axhline(0.0, color="black", linewidth=0.7)
        rms = np.sqrt(np.mean(left**2))
        ax.set(xlabel=each, ylabel=f"error, {unit}", title=f"{what}: {rms:.3g} {unit} rms")
    figure.suptitle(f"unit {report.unit}" + (", SIMULATED" if report.calibration.simulated else ""))
    return figure


def draw_warm_up(calibration: Calibration) -> Figure:
    """The bias of each kind of channel over temperature."""
    panels = panels_of(calibration)
    figure = Figure(figsize=(4.5 * len(panels), 3.4), layout="constrained")
    for (kind, name), ax in zip(panels, figure.subplots(1, len(panels), squeeze=False)[0], strict=True):
        draw_calibrated_term(calibration, kind, name, ax=ax)
    figure.suptitle(f"IMU {calibration.serial_number}" + (", SIMULATED" if calibration.simulated else ""))
    return figure


def draw_estimate(report: EstimateReport) -> Figure:
    """A part for each sensor (the first ones, where there are very many): the terms of its calibration, and the
    residuals."""
    shown = report.sensors[:_MOST_SENSORS]
    rows = [_rows_of(one) for one in shown]
    figure = Figure(figsize=(10.0, 3.2 * sum(rows)), layout="constrained")
    parts = figure.subfigures(len(shown), 1, squeeze=False, height_ratios=rows)[:, 0]
    for part, one in zip(parts, shown, strict=True):
        _draw_sensor(one, part)
    return figure


def _over_rate(calibration: Calibration) -> list[CalibratedChannel]:
    """The channels whose scale factor depends on the rate."""
    scales = ((channel, channel.term_of("scale_factor")) for channel in calibration.channel)
    return [channel for channel, term in scales if term is not None and term.rate is not None]


def _rows_of(report: SensorEstimate) -> int:
    """Rows of panels, two in each, and one of the residuals."""
    calibration = report.calibration
    return (len(panels_of(calibration)) + len(_over_rate(calibration)) + 1) // 2 + 1


def _draw_sensor(report: SensorEstimate, figure: SubFigure) -> None:
    calibration, rows = report.calibration, _rows_of(report)
    grid = figure.add_gridspec(rows, 2)
    places = iter(grid[k // 2, k % 2] for k in range(2 * rows - 2))
    for kind, name in panels_of(calibration):
        draw_calibrated_term(calibration, kind, name, ax=figure.add_subplot(next(places)))
    for channel in _over_rate(calibration):
        ax, _ = draw_calibrated_scale_factor(calibration, channel, ax=figure.add_subplot(next(places)))
        ax.set_title(channel.label)
    draw_residuals_over_time(report, ax=figure.add_subplot(grid[rows - 1, :]))
    simulated = ", SIMULATED" if calibration.simulated else ""
    figure.suptitle(f"calibration of {calibration.serial_number}{simulated}")
