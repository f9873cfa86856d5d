"""Picture of a unit that was held and turned by hand: what is left of gravity, from position to position."""

import numpy as np
from matplotlib.axes import Axes
from matplotlib.collections import PathCollection
from matplotlib.figure import Figure

from gradcal_jax.api.hand_estimate import HandReport
from gradcal_jax.plots.style import PALETTE, new_axes
from gradcal_jax.units import G


def draw_gravity_left(report: HandReport, *, ax: Axes | None = None) -> tuple[Axes, PathCollection]:
    """|f| − g over each position, µg."""
    ax = new_axes(ax)
    left = report.found.accelerometer.left / G * 1e6
    drawn = ax.scatter(np.arange(1, len(left) + 1), left, s=14, color=PALETTE[0])
    ax.axhline(0.0, color="black", linewidth=0.7)
    ax.set(
        xlabel="position", ylabel="|f| - g, µg", title=f"the norm of gravity: {np.sqrt(np.mean(left**2)):.3g} µg rms"
    )
    return ax, drawn


def draw_turns_left(report: HandReport, *, ax: Axes | None = None) -> tuple[Axes, list[PathCollection]]:
    """By how much gravity's direction is missed after each turn, in two directions across it, mrad."""
    ax = new_axes(ax)
    left = 1e3 * report.found.gyro.left.reshape(-1, 2)
    number = np.arange(1, len(left) + 1)
    drawn = [ax.scatter(number, left[:, k], s=14, marker="o^"[k], color=PALETTE[k + 1]) for k in range(2)]
    ax.axhline(0.0, color="black", linewidth=0.7)
    rms = np.sqrt(np.mean(left**2))
    ax.set(xlabel="turn", ylabel="direction missed, mrad", title=f"gravity turned by the gyros: {rms:.3g} mrad rms")
    return ax, drawn


def draw_by_hand(report: HandReport) -> Figure:
    """Both."""
    figure = Figure(figsize=(9.0, 3.4), layout="constrained")
    first, second = figure.subplots(1, 2)
    draw_gravity_left(report, ax=first)
    draw_turns_left(report, ax=second)
    figure.suptitle(f"unit {report.unit}" + (", SIMULATED" if report.calibration.simulated else ""))
    return figure
