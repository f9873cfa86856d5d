"""Residual maps over temperature and rate, and the curves drawn from them."""

from collections.abc import Sequence

import numpy as np
from matplotlib.axes import Axes
from matplotlib.collections import QuadMesh
from matplotlib.lines import Line2D

from gradcal_jax.estimation.calibrations import Box
from gradcal_jax.information.residual import ResidualMap
from gradcal_jax.plots.style import COLOUR_MAP, new_axes, plain_logarithmic, style_of

# Residuals that differ by more than this are shown on logarithmic scales.
LOGARITHMIC = 4.0
# Curves for each column of a legend.
_LONG_LEGEND = 5


def draw_map(
    temperature_c: np.ndarray,
    rate_dps: np.ndarray,
    residual: np.ndarray,
    unit: str,
    *,
    title: str = "",
    ax: Axes | None = None,
) -> tuple[Axes, QuadMesh]:
    """Residual `(n_T, n_ω)` as colour with contour lines, which the colour bar has too; points that the plan cannot
    observe stay blank."""
    ax = new_axes(ax)
    shown = np.ma.masked_invalid(residual)
    mesh = ax.pcolormesh(rate_dps, temperature_c, shown, cmap=COLOUR_MAP, shading="nearest", rasterized=True)
    bar = ax.figure.colorbar(mesh, ax=ax, label=f"residual (1σ), {unit}")
    if shown.count() > 3 and float(shown.max()) > float(shown.min()):
        # The labels of lines near an edge would be cut off.
        bar.add_lines(ax.contour(rate_dps, temperature_c, shown, levels=4, colors="white", linewidths=0.7))
    ax.set(xlabel="rate, deg/s", ylabel="temperature, °C", title=title)
    return ax, mesh


def draw_curves(
    boxes: Sequence[tuple[str, Box]], target: float | None = None, *, ax: Axes | None = None
) -> tuple[Axes, list[Line2D]]:
    """Residuals of one quantity over temperature, each with a label; for maps over temperature and rate, the maximum
    over temperature against the rate: the curve whose mean is the paper's figure. `target` is the largest allowed
    standard deviation, drawn as a line. If the residuals differ much in size, the axis is logarithmic."""
    ax = new_axes(ax)
    lines: list[Line2D] = []
    for index, (label, box) in enumerate(boxes):
        by_rate = len(box.rate_dps) > 1
        over, name = (box.rate_dps, "rate, deg/s") if by_rate else (box.temperature_c, "temperature, °C")
        values = np.max(box.values, axis=0 if by_rate else 1)
        lines += ax.plot(over, np.where(np.isfinite(values), values, np.nan), label=label, **style_of(index))
        most = "largest residual over temperature" if by_rate else "residual"
        ax.set(xlabel=name, ylabel=f"{most} (1σ), {box.unit}")
    if target is not None:
        lines.append(ax.axhline(target, color="#555555", linewidth=1.0, linestyle=(0, (6, 3)), label="target (1σ)"))
    seen = np.concatenate([np.asarray(line.get_ydata()) for line in lines])
    seen = seen[np.isfinite(seen) & (seen > 0.0)]
    if len(seen) and seen.max() > LOGARITHMIC * seen.min():
        ax.set(yscale="log", ylim=(0.8 * seen.min(), 1.25 * seen.max()))
        plain_logarithmic(ax.yaxis)
    elif len(seen):
        ax.set_ylim(0.0, 1.08 * seen.max())
    many = len(boxes) > _LONG_LEGEND
    ax.legend(fontsize="small" if many else None, ncols=1 + len(boxes) // _LONG_LEGEND)
    return ax, lines


def boxes_of(left: ResidualMap, label: str = "") -> list[tuple[str, Box]]:
    """The elements of a residual with their names, after a label of them all."""
    several = len(left.labels) > 1
    return [
        (
            ", ".join(filter(None, (label, element if several or not label else ""))),
            Box(left.temperatures, np.degrees(left.rates), values, left.unit),
        )
        for element, values in zip(left.labels, left.values, strict=True)
    ]
