"""Residual maps over temperature and rate, and the curves drawn from them."""

from typing import NamedTuple

import numpy as np
from matplotlib.axes import Axes
from matplotlib.collections import QuadMesh
from matplotlib.contour import QuadContourSet
from matplotlib.lines import Line2D

from gradcal_jax.api.unit_residual import UnitResidual
from gradcal_jax.plots.style import COLOUR_MAP, from_zero, new_axes, style_of


class MapArtists(NamedTuple):
    """What `draw_map` drew."""

    axes: Axes
    mesh: QuadMesh
    contours: QuadContourSet | None


def draw_map(
    temperature_c: np.ndarray,
    rate_dps: np.ndarray,
    residual: np.ndarray,
    unit: str,
    *,
    title: str = "",
    ax: Axes | None = None,
) -> MapArtists:
    """Residual `(n_T, n_ω)` as colour with contour lines; points that the plan cannot observe stay blank."""
    ax = new_axes(ax)
    shown = np.ma.masked_invalid(residual)
    mesh = ax.pcolormesh(rate_dps, temperature_c, shown, cmap=COLOUR_MAP, shading="nearest", rasterized=True)
    contours = None
    if shown.count() > 3 and float(shown.max()) > float(shown.min()):
        contours = ax.contour(rate_dps, temperature_c, shown, levels=4, colors="white", linewidths=0.7)
        ax.clabel(contours, fmt="%.3g", fontsize=8)
    ax.figure.colorbar(mesh, ax=ax, label=f"residual (1σ), {unit}")
    ax.set(xlabel="rate, deg/s", ylabel="temperature, °C", title=title)
    return MapArtists(ax, mesh, contours)


def draw_worst_over_temperature(
    rate_dps: np.ndarray, residual: np.ndarray, unit: str, *, label: str = "", index: int = 0, ax: Axes | None = None
) -> tuple[Axes, Line2D]:
    """The maximum over temperature against rate: the curve whose mean is the paper's figure."""
    ax = new_axes(ax)
    worst = np.max(residual, axis=0)
    (line,) = ax.plot(rate_dps, np.where(np.isfinite(worst), worst, np.nan), label=label, **style_of(index))
    ax.set(xlabel="rate, deg/s", ylabel=f"largest residual over temperature (1σ), {unit}")
    from_zero(ax)
    return ax, line


def draw_over_temperature(
    temperature_c: np.ndarray,
    residual: np.ndarray,
    unit: str,
    *,
    label: str = "",
    index: int = 0,
    ax: Axes | None = None,
) -> tuple[Axes, Line2D]:
    """A residual `(n_T, 1)` against temperature."""
    ax = new_axes(ax)
    values = residual[:, 0]
    (line,) = ax.plot(temperature_c, np.where(np.isfinite(values), values, np.nan), label=label, **style_of(index))
    ax.set(xlabel="temperature, °C", ylabel=f"residual (1σ), {unit}")
    from_zero(ax)
    return ax, line


def draw_residual(
    left: UnitResidual, *, label: str = "", first: int = 0, target: bool = True, ax: Axes | None = None
) -> tuple[Axes, list[Line2D]]:
    """The residual of each element of a requirement's quantity over temperature or, for the scale factor of gyros, the
    largest over temperature against rate, with the `target` on one standard deviation. `first`: the index of the first
    curve's style."""
    ax = new_axes(ax)
    lines: list[Line2D] = []
    for element, values in zip(left.labels, left.values, strict=True):
        words = ", ".join(filter(None, (label, element if len(left.labels) > 1 else "")))
        style = {"label": words, "index": first + len(lines), "ax": ax}
        if len(left.rates) > 1:
            lines.append(draw_worst_over_temperature(np.degrees(left.rates), values, left.unit, **style)[1])
        else:
            lines.append(draw_over_temperature(left.temperatures, values, left.unit, **style)[1])
    requirement = left.requirement
    if target and requirement.target is not None:
        limit = float(requirement.target) * left.si / requirement.coverage
        ax.axhline(limit, color="black", linewidth=0.8, linestyle=":")
        ax.annotate("target", (0.01, limit), xycoords=("axes fraction", "data"), va="bottom", fontsize=8)
    from_zero(ax)
    ax.set_ylim(top=1.08 * ax.get_ylim()[1])
    if len(left.labels) > 1:
        ax.legend(fontsize=8, ncols=3)
    return ax, lines
