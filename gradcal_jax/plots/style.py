"""Style of all figures: sizes, colour-blind-safe colours, and saving without a display."""

from pathlib import Path
from typing import Any

import numpy as np
from matplotlib.axes import Axes
from matplotlib.axis import Axis
from matplotlib.figure import Figure, SubFigure
from matplotlib.lines import Line2D
from matplotlib.ticker import FuncFormatter, LogLocator, NullFormatter

from gradcal_jax.tables.writing import whole

# The perceptually even, colour-blind-safe map of all residual pictures.
COLOUR_MAP = "viridis"
# Okabe and Ito's palette, distinguishable with every common colour-vision deficiency.
PALETTE = ("#0072B2", "#D55E00", "#009E73", "#CC79A7", "#E69F00", "#56B4E9", "#000000")
LINE_STYLES = ("-", "--", "-.", ":")


def style_of(index: int) -> dict[str, Any]:
    """Colour and dash of the index-th curve; either alone distinguishes curves in print."""
    return {"color": PALETTE[index % len(PALETTE)], "linestyle": LINE_STYLES[index % len(LINE_STYLES)]}


def new_axes(ax: Axes | None, size: tuple[float, float] = (6.4, 4.2)) -> Axes:
    """`ax`, or the axes of a new figure without a window."""
    return ax if ax is not None else Figure(figsize=size, layout="constrained").add_subplot()


def draw_band(
    ax: Axes, x: np.ndarray, value: np.ndarray, std: np.ndarray, index: int, label: str = "", alpha: float = 0.2
) -> Line2D:
    """The index-th curve, with a band of one standard deviation."""
    (line,) = ax.plot(x, value, label=label, **style_of(index))
    ax.fill_between(x, value - std, value + std, alpha=alpha, color=PALETTE[index % len(PALETTE)])
    return line


def plain_logarithmic(axis: Axis) -> None:
    """Numbers at 1, 2 and 5 of each decade of a logarithmic axis, without powers of ten."""
    axis.set_major_locator(LogLocator(10.0, subs=(1.0, 2.0, 5.0)))
    axis.set_major_formatter(FuncFormatter(tick_text))
    axis.set_minor_formatter(NullFormatter())


def tick_text(value: float, _place: int) -> str:
    """A number at an axis, without powers of ten."""
    return f"{value:.4g}" if value < 1e4 else f"{value:.0f}"


def new_panels(
    count: int, size: tuple[float, float], figure: Figure | SubFigure | None = None
) -> tuple[Figure, list[Axes]]:
    """Axes one below the other on `figure`, or on a new one without a window; `size` of each, in inches."""
    if figure is None:
        figure = Figure(figsize=(size[0], size[1] * count), layout="constrained")
    return figure.get_figure(root=True), list(figure.subplots(count, 1, squeeze=False)[:, 0])


def save(figure: Figure, path: str | Path) -> None:
    """Write a figure; the suffix decides the format. Errors: `ValueError` for an unknown suffix."""
    ending = Path(path).suffix.lstrip(".").lower()
    known = figure.canvas.get_supported_filetypes()
    if ending not in known:
        raise ValueError(f"{path}: the name of a figure must end in one of {', '.join('.' + k for k in sorted(known))}")
    with whole(path) as passing:
        figure.savefig(passing, dpi=150)
