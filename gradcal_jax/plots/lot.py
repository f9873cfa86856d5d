"""Figures of lots: the maps of all IMUs with their mean, spread and shapes."""

from matplotlib.axes import Axes
from matplotlib.figure import Figure, SubFigure

from gradcal_jax.api.lot import Lot, LotMap
from gradcal_jax.plots.style import PALETTE, new_axes, new_panels, style_of


def draw_lot(found: Lot, *, figure: Figure | SubFigure | None = None) -> Figure:
    """A panel for each map, on `figure` or a new one: see `draw_lot_map`."""
    wide = min(3, len(found.maps))
    figure, panels = new_panels(-(-len(found.maps) // wide), wide, (4.6, 3.4), figure)
    for one, ax in zip(found.maps, panels.ravel(), strict=False):
        draw_lot_map(one, ax=ax)
    for ax in panels.ravel()[len(found.maps) :]:
        ax.set_axis_off()
    return figure


def draw_lot_map(one: LotMap, *, ax: Axes | None = None) -> Axes:
    """A map of all IMUs over temperature, at a low rate: outliers dashed, the mean with a band of one standard
    deviation of the type, and each shape by one standard deviation about the mean."""
    ax = new_axes(ax)
    strangers = {stranger.serial_number for stranger in one.strangers}
    t, constant = one.temperature_c, len(one.temperature_c) == 1
    at = range(1, len(one.values) + 1) if constant else t
    if constant:
        ax.plot(at, one.values[:, 0], "o", color="0.55", label="IMUs")
        ax.axhline(one.mean[0], color=PALETTE[0], label="mean ± 1σ of the type")
        ax.axhspan(one.mean[0] - one.spread[0], one.mean[0] + one.spread[0], color=PALETTE[0], alpha=0.2)
        ax.set_xticks(list(at), one.serial_numbers, rotation=90, fontsize=6)
    else:
        for name, values in zip(one.serial_numbers, one.values, strict=True):
            stranger = name in strangers
            (line,) = ax.plot(t, values, linewidth=0.8, color="0.7")
            if stranger:
                line.set(color=PALETTE[1], linestyle="--", label=f"{name}, an outlier")
        ax.plot(t, one.mean, linewidth=2.0, color=PALETTE[0], label="mean ± 1σ of the type")
        ax.fill_between(t, one.mean - one.spread, one.mean + one.spread, color=PALETTE[0], alpha=0.2)
        for k, shape in enumerate(one.shapes):
            ax.plot(t, one.mean + shape, label=f"mean + shape {k + 1}", **style_of(k + 2))
        ax.set_xlabel("temperature, °C")
    ax.set(ylabel=f"{one.term.replace('_', ' ')}, {one.unit}", title=one.channel.replace("_", " "))
    ax.legend(fontsize=7)
    return ax
