"""How the error of the integrated rate grows in a mission."""

from collections.abc import Sequence

import numpy as np
from matplotlib.axes import Axes
from matplotlib.lines import Line2D

from gradcal_jax.api.missions import ErrorCurve
from gradcal_jax.plots.style import from_zero, new_axes, style_of


def draw_heading(
    curves: Sequence[tuple[str, ErrorCurve]], *, own: bool = True, first: int = 0, ax: Axes | None = None
) -> tuple[Axes, list[Line2D]]:
    """What calibrations leave of the heading over time (deg, 1σ), each with a label; with `own`, the unit's own noise,
    too, and both together. `first`: the number of the first curve's style."""
    ax = new_axes(ax)
    drawn: list[Line2D] = []

    def line(curve: ErrorCurve, values: np.ndarray, label: str) -> None:
        shown = np.where(np.isfinite(values), values, np.nan)
        drawn.extend(ax.plot(curve.time / 60.0, shown, label=label, **style_of(first + len(drawn))))

    for label, curve in curves:
        line(curve, curve.left, label)
    for curve in {c.file: c for _, c in curves}.values() if own else ():
        of = f", {curve.file}" if len({c.file for _, c in curves}) > 1 else ""
        line(curve, curve.own, f"own noise{of}")
        if len(curves) == 1:
            line(curve, np.hypot(curve.left, curve.own), "together")
    ax.set(xlabel="time in the mission, min", ylabel="error of the heading (1σ), deg")
    from_zero(ax)
    ax.legend()
    return ax, drawn
