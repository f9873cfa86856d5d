"""The poses of a plan at rest."""

import numpy as np
from matplotlib.axes import Axes
from matplotlib.collections import PathCollection
from matplotlib.figure import Figure

from gradcal_jax.api.imu_build import build_imu, rest_poses
from gradcal_jax.files.spec_sections import Spec
from gradcal_jax.plots.style import COLOUR_MAP


def draw_poses(spec: Spec, *, ax: Axes | None = None) -> tuple[Axes, PathCollection]:
    """The vertical in the device's frame at every rest: longitude about z, colour by time, area by duration."""
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
    ax.set_title("which way is up, seen from the device, at rest", pad=14.0)
    ax.set_xticklabels([])
    ax.grid(visible=True, linewidth=0.4)
    return ax, dots
