"""Noise: Allan deviations with their fit and the bound of the drift."""

from collections.abc import Sequence

from matplotlib.figure import Figure, SubFigure

from gradcal_jax.identify import AllanDeviation, AllanFit
from gradcal_jax.identify.instability import Instability, RestRecord
from gradcal_jax.plots.style import PALETTE, new_panels, style_of
from gradcal_jax.units import DEG_PER_H


def draw_noise(
    channels: Sequence[tuple[RestRecord, AllanDeviation, AllanFit, Instability]],
    *,
    figure: Figure | SubFigure | None = None,
) -> Figure:
    """For each channel the overlapping Allan deviation with its confidence interval, the fitted model, and on the same
    axes the Direct Bound's limiting function (1σ)."""
    figure, panels = new_panels(len(channels), (6.8, 4.4), figure)
    for ax, (rest, allan, fit, instability) in zip(panels, channels, strict=True):
        tau, hour, bound = allan.averaging_time_s, DEG_PER_H, instability.bound
        ax.loglog(tau, allan.deviation * hour, label="Allan deviation", **style_of(0))
        sure = f"{fit.confidence:.1%} confidence"
        ax.fill_between(tau, fit.lower * hour, fit.upper * hour, alpha=0.25, color=PALETTE[0], label=sure)
        ax.loglog(fit.averaging_time_s, fit.model_deviation * hour, label="fitted Q, N, B, K", **style_of(1))
        label = "Direct Bound, D_L (1σ)"
        ax.loglog(bound.integration_time_s, bound.limiting_function * hour, label=label, **style_of(2))
        title = f"axis {rest.axis}, IMU {rest.unit}"
        ax.set(xlabel="averaging or integration time, s", ylabel="rate, deg/h", title=title)
        ax.legend()
    return figure
