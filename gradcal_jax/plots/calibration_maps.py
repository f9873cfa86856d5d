"""Maps of a calibration file with one standard deviation, and its residuals."""

import numpy as np
from matplotlib.axes import Axes
from matplotlib.lines import Line2D

from gradcal_jax.api.ieee_terms import calibration_map, grid_of
from gradcal_jax.files.calibration import AxisCalibration
from gradcal_jax.plots.style import PALETTE, draw_band, new_axes, style_of


def draw_calibrated_scale_factor(axis: AxisCalibration, *, ax: Axes | None = None) -> tuple[Axes, list[Line2D]]:
    """M over rate at the coldest, the middle and the warmest temperature that the data cover."""
    ax = new_axes(ax)
    temperatures, rates = grid_of(axis, None, "scale_factor")
    chosen = temperatures[[0, len(temperatures) // 2, -1]]
    value, deviation = calibration_map(axis, "scale_factor", chosen, rates)
    lines: list[Line2D] = []
    for index, temperature in enumerate(chosen):
        label = f"{temperature:.4g} °C".replace("-", "−")
        lines.append(draw_band(ax, rates, value.values[index], deviation.values[index], index, label, alpha=0.25))
    ax.set(xlabel="rate, deg/s", ylabel="scale-factor error M ± 1σ, ppm")
    ax.legend()
    return ax, lines


def draw_calibrated_bias(axis: AxisCalibration, *, ax: Axes | None = None) -> tuple[Axes, Line2D]:
    """B over temperature."""
    ax = new_axes(ax)
    value, deviation = calibration_map(axis, "bias", *grid_of(axis, None, "bias"))
    line = draw_band(ax, value.temperature_c, value.values[:, 0], deviation.values[:, 0], 0, alpha=0.25)
    ax.set(xlabel="temperature, °C", ylabel="bias B ± 1σ, deg/h")
    return ax, line


def draw_residuals(axis: AxisCalibration, *, ax: Axes | None = None) -> tuple[Axes, Line2D]:
    """The histogram of whitened residuals, beside the normal distribution of a true model."""
    ax = new_axes(ax)
    assert axis.residuals is not None
    counts, edges = np.array(axis.residuals.counts), np.arange(-4.5, 4.75, 0.5)
    ax.bar(edges[:-1], counts, width=0.5, align="edge", color=PALETTE[0], alpha=0.6, label="residuals")
    x = np.linspace(-4.5, 4.5, 181)
    normal = 0.5 * counts.sum() * np.exp(-0.5 * x**2) / np.sqrt(2.0 * np.pi)
    (line,) = ax.plot(x, normal, label="normal", **style_of(1))
    ax.set(xlabel="residual in standard deviations (ends: all beyond 4)", ylabel="readings")
    ax.legend()
    return ax, line


def draw_residual_parts(axis: AxisCalibration, *, ax: Axes | None = None) -> tuple[Axes, Line2D]:
    """The rms of the residuals in each tenth of the run, and the 95 % band of a true model."""
    ax = new_axes(ax)
    assert axis.residuals is not None
    rms = np.array(axis.residuals.rms)
    (line,) = ax.plot(np.arange(1, len(rms) + 1), rms, marker="o", **style_of(0))
    half = 1.96 / np.sqrt(2.0 * sum(axis.residuals.counts) / len(rms))
    ax.axhspan(1.0 - half, 1.0 + half, color=PALETTE[1], alpha=0.2)
    ax.set(xlabel="tenth of the run", ylabel="rms residual, standard deviations", ylim=(0.0, None))
    return ax, line
