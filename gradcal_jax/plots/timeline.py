"""Temperature and motion tracks of a plan."""

import numpy as np
from matplotlib.axes import Axes
from matplotlib.lines import Line2D

from gradcal_jax.files import Timeline
from gradcal_jax.plots.style import new_axes, style_of


def draw_temperature(
    written: Timeline, *, label: str = "", index: int = 0, ax: Axes | None = None
) -> tuple[Axes, Line2D]:
    """The chamber's temperature against time, from a `gradcal-timeline/2`."""
    ax = new_axes(ax, (6.4, 3.2))
    axis = written.segments[0].axis
    points: list[tuple[float, float]] = []
    for segment in (s for s in written.segments if s.axis == axis):
        points.append((segment.start, segment.temperature_start))
        points += segment.temperature_bends or ()
        points.append((segment.start + segment.duration, segment.temperature_end))
    time, temperature = np.array(points).T
    (line,) = ax.plot(time / 3600.0, temperature, label=label, **style_of(index))
    ax.set(xlabel="time, h", ylabel="chamber, °C")
    return ax, line
