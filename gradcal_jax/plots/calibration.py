"""Estimated calibrations: the maps with their uncertainty, and the residuals of the readings."""

import numpy as np
from matplotlib.axes import Axes
from matplotlib.collections import PathCollection
from matplotlib.figure import Figure
from matplotlib.lines import Line2D

from gradcal_jax.api.calibration import EstimateReport
from gradcal_jax.api.posterior_of_plan import DEG_PER_H, DEG_PER_S, PPM
from gradcal_jax.api.unit_channel import UnitChannel
from gradcal_jax.information import contrasts
from gradcal_jax.plots.style import PALETTE, draw_band, new_axes, new_panels

_MOST_PANELS = 12


def draw_scale_factor(channel: UnitChannel, *, ax: Axes | None = None) -> tuple[Axes, list[Line2D]]:
    """M over rate at the coldest, the middle and the warmest temperature of the data, with one standard deviation."""
    ax = new_axes(ax)
    low, high = channel.valid_temperature_c
    slow, fast = channel.valid_rate_rad_per_s
    rates = np.linspace(slow, fast, 121)
    lines: list[Line2D] = []
    for index, temperature in enumerate(dict.fromkeys((low, 0.5 * (low + high), high))):
        value, std = _map(channel, "scale_factor", np.full_like(rates, temperature), rates)
        lines.append(draw_band(ax, rates * DEG_PER_S, value * PPM, std * PPM, index, f"{temperature:.4g} °C"))
    ax.set(xlabel="rate, deg/s", ylabel="scale-factor error M ± 1σ, ppm", title=_name(channel))
    ax.legend()
    return ax, lines


def draw_bias(channel: UnitChannel, *, ax: Axes | None = None) -> tuple[Axes, Line2D]:
    """B over temperature, with one standard deviation."""
    ax = new_axes(ax)
    temperature = np.linspace(*channel.valid_temperature_c, 121)
    value, std = _map(channel, "bias", temperature, np.zeros_like(temperature))
    line = draw_band(ax, temperature, value * DEG_PER_H, std * DEG_PER_H, 0)
    ax.set(xlabel="temperature, °C", ylabel="bias B ± 1σ, deg/h", title=_name(channel))
    return ax, line


def draw_innovations(channel: UnitChannel, *, ax: Axes | None = None) -> tuple[Axes, PathCollection]:
    """Normalised innovations over time; those of reduced weight are marked."""
    ax = new_axes(ax)
    used = channel.observations.used
    time = channel.observations.time_s[used] / 3600.0
    residual = channel.estimate.residuals[0]
    points = ax.scatter(time, residual, s=4, color=PALETTE[0], rasterized=True)
    low = channel.weights < 1.0
    if low.any():
        ax.scatter(time[low], residual[low], s=30, marker="x", color=PALETTE[1], label="reduced weight")
        ax.legend()
    for level in (-3.0, 3.0):
        ax.axhline(level, color="black", linewidth=0.7, linestyle=":")
    ax.set(xlabel="time, h", ylabel="normalised innovation, σ", title=_name(channel))
    return ax, points


def draw_estimate(report: EstimateReport) -> Figure:
    """A row for each channel: its maps and its residuals (the first channels, where there are very many)."""
    shown = report.channels[:_MOST_PANELS]
    width = 1 + max((c.model.bias is not None) + (c.model.scale is not None) for c in shown)
    figure, panels = new_panels(len(shown), width, (5.2, 3.8))
    for axes, channel in zip(panels, shown, strict=True):
        places = list(axes)
        if channel.model.bias is not None:
            draw_bias(channel, ax=places.pop(0))
        if channel.model.scale is not None:
            draw_scale_factor(channel, ax=places.pop(0))
        draw_innovations(channel, ax=places.pop(0))
        for left in places:
            left.remove()
    return figure


def _map(channel: UnitChannel, quantity, temperature: np.ndarray, rate: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    both, outside, _ = contrasts(channel.model, quantity, temperature, rate)
    rows = both - outside  # the discrepancy is not part of the calibration
    std = channel.estimate.known[0].deviations(rows)
    return rows @ channel.estimate.parameters[0], np.where(np.isfinite(std), std, np.nan)


def _name(channel: UnitChannel) -> str:
    return f"axis {channel.axis}, unit {channel.unit}"
