"""Figures of designs: the frontier of time and residual, and sensitivities."""

from collections.abc import Mapping, Sequence

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure, SubFigure
from matplotlib.ticker import LogLocator, StrMethodFormatter

from gradcal_jax.api.frontier import FrontierPoint
from gradcal_jax.api.sensitivity import Sensitivities
from gradcal_jax.plots.style import new_figure, style_of


def draw_frontier(points: Sequence[FrontierPoint], targets: Mapping[str, float], *, ax: Axes | None = None) -> Figure:
    """The best residual for each duration, on logarithmic axes, and targets as lines.

    Errors: `ValueError` where no duration has a plan.
    """
    known = [(p.motion / 60.0, p.plan) for p in points if p.plan is not None]
    if not known:
        raise ValueError("no duration has a plan, so there is no frontier to draw")
    figure = Figure(figsize=(6.4, 4.0), layout="constrained") if ax is None else ax.figure.get_figure(root=True)
    assert isinstance(figure, Figure)
    axes = figure.subplots() if ax is None else ax
    unit, name = known[0][1].unit, known[0][1].name
    axes.loglog([t for t, _ in known], [plan.now for _, plan in known], marker="o", **style_of(0))
    for k, (label, target) in enumerate(targets.items()):
        axes.axhline(target, linewidth=1.0, label=f"target of {label}: {target:.4g} {unit}", **style_of(k + 1))
    axes.set_xlabel("duration of the ramp (min)")
    axes.set_ylabel(f"{name} ({unit}, 1σ)")
    axes.set_xticks([t for t, _ in known], [f"{t:.0f}" for t, _ in known])
    axes.yaxis.set_major_locator(LogLocator(subs=(1.0, 2.0, 5.0)))
    axes.yaxis.set_major_formatter(StrMethodFormatter("{x:g}"))
    axes.minorticks_off()
    axes.grid(alpha=0.3)
    if targets:
        axes.legend()
    return figure


def draw_sensitivities(known: Sensitivities, *, figure: Figure | SubFigure | None = None) -> Figure:
    """A bar for each figure of the spec that matters, a panel for every requirement, on `figure` or a new one."""
    names = list(known.residuals)
    figure = new_figure(figure, (7.2, 1.0 + 2.6 * len(names)))
    for axes, name in zip(figure.subplots(len(names), squeeze=False)[:, 0], names, strict=True):
        rows = [row for row in known.rows if row.requirement == name and abs(row.percent) > 5e-3][::-1]
        at = np.arange(len(rows))
        axes.barh(at, [row.percent for row in rows], color=style_of(0)["color"])
        axes.set_yticks(at, [row.figure for row in rows])
        axes.axvline(0.0, color="0.3", linewidth=0.8)
        value, unit = known.residuals[name]
        axes.set_title(f"{name}: {value:.4g} {unit}")
        axes.set_xlabel("change of the residual for an increase of one per cent (%)")
    return figure.get_figure(root=True)
