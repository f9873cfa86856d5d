"""Instability: Allan deviations with their fit and the bound of the drift."""

from collections.abc import Sequence

from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.lines import Line2D

from gradcal_jax.identify import AllanDeviation, AllanFit
from gradcal_jax.identify.instability import Instability, RestRecord
from gradcal_jax.plots.style import PALETTE, new_axes, new_panels, style_of
from gradcal_jax.units import DEG_PER_H


def draw_allan(allan: AllanDeviation, fit: AllanFit, *, title: str = "", ax: Axes | None = None) -> tuple[Axes, Line2D]:
    """The overlapping Allan deviation with its confidence interval and the fitted model."""
    ax = new_axes(ax)
    tau, hour = allan.averaging_time_s, DEG_PER_H
    (line,) = ax.loglog(tau, allan.deviation * hour, label="Allan deviation", **style_of(0))
    ax.fill_between(
        tau, fit.lower * hour, fit.upper * hour, alpha=0.25, color=PALETTE[0], label=f"{fit.confidence:.1%} confidence"
    )
    ax.loglog(fit.averaging_time_s, fit.model_deviation * hour, label="fitted Q, N, B, K", **style_of(1))
    ax.set(xlabel="averaging or integration time, s", ylabel="rate, deg/h", title=title)
    ax.legend()
    return ax, line


def draw_allan_and_bound(
    drawn: Sequence[tuple[RestRecord, AllanDeviation, AllanFit]], bounds: Sequence[Instability | None]
) -> Figure:
    """For each channel the Allan deviation and, on the same axes, the Direct Bound's one-sigma limiting function."""
    figure, all_axes = new_panels(len(drawn), 1, (6.8, 4.4))
    for ax, (rest, allan, fit), instability in zip(all_axes[:, 0], drawn, bounds, strict=True):
        draw_allan(allan, fit, title=_name(rest), ax=ax)
        if instability is not None:
            t = instability.bound.integration_time_s
            ax.loglog(t, instability.bound.limiting_function * DEG_PER_H, label="Direct Bound, D_L (1σ)", **style_of(2))
        ax.legend()
    return figure


def _name(rest: RestRecord) -> str:
    return f"axis {rest.axis}, IMU {rest.unit}"
