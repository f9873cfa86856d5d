"""Figures of many plans: a sweep's results, and sensitivities."""

from typing import TYPE_CHECKING, Any

import numpy as np
from matplotlib.figure import Figure, SubFigure

from gradcal_jax.information.sensitivity import Sensitivities
from gradcal_jax.plots.style import new_panels, plain_logarithmic, style_of

if TYPE_CHECKING:
    import xarray

_MOST_CURVES, _FEW_POINTS = 8, 30


def draw_sweep(
    results: "xarray.Dataset", variable: str | None = None, *, figure: Figure | SubFigure | None = None
) -> Figure:
    """A sweep's residuals: a row for each requirement, or for the one `variable`; on `figure` or a new one.

    The axis with most values is the abscissa, and the next has a curve for each of (at most eight) values; further ones
    are at their middle value, which is in the title.
    Errors: `ValueError` where there is nothing to draw.
    """
    decisive = [str(name) for name, of in results.data_vars.items() if of.attrs.get("decisive") == "yes"]
    names = [variable] if variable else decisive
    unknown = [name for name in names if name not in results.data_vars]
    if unknown or not names:
        raise ValueError(f"the results have no variable {unknown[0]!r}" if unknown else "the results have no residuals")
    figure, panels = new_panels(len(names), (6.4, 3.9), figure)
    for ax, name in zip(panels, names, strict=True):
        _draw_grid(ax, results, name)
    if title := results.attrs.get("title"):
        figure.suptitle(title)
    return figure


def _draw_grid(ax: Any, results: "xarray.Dataset", name: str) -> None:
    values = results[name]
    order = sorted(map(str, values.dims), key=lambda d: (results[d].dtype.kind != "f", -results.sizes[d]))
    across, curves, fixed = order[0], order[1:2], order[2:]
    about = values.attrs
    titles = [about["requirement"]]
    for dim in fixed:
        middle = results.sizes[dim] // 2
        titles.append(_named(results, dim, middle))
        values = values.isel({dim: middle})
    count = results.sizes[curves[0]] if curves else 1
    chosen = np.unique(np.linspace(0, count - 1, min(count, _MOST_CURVES)).round().astype(int))
    x = results[across].values
    places = x if x.dtype.kind == "f" else np.arange(len(x))
    for index, k in enumerate(map(int, chosen)):
        curve = values.isel({curves[0]: k}) if curves else values
        label = _named(results, curves[0], k) if curves else None
        marks = "o" if len(x) < _FEW_POINTS else ""
        ax.plot(places, curve.values, label=label, marker=marks, markersize=3, **style_of(index))
    if places is not x:
        ax.set_xticks(places, x, rotation=30, ha="right")
    if curves:
        ax.legend(fontsize="small")
    ax.set_title(", ".join(titles), fontsize="medium")
    ax.set_xlabel(", ".join(_of_axis(results, across)))
    ax.set_ylabel(f"{about['requirement']}: {about['statistic']} (1σ), {about['units']}")
    if results[across].attrs.get("spacing") == "logarithmic":
        ax.set_xscale("log")
        plain_logarithmic(ax.xaxis)
    ax.set_ylim(0.0, 1.08 * ax.get_ylim()[1])  # (a level curve is not at the edge)


def _of_axis(results: "xarray.Dataset", name: str) -> list[str]:
    """The name of an axis and, if it has one, its unit."""
    about = results[name].attrs
    unit = about.get("units", "1")
    return [about.get("long_name", name), *([unit] if unit != "1" else [])]


def _named(results: "xarray.Dataset", name: str, index: int) -> str:
    value, (axis, *unit) = results[name].values[index], _of_axis(results, name)
    number = f"{value:.4g}" if results[name].dtype.kind == "f" else str(value)
    return " ".join([axis, number, *unit])


def draw_sensitivities(known: Sensitivities, *, figure: Figure | SubFigure | None = None) -> Figure:
    """A panel for every requirement, with a bar for each figure of the spec that matters, on `figure` or a new one."""
    figure, panels = new_panels(len(known.residuals), (7.2, 3.2), figure)
    for axes, (name, (value, unit)) in zip(panels, known.residuals.items(), strict=True):
        rows = [row for row in known.rows if row.requirement == name and abs(row.percent) > 5e-3][::-1]
        at = np.arange(len(rows))
        axes.barh(at, [row.percent for row in rows], color=style_of(0)["color"])
        axes.set_yticks(at, [row.figure for row in rows])
        axes.axvline(0.0, color="0.3", linewidth=0.8)
        axes.set_title(f"{name}: {value:.4g} {unit}")
        axes.set_xlabel("change of the residual for an increase of one per cent (%)")
    return figure
