"""Maps of a calibration file with one standard deviation, and its residuals."""

import numpy as np
from matplotlib.axes import Axes
from matplotlib.lines import Line2D

from gradcal_jax.calibration.file import CalibratedChannel, Calibration
from gradcal_jax.estimation.calibrations import calibration_map, grid_of
from gradcal_jax.plots.style import PALETTE, draw_band, new_axes, style_of


def panels_of(calibration: Calibration) -> list[tuple[str, str]]:
    """The biases and scale factors of a calibration, by kind of channel, for `draw_calibrated_term`."""
    found = {(c.kind, t.name): None for c in calibration.channel for t in c.term if t.name in ("bias", "scale_factor")}
    return sorted(found, key=lambda panel: (panel[0] != "gyro", panel[1]))


def draw_calibrated_term(
    calibration: Calibration, kind: str, name: str, *, ax: Axes | None = None
) -> tuple[Axes, list[Line2D]]:
    """One term of all gyros, or of all accelerometers, over temperature at a low rate, each with a band of ± 1σ."""
    ax = new_axes(ax)
    lines: list[Line2D] = []
    unit = ""
    for channel in calibration.channel:
        if channel.kind == kind and channel.term_of(name) is not None:
            temperatures, _ = grid_of(channel, name)
            value, std = calibration_map(calibration, channel, name, temperatures, np.zeros(1))
            unit, number = value.unit, len(lines)
            lines.append(draw_band(ax, temperatures, value.values[:, 0], std.values[:, 0], number, channel.axis))
    ax.set(xlabel="temperature, °C", ylabel=f"{kind} {name.replace('_', ' ')} ± 1σ, {unit}")
    if len(lines) > 1:
        ax.legend(title="axis")
    return ax, lines


def draw_calibrated_scale_factor(
    calibration: Calibration, channel: CalibratedChannel, *, ax: Axes | None = None
) -> tuple[Axes, list[Line2D]]:
    """The scale-factor map over rate, at the lowest, the middle and the highest temperature that the data cover."""
    ax = new_axes(ax)
    temperatures, rates = grid_of(channel, "scale_factor")
    chosen = temperatures[[0, len(temperatures) // 2, -1]]
    value, deviation = calibration_map(calibration, channel, "scale_factor", chosen, rates)
    lines: list[Line2D] = []
    for index, temperature in enumerate(chosen):
        label = f"{temperature:.4g} °C".replace("-", "−")
        lines.append(draw_band(ax, rates, value.values[index], deviation.values[index], index, label, alpha=0.25))
    ax.set(xlabel="rate, deg/s", ylabel="scale-factor error M ± 1σ, ppm")
    ax.legend()
    return ax, lines


def draw_residuals(channel: CalibratedChannel, *, ax: Axes | None = None) -> tuple[Axes, Line2D]:
    """The histogram of whitened residuals, beside the normal distribution of a true model."""
    ax = new_axes(ax)
    assert channel.residuals is not None
    counts, edges = np.array(channel.residuals.counts), np.arange(-4.5, 4.75, 0.5)
    ax.bar(edges[:-1], counts, width=0.5, align="edge", color=PALETTE[0], alpha=0.6, label="residuals")
    x = np.linspace(-4.5, 4.5, 181)
    normal = 0.5 * counts.sum() * np.exp(-0.5 * x**2) / np.sqrt(2.0 * np.pi)
    (line,) = ax.plot(x, normal, label="normal", **style_of(1))
    ax.set(xlabel="residual in standard deviations (ends: all beyond 4)", ylabel="readings")
    ax.legend()
    return ax, line
