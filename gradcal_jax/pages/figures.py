"""The figures of a page as SVG with real text, each of the width of a column on a telephone."""

import io
import re
from collections.abc import Callable, Iterator
from typing import Any, Final, NamedTuple

import matplotlib as mpl
import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from gradcal_jax import plots
from gradcal_jax.calibration.file import Calibration
from gradcal_jax.information.verdicts import target_of
from gradcal_jax.pages.history import RunHistory
from gradcal_jax.pages.residuals import ResidualLeft
from gradcal_jax.plots.calibration import panels_of
from gradcal_jax.plots.residual import boxes_of
from gradcal_jax.spec.spec_sections import Spec

# Inches. A column is about 370 px wide on a telephone and 500 px on a desk: text of 10 points stays legible on both.
_SIZE: Final = (5.2, 3.7)
_STYLE: Any = {
    "svg.fonttype": "none",
    "svg.hashsalt": "gradcal",
    "font.family": "sans-serif",
    "font.sans-serif": ["DejaVu Sans", "Verdana", "Helvetica", "Arial"],
    "font.size": 9.5,
    "axes.titlesize": 10.5,
}


class Picture(NamedTuple):
    """An SVG with its caption; `key` is its id on the page."""

    key: str
    caption: str
    svg: str


def residual_pictures(found: list[ResidualLeft]) -> Iterator[Picture]:
    """For each requirement its residuals as curves: of a single element at every stage in one picture, and as a map of
    the last stage; of several elements a picture of each stage but the priors."""
    for left in found:
        if not left.stages:
            continue
        requirement, name = left.requirement, left.requirement.name
        target = None if (limit := target_of(requirement)) is None else limit / requirement.coverage
        last, residual = list(left.stages.items())[-1]
        by_rate, single = len(residual.rates) > 1, len(residual.labels) == 1
        if single and by_rate:
            rates = np.degrees(residual.rates)
            yield picture(
                f"{name} map",
                f"{name}: residual {last}, one standard deviation.",
                lambda ax, r=residual, w=rates: plots.draw_map(r.temperatures, w, r.values[0], r.unit, ax=ax),
            )
        over = "the maximum over temperature, against rate" if by_rate else "over temperature"
        together = [box for stage, of in left.stages.items() for box in boxes_of(of, stage)]
        drawn = {"": together} if single else {s: boxes_of(of) for s, of in left.stages.items() if s != "before"}
        for stage, boxes in drawn.items():
            yield picture(
                f"{name} curves {stage}",
                " ".join(filter(None, (f"{name}: residual", stage))) + f", {over}, one standard deviation.",
                lambda ax, b=boxes, t=target: plots.draw_curves(b, t, ax=ax),
            )


def plan_pictures(spec: Spec) -> Iterator[Picture]:
    """Poses, and the temperature as planned."""
    if not spec.is_one_axis:
        words = "Direction of the vertical in the device's frame at every rest; the colour shows the time of the rest."
        yield picture("poses", words, lambda ax: plots.draw_poses(spec, ax=ax), projection="mollweide")
    words = "Planned temperature of the chamber, without waiting for stable temperatures."
    yield picture("temperature of the plan", words, lambda ax: plots.draw_temperature(spec, ax=ax))


def run_picture(history: RunHistory) -> Picture:
    """The temperature as measured."""

    def draw(ax: Axes) -> None:
        ax.plot(history.chamber_s / 3600.0, history.chamber_c, **plots.style_of(0))
        ax.set(xlabel="time, h", ylabel="chamber, °C")

    return picture("measured", "Measured temperature of the chamber since the run began.", draw)


def calibration_pictures(calibration: Calibration) -> Iterator[Picture]:
    """The maps of a calibration, and its residuals."""
    over_rate: set[str] = set()
    for channel in calibration.channel:
        term = channel.term_of("scale_factor")
        if term is None or term.rate is None or term.rate.size < 2:
            continue
        over_rate.add(channel.kind)
        words = f"Estimated scale factor of {channel.label}; the bands are ± one standard deviation."
        yield picture(
            f"scale factor {channel.name}",
            words,
            lambda ax, c=channel: plots.draw_calibrated_scale_factor(calibration, c, ax=ax),
        )
    for kind, name in panels_of(calibration):
        if name == "bias" or kind not in over_rate:
            words = f"{kind.capitalize()} {name.replace('_', ' ')}, estimated; the bands are ± one standard deviation."
            yield picture(
                f"{kind} {name}",
                words,
                lambda ax, k=kind, n=name: plots.draw_calibrated_term(calibration, k, n, ax=ax),
            )
    # Of six channels, those that a test contradicts.
    failed = {name.partition(":")[0] for name in calibration.contradicted}
    for channel in calibration.channel:
        wanted = len(calibration.channel) <= 3 or channel.name in failed
        if wanted and channel.residuals is not None and sum(channel.residuals.counts):
            words = f"Residuals of {channel.label}, in units of the standard deviation that the spec's noise gives."
            yield picture(f"residuals {channel.name}", words, lambda ax, c=channel: plots.draw_residuals(c, ax=ax))


def picture(name: str, caption: str, draw: Callable[[Axes], object], *, projection: str | None = None) -> Picture:
    """The drawing of `draw`, as wide as a column."""
    key = re.sub(r"[^a-z0-9]+", "-", name.lower()).strip("-") or "figure"
    with mpl.rc_context(_STYLE):
        figure = Figure(figsize=_SIZE, layout="constrained")
        draw(figure.add_subplot(projection=projection))
        return Picture(key, caption, _svg(figure, key))


def _svg(figure: Figure, key: str) -> str:
    """The figure as an `<svg>` for a page: as wide as its column, with ids of its own, without external resources."""
    stream = io.StringIO()
    figure.savefig(stream, format="svg", metadata=dict.fromkeys(("Creator", "Date", "Format", "Type")))
    text = stream.getvalue()
    text = text[text.index("<svg") :]
    text = re.sub(r"<metadata>.*?</metadata>", "", text, flags=re.S)
    head, rest = text.split(">", 1)
    head = re.sub(r' (width|height)="[^"]*"', "", head)
    text = f'{head} role="img" aria-labelledby="{key}-caption">{rest}'
    text = re.sub(r'\bid="([^"]+)"', rf'id="{key}-\1"', text)
    text = re.sub(r'((?:xlink:)?href)="#([^"]+)"', rf'\1="#{key}-\2"', text)
    return re.sub(r"url\(#([^)]+)\)", rf"url(#{key}-\1)", text).strip()
