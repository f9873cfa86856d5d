"""Figures of many plans: a sweep's results, the frontier of time and residual, and sensitivities."""

from collections.abc import Mapping, Sequence
from typing import TYPE_CHECKING, Any

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure, SubFigure
from matplotlib.ticker import LogLocator, StrMethodFormatter

from gradcal_jax.design.optimise import FrontierPoint
from gradcal_jax.information.sensitivity import Sensitivities
from gradcal_jax.plots.style import COLOUR_MAP, from_zero, new_figure, style_of

if TYPE_CHECKING:
    import xarray

_MOST_CURVES, _MOST_PANELS = 8, 12


def draw_sweep(
    results: "xarray.Dataset", variable: str | None = None, *, figure: Figure | SubFigure | None = None
) -> Figure:
    """A sweep's residuals: one row of panels for each requirement, or for the one `variable`; on `figure` or a new one.

    For a grid, the axis with most values is the abscissa, the next has a curve for each value, a third a panel; further
    ones are at their middle value, which is in the title. Random points are plotted against each axis in turn.
    Errors: `ValueError` where there is nothing to draw.
    """
    names = (
        [variable] if variable else [str(n) for n, v in results.data_vars.items() if v.attrs.get("decisive") == "yes"]
    )
    unknown = [name for name in names if name not in results.data_vars]
    if unknown or not names:
        raise ValueError(f"the results have no variable {unknown[0]!r}" if unknown else "the results have no residuals")
    rows = [_drawn(results, name) if "point" in results.dims else _grid(results, name) for name in names]
    width = max(len(row) for row in rows)
    figure = new_figure(figure, (max(6.4, 3.4 * width), 3.9 * len(rows)))
    all_axes = figure.subplots(len(rows), width, squeeze=False)
    for axes, row in zip(all_axes, rows, strict=True):
        highest = 0.0
        for ax, panel in zip(axes, row, strict=False):
            panel(ax)
            highest = max(highest, ax.get_ylim()[1])
        for k, ax in enumerate(axes):
            if k >= len(row):
                ax.set_visible(False)
                continue
            ax.set_ylim(0.0, highest)
            if k:
                ax.set_ylabel("")
        if axes[0].get_legend_handles_labels()[0]:
            axes[0].legend(fontsize="small")
    if title := results.attrs.get("title"):
        figure.suptitle(title)
    return figure.get_figure(root=True)


def _grid(results: "xarray.Dataset", name: str) -> list[Any]:
    """A panel for each value of the third axis."""
    values = results[name]
    order = sorted(values.dims, key=lambda d: (results[d].dtype.kind != "f", -results.sizes[d]))
    fixed = order[3:] + ([order[1]] if len(order) > 1 and results.sizes[order[1]] > _MOST_CURVES else [])
    fixed_values = []
    for dim in fixed:
        middle = results.sizes[dim] // 2
        fixed_values.append(_named(results, str(dim), middle))
        values = values.isel({dim: middle})
    order = [dim for dim in order if dim not in fixed]
    across = str(order[0])
    curves = str(order[1]) if len(order) > 1 else None
    panels = str(order[2]) if len(order) > 2 else None
    count = min(results.sizes[panels], _MOST_PANELS) if panels else 1
    chosen = np.unique(np.linspace(0, results.sizes[panels] - 1, count).round().astype(int)) if panels else [0]

    def panel(which: int) -> Any:
        here = values.isel({panels: which}) if panels else values

        def draw(ax: Any) -> None:
            for index in range(results.sizes[curves] if curves else 1):
                curve = here.isel({curves: index}) if curves else here
                label = _named(results, curves, index) if curves else None
                x = results[across].values
                marks = "o" if len(x) < 30 else ""
                y = curve.values
                if x.dtype.kind == "f":
                    ax.plot(x, y, label=label, marker=marks, markersize=3, **style_of(index))
                else:
                    ax.plot(range(len(x)), y, label=label, marker="o", **style_of(index))
                    ax.set_xticks(range(len(x)), x, rotation=30, ha="right")
            title = [_named(results, panels, which)] if panels else [results[name].attrs["requirement"]]
            ax.set_title(", ".join([*title, *fixed_values]), fontsize="medium")
            _label(ax, results, across, name)
            from_zero(ax)

        return draw

    return [panel(int(which)) for which in chosen]


def _drawn(results: "xarray.Dataset", name: str) -> list[Any]:
    """A panel for each axis."""
    axes = [str(c) for c in results.coords if results[c].dims == ("point",)]
    second = next((a for a in axes if results[a].dtype.kind == "f"), None)

    def panel(across: str) -> Any:
        def draw(ax: Any) -> None:
            x, y = results[across].values, results[name].values
            other = next((a for a in axes if a != across and results[a].dtype.kind == "f"), second)
            shade = results[other].values if other is not None and other != across else None
            if x.dtype.kind != "f":
                words, x = np.unique(x, return_inverse=True)
                ax.set_xticks(range(len(words)), words, rotation=30, ha="right")
            drawn = ax.scatter(x, y, c=shade, cmap=COLOUR_MAP, s=6, rasterized=True)
            if shade is not None and other is not None:
                ax.figure.colorbar(drawn, ax=ax, label=_with_unit(results, other))
            ax.set_title(results[name].attrs["requirement"], fontsize="medium")
            _label(ax, results, across, name)
            from_zero(ax)

        return draw

    return [panel(across) for across in axes]


def _label(ax: Any, results: "xarray.Dataset", across: str, name: str) -> None:
    attributes = results[name].attrs
    ax.set_xlabel(_with_unit(results, across))
    ax.set_ylabel(f"{attributes['requirement']}: {attributes['statistic']} (1σ), {attributes['units']}")
    if results[across].attrs.get("spacing") == "logarithmic":
        ax.set_xscale("log")


def _with_unit(results: "xarray.Dataset", name: str) -> str:
    attributes = results[name].attrs
    unit = attributes.get("units", "1")
    return attributes.get("long_name", name) + (f", {unit}" if unit != "1" else "")


def _named(results: "xarray.Dataset", name: str, index: int) -> str:
    value, attributes = results[name].values[index], results[name].attrs
    unit = attributes.get("units", "1")
    number = f"{value:.4g}" if results[name].dtype.kind == "f" else str(value)
    return f"{attributes.get('long_name', name)} {number}" + (f" {unit}" if unit != "1" else "")


def draw_frontier(points: Sequence[FrontierPoint], targets: Mapping[str, float], *, ax: Axes | None = None) -> Figure:
    """The best residual for each duration, on logarithmic axes, and targets as lines.

    Errors: `ValueError` where no duration has a plan.
    """
    known = [(p.motion / 60.0, p.plan) for p in points if p.plan is not None]
    if not known:
        raise ValueError("there is no plan for any duration, so there is no frontier to draw")
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
    """A panel for every requirement, with a bar for each figure of the spec that matters, on `figure` or a new one."""
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
