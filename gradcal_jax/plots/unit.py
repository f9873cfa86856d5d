"""Figures of a whole unit's plan: the residuals of every quantity, and the poses at rest."""

import numpy as np
from matplotlib.axes import Axes
from matplotlib.collections import PathCollection
from matplotlib.figure import Figure

from gradcal_jax.api.unit_build import assemble_unit, rest_poses
from gradcal_jax.api.unit_residual import UnitResidual
from gradcal_jax.files.requirement import GyroScaleFactorRequirement, UnitRequirement
from gradcal_jax.files.unit_spec import UnitSpec
from gradcal_jax.plots.style import COLOUR_MAP, from_zero, new_axes, style_of


def draw_unit_residual(requirement: UnitRequirement, residual: UnitResidual, *, ax: Axes | None = None) -> Axes:
    """The residual of each element of a requirement's quantity over temperature or, for the scale factor, over rate."""
    ax = new_axes(ax)
    by_rate = isinstance(requirement, GyroScaleFactorRequirement)
    for i, (label, values) in enumerate(zip(residual.labels, residual.values, strict=True)):
        across = np.degrees(residual.rates) if by_rate else residual.temperatures
        shown = np.max(values, axis=0) if by_rate else values[:, 0]
        ax.plot(across, np.where(np.isfinite(shown), shown, np.nan), label=label, **style_of(i))
    if requirement.target is not None:
        target = float(requirement.target) * residual.si
        ax.axhline(target, color="black", linewidth=0.8, linestyle=":")
        ax.annotate("target", (0.01, target), xycoords=("axes fraction", "data"), va="bottom", fontsize=8)
    what = "largest over temperature, " if by_rate else ""
    xlabel = "rate, deg/s" if by_rate else "temperature, °C"
    ax.set(xlabel=xlabel, ylabel=f"{what}1σ, {residual.unit}", title=requirement.name)
    from_zero(ax)
    ax.set_ylim(top=1.08 * ax.get_ylim()[1])
    if len(residual.labels) > 1:
        ax.legend(fontsize=8, ncols=3)
    return ax


def draw_poses(spec: UnitSpec, *, ax: Axes | None = None) -> tuple[Axes, PathCollection]:
    """The vertical in the unit's frame at every rest: longitude about its z axis, colour by time, area by duration."""
    if ax is None:
        ax = Figure(figsize=(6.4, 3.6), layout="constrained").add_subplot(projection="mollweide")
    poses = rest_poses(assemble_unit(spec))
    up = poses.up
    longitude, latitude = np.arctan2(up[:, 1], up[:, 0]), np.arcsin(np.clip(up[:, 2], -1.0, 1.0))
    # Points of one direction are slightly spread in order of time, so that none hides all others.
    order = np.argsort(poses.start)
    turn = np.linspace(0.0, 12.0 * np.pi, len(order))
    spread = 0.06 * np.linspace(0.2, 1.0, len(order))
    inside = np.clip(latitude[order] + spread * np.sin(turn), -1.5, 1.5)
    dots = ax.scatter(
        longitude[order] + spread * np.cos(turn) * (np.abs(latitude[order]) < 1.5),
        inside,
        s=4.0 + 1.5 * np.sqrt(poses.duration[order]),
        c=poses.start[order] / 60.0,
        cmap=COLOUR_MAP,
        linewidths=0.0,
        alpha=0.7,
    )
    names = {"+x": (0.0, 0.0), "+y": (np.pi / 2, 0.0), "−y": (-np.pi / 2, 0.0), "+z": (0.0, 1.45), "−z": (0.0, -1.45)}
    for name, place in names.items():
        # Inside the map: the title is above the upper pole.
        ax.annotate(name, place, xytext=(5, -11 if name == "+z" else 6), textcoords="offset points", fontsize=8)
    ax.figure.colorbar(dots, ax=ax, label="time, min", shrink=0.7)
    ax.set_title("which way is up, seen from the unit, at rest", pad=14.0)
    ax.set_xticklabels([])
    ax.grid(visible=True, linewidth=0.4)
    return ax, dots
