"""Figures of many plans: a sweep's results, the frontier of time and residual, and sensitivities."""

from collections.abc import Mapping, Sequence
from typing import TYPE_CHECKING, Any

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure, SubFigure
from matplotlib.ticker import LogLocator, StrMethodFormatter

from gradcal_jax.design.optimise import FrontierPoint
from gradcal_jax.information.sensitivity import Sensitivities
from gradcal_jax.plots.style import from_zero, new_figure, style_of

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
    figure = new_figure(figure, (6.4, 3.9 * len(names)))
    for ax, name in zip(figure.subplots(len(names), squeeze=False)[:, 0], names, strict=True):
        _draw_grid(ax, results, name)
    if title := results.attrs.get("title"):
        figure.suptitle(title)
    return figure.get_figure(root=True)


def _draw_grid(ax: Any, results: "xarray.Dataset", name: str) -> None:
    values = results[name]
    order = sorted(map(str, values.dims), key=lambda d: (results[d].dtype.kind != "f", -results.sizes[d]))
    across, curves, fixed = order[0], order[1:2], order[2:]
    titles = [results[name].attrs["requirement"]]
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
    _label(ax, results, across, name)


def _label(ax: Any, results: "xarray.Dataset", across: str, name: str) -> None:
    attributes = results[name].attrs
    ax.set_xlabel(_with_unit(results, across))
    ax.set_ylabel(f"{attributes['requirement']}: {attributes['statistic']} (1σ), {attributes['units']}")
    if results[across].attrs.get("spacing") == "logarithmic":
        ax.set_xscale("log")
    from_zero(ax)


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
