"""Figures of a sweep's results: curves and panels of a grid, scatter plots of random points."""

from typing import TYPE_CHECKING, Any

import numpy as np
from matplotlib.figure import Figure, SubFigure

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
