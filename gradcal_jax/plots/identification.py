"""Instability: largest drifts with their bound, and Allan deviations with their fit."""

from collections.abc import Sequence

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.lines import Line2D

from gradcal_jax.identify import AllanDeviation, AllanFit
from gradcal_jax.identify.instability import Instability, RestRecord
from gradcal_jax.plots.style import PALETTE, new_axes, new_panels, style_of
from gradcal_jax.units import DEG_PER_H


def draw_drift(instability: Instability, *, ax: Axes | None = None) -> tuple[Axes, Line2D]:
    """The largest drift D_θ*(t) of one channel, its limit from the chosen process, and its limit from random walk
    alone."""
    ax = new_axes(ax)
    bound, hour = instability.bound, DEG_PER_H
    t = bound.integration_time_s
    (line,) = ax.loglog(t, bound.largest_drift * hour, label="largest drift", **style_of(0))
    limit = (
        f"bound: {bound.drift_std * hour:.3g} deg/h, {bound.correlation_time_s:.3g} s"
        if bound.drift_shows
        else "bound: random walk alone"
    )
    ax.loglog(t, bound.limit * hour, label=limit, **style_of(1))
    ax.loglog(t, bound.random_walk_limit * hour, label="random walk alone", **style_of(2))
    ax.set(xlabel="integration time, s", ylabel="drift after the average, deg/h", title=_name(instability.rest))
    ax.legend()
    return ax, line


def draw_boundary(instability: Instability, *, ax: Axes | None = None) -> tuple[Axes, Line2D]:
    """The boundary σ(τ) of the Gauss–Markov processes that bound the record, and the chosen process."""
    ax = new_axes(ax)
    bound = instability.bound
    shown = np.where(bound.boundary_drift_std > 0, bound.boundary_drift_std, np.nan) * DEG_PER_H
    (line,) = ax.loglog(bound.boundary_correlation_time_s, shown, label="smallest σ that bounds", **style_of(0))
    if bound.drift_shows:
        ax.loglog(
            [bound.correlation_time_s], [bound.drift_std * DEG_PER_H], "o", color="black", label="bounds most tightly"
        )
        ax.legend()
    ax.set(xlabel="correlation time τ, s", ylabel="drift σ, deg/h", title=_name(instability.rest))
    return ax, line


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
    return f"axis {rest.axis}, IMU {rest.unit}" + (f", {rest.part}" if rest.part else "")
