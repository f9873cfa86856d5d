"""Figures of specs: the residuals of plans, the temperature, and the poses at rest."""

from collections.abc import Sequence

import numpy as np
from matplotlib.axes import Axes
from matplotlib.collections import PathCollection
from matplotlib.figure import Figure, SubFigure
from matplotlib.lines import Line2D

from gradcal_jax.estimation.calibrations import Box
from gradcal_jax.information.plan_information import rest_poses
from gradcal_jax.information.prediction import judged_plan
from gradcal_jax.information.residual import residual_map
from gradcal_jax.information.verdicts import run_of, target_of
from gradcal_jax.model.build import build_imu
from gradcal_jax.plots.residual import boxes_of, draw_curves
from gradcal_jax.plots.style import COLOUR_MAP, new_axes, new_panels, style_of
from gradcal_jax.spec.schedule import StandardSchedule
from gradcal_jax.spec.spec_sections import Spec


def draw_comparison(specs: Sequence[tuple[str, Spec]], *, figure: Figure | SubFigure | None = None) -> Figure:
    """Plans side by side, on `figure` or a new one: a panel for each requirement, with a curve for each plan and each
    element (such as an axis), as the verdict counts it, and the target of a single plan. Errors: `ValueError` without
    requirements."""
    found: dict[tuple[str, str], list[tuple[str, Box]]] = {}
    targets: dict[tuple[str, str], float | None] = {}
    for label, spec in specs:
        budget = judged_plan(spec).budget
        for requirement in spec.requirement:
            key, target = (requirement.name, requirement.quantity), target_of(requirement)
            left = residual_map(budget.built, budget.judged(run_of(requirement)), requirement)
            found.setdefault(key, []).extend(boxes_of(left, label))
            targets[key] = None if target is None or len(specs) > 1 else target / requirement.coverage
    if not found:
        raise ValueError("none of the specs has a [[requirement]], so there is no residual to draw: add a requirement")
    figure, panels = new_panels(len(found), (6.8, 4.0), figure)
    for axes, (key, drawn) in zip(panels, found.items(), strict=True):
        draw_curves(drawn, targets[key], ax=axes)
        axes.set_title(key[0])
    return figure


def draw_poses(spec: Spec, *, ax: Axes | None = None) -> tuple[Axes, PathCollection]:
    """The direction of the vertical in the sensor's frame at every rest, on the sphere (longitude about z); the colour
    is the time, the area the duration."""
    if ax is None:
        ax = Figure(figsize=(6.4, 3.6), layout="constrained").add_subplot(projection="mollweide")
    poses = rest_poses(build_imu(spec))
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
    ax.set_title("vertical in the device's frame, at rest", pad=14.0)
    ax.set_xticklabels([])
    ax.grid(visible=True, linewidth=0.4)
    return ax, dots


def draw_temperature(spec: Spec, *, label: str = "", ax: Axes | None = None) -> tuple[Axes, Line2D]:
    """The chamber's temperature against time, from a spec's schedule, without waits for stable temperatures."""
    schedule = spec.schedule
    if isinstance(schedule, StandardSchedule):
        each = schedule.duration / len(schedule.temperatures)
        points = [at for k, t in enumerate(schedule.temperatures) for at in ((k * each, t), ((k + 1) * each, t))]
    else:
        ends = [((s.start, s.temperature_start), (s.end, s.temperature_end)) for s in schedule.segments]
        points = [at for pair in ends for at in pair]
    time, temperature = np.array(points).T
    ax = new_axes(ax, (6.4, 3.2))
    (line,) = ax.plot(time / 3600.0, temperature, label=label, **style_of(0))
    ax.set(xlabel="time, h", ylabel="chamber, °C")
    return ax, line
