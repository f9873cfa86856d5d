"""The figures of a page as SVG with real text, each of the width of a column on a telephone."""

import io
import re
from collections.abc import Callable, Iterator, Mapping, Sequence
from itertools import groupby
from typing import Any, NamedTuple

import matplotlib as mpl
import numpy as np
from matplotlib.axes import Axes
from matplotlib.colors import LogNorm, Normalize
from matplotlib.contour import QuadContourSet
from matplotlib.figure import Figure
from matplotlib.ticker import FuncFormatter, LogLocator, MaxNLocator, NullFormatter

from gradcal_jax import plots
from gradcal_jax.calibration import Calibration
from gradcal_jax.estimation.calibrations import Box
from gradcal_jax.pages.numbers import figures, typographic_units
from gradcal_jax.pages.requirements import MapFact
from gradcal_jax.pages.run_history import RunHistory
from gradcal_jax.plots.calibration_maps import (
    draw_calibrated_scale_factor,
    draw_calibrated_term,
    draw_residual_parts,
    draw_residuals,
    panels_of,
)
from gradcal_jax.plots.residual import LOGARITHMIC, tick_text
from gradcal_jax.plots.spec import (
    draw_against_time,
    draw_planned_temperature,
    planned_cycle,
    planned_rate,
    turned_axes,
)
from gradcal_jax.plots.style import style_of
from gradcal_jax.recipe.recipe import Recipe
from gradcal_jax.spec.spec_sections import Spec

# Inches. A column is about 370 px wide on a telephone and 500 px on a desk: text of 10 points stays legible on both.
_WIDE, _HIGH, _LOW = 5.2, 3.7, 2.9
_STYLE: Any = {
    "svg.fonttype": "none",
    "svg.hashsalt": "gradcal",
    "font.family": "sans-serif",
    "font.sans-serif": ["DejaVu Sans", "Verdana", "Helvetica", "Arial"],
    "font.size": 9.5,
    "axes.titlesize": 10.5,
}
# Maps whose ratio is everywhere nearer to 1 than this look alike (a natural logarithm).
_ALIKE = 0.3
# A map of ratios that are all nearer to 1 than this shows nothing.
_SAME = 0.02
# Distances of labels on a map from its edge, and from one another, as shares of its sides.
_INSIDE, _APART = 0.06, np.array([0.15, 0.09])


class Picture(NamedTuple):
    """An SVG with its caption; `key` is its id on the page."""

    key: str
    caption: str
    svg: str


def map_pictures(facts: Sequence[MapFact], targets: Mapping[str, float]) -> list[list[Picture]]:
    """For each requirement whose box is in no earlier one its pictures. Over temperature and rate: for each element its
    maps on one colour scale, then their curves; a map that looks like the one before it is shown as their ratio. Over
    temperature alone: curves, of a single element all in one picture, of several a picture for before, predicted and
    achieved. `targets`: the limits on the standard deviation, by requirement."""
    groups: list[list[Picture]] = []
    drawn: list[MapFact] = []
    for (name, quantity), several in groupby(facts, lambda fact: (fact.name, fact.quantity)):
        own = [fact for fact in several if not any(_holds(other, fact) for other in drawn)]
        drawn += own
        key, target = picture_key(f"{name} {quantity}"), targets.get(name)
        heading = [fact for fact in own if fact.curves]
        maps = [fact for fact in own if fact.maps and len(fact.maps[0][1].rate_dps) > 1]
        curves = [fact for fact in own if fact.maps and fact not in maps]
        for fact in heading:
            words = (
                f"{name}: heading error after the calibration over time, one standard deviation. The IMU's own "
                "noise cannot be removed by a calibration."
            )
            draw = lambda ax, f=fact: plots.draw_heading(f.curves, ax=ax)  # noqa: E731
            groups.append([picture(f"{key}-curves", words, draw, _HIGH)])
        for fact in maps:
            where = name if len(maps) == 1 else f"{name}, axis {fact.axis}"
            of = picture_key(f"{key} {fact.axis}")
            groups.append([*_maps(fact, of, where), _curves(fact.maps, f"{of}-curves", where, target)])
        if len(curves) == 1:
            groups.append([_curves(curves[0].maps, f"{key}-curves", name, target)])
        elif curves:
            stages = dict.fromkeys(stage for fact in curves for stage, _ in fact.maps)
            lines = {s: [(f.axis, box) for f in curves for stage, box in f.maps if stage == s] for s in stages}
            # Priors are mostly the same for all elements, which needs no picture.
            shown = {s: of for s, of in lines.items() if s != "before" or not _same(of)}
            groups.append([_curves(of, f"{key}-{s}", name, target, s) for s, of in shown.items()])
    return groups


def _maps(fact: MapFact, key: str, where: str) -> Iterator[Picture]:
    norm = _norm([box for _, box in fact.maps])
    for place, (label, box) in enumerate(fact.maps):
        earlier = fact.maps[place - 1] if place else None
        if earlier is not None and _alike(box, earlier[1]):
            ratio = box._replace(values=box.values / earlier[1].values, unit="ratio")
            if float(np.abs(ratio.values - 1.0).max()) < _SAME:
                continue
            words = f"{where}: ratio of the remaining error '{label}' to the remaining error '{earlier[0]}'."
            # At least from a tenth less to a tenth more, so that small differences have nearly one colour.
            ends = Normalize(min(float(ratio.values.min()), 0.9), max(float(ratio.values.max()), 1.1))
            yield _map(ratio, f"{label} / {earlier[0]}", f"{key}-{label}", words, ends)
        else:
            words = f"{where}: residual {label}, one standard deviation."
            yield _map(box, label, f"{key}-{label}", words, norm)


def pose_picture(spec: Spec) -> Picture:
    """The vertical in the device's frame at every rest."""
    words = (
        "Direction of the vertical in the device's frame at every rest; the colour shows the time of the rest, and "
        "the size its duration."
    )
    return picture("poses", words, lambda ax: plots.draw_poses(spec, ax=ax), _LOW, projection="mollweide")


def track_pictures(recipe: Recipe | None, history: RunHistory | None) -> list[Picture]:
    """Temperature and motion: those of the recipe, and those of the run, where there is one."""

    def temperatures(ax: Axes) -> None:
        if recipe is not None:
            draw_planned_temperature(recipe, ax=ax)
        if history is not None and len(history.chamber_s):
            index = 0 if recipe is None else 1
            draw_against_time(history.chamber_s, history.chamber_c, "chamber, °C", "done", index, ax)
        if recipe is not None:
            ax.legend(loc="lower right", bbox_to_anchor=(1.0, 1.0), ncols=2, frameon=False)

    words = "Temperature of the chamber on the plan's clock"
    words += "" if history is None else " (this clock stops while a step waits), as planned and as measured in the run"
    if recipe is None:
        words = "Measured temperature of the chamber on the plan's clock (this clock stops while a step waits)"
    known = recipe is not None or (history is not None and len(history.chamber_s))
    pictures = [picture("temperature", f"{words}.", temperatures, _LOW)] if known else []
    done = {} if history is None else history.rates
    return pictures + [_rate_picture(axis, recipe, done) for axis in (turned_axes(recipe) if recipe else done)]


def _rate_picture(axis: str, recipe: Recipe | None, done: Mapping[str, tuple[np.ndarray, np.ndarray]]) -> Picture:
    """The rate of an axis: in one cycle as planned, and below as executed; without a recipe, in the whole run."""
    curves = {} if recipe is None else {"planned": planned_rate(recipe, axis)}
    curves |= {"done": done[axis]} if axis in done else {}
    begin, end, which = (0.0, float(done[axis][0][-1]), "") if recipe is None else planned_cycle(recipe, axis)

    def draw(*several: Axes) -> None:
        for index, (ax, (label, (time_s, rate))) in enumerate(zip(several, curves.items(), strict=True)):
            inside = (time_s > begin) & (time_s < end)
            shown = np.concatenate([[begin], time_s[inside], [end]])
            # (Of rates that step, the values at the step itself.)
            values = np.concatenate([np.interp([begin], time_s, rate), rate[inside], np.interp([end], time_s, rate)])
            ax.plot((shown - begin) / 60.0, values, label=label, **style_of(index))
            ax.set(ylabel="deg/s", title=label if len(curves) > 1 else "")
        several[-1].set_xlabel("time, min")

    how = f" in {which}: " if which else ", "
    words = f"Rate of table axis {axis}{how}{' and '.join(curves)}" + (
        ", from the commands that were executed." if done else "."
    )
    return picture(f"rate-{axis}", words, draw, _LOW if len(curves) < 2 else _HIGH, rows=len(curves))


def calibration_pictures(calibration: Calibration) -> list[Picture]:
    """The maps of a calibration, and its residuals."""
    draw: list[tuple[str, str, Callable[[Axes], object]]] = []
    over_rate: set[str] = set()
    for channel in calibration.channel:
        if (term := channel.term_of("scale_factor")) is not None and term.rate is not None and term.rate.size > 1:
            over_rate.add(channel.kind)
            words = f"Estimated scale factor of {channel.label}; the bands are ± one standard deviation."
            function = lambda ax, c=channel: draw_calibrated_scale_factor(calibration, c, ax=ax)  # noqa: E731
            draw.append((f"scale-factor-{channel.axis}", words, function))
    for kind, name in panels_of(calibration):
        if name == "bias" or kind not in over_rate:
            words = f"{kind.capitalize()} {name.replace('_', ' ')}, estimated; the bands are ± one standard deviation."
            function = lambda ax, k=kind, n=name: draw_calibrated_term(calibration, k, n, ax=ax)  # noqa: E731
            draw.append((f"{kind}-{name}", words, function))
    # Of six channels, those that a test contradicts.
    failed = {name.partition(":")[0] for name in calibration.contradicted}
    for channel in calibration.channel:
        wanted = len(calibration.channel) <= 3 or channel.name in failed
        if wanted and channel.residuals is not None and sum(channel.residuals.counts):
            words = f"Residuals of {channel.label}, in units of the standard deviation that the spec's noise gives."
            draw.append((f"residuals-{channel.name}", words, lambda ax, c=channel: draw_residuals(c, ax=ax)))
            if channel.residuals.rms:
                words = (
                    f"Root mean square of the residuals of {channel.label} during the run; if the model is correct, "
                    "95 of 100 values are within the band."
                )
                function = lambda ax, c=channel: draw_residual_parts(c, ax=ax)  # noqa: E731
                draw.append((f"residual-parts-{channel.name}", words, function))
    return [picture(picture_key(f"found-{key}"), words, function, _HIGH) for key, words, function in draw]


def _holds(outer: MapFact, inner: MapFact) -> bool:
    if (outer.axis, outer.quantity) != (inner.axis, inner.quantity) or not (outer.maps and inner.maps):
        return False
    one, other = outer.maps[0][1], inner.maps[0][1]
    sides = ((one.temperature_c, other.temperature_c), (one.rate_dps, other.rate_dps))
    return all(bool(wide[0] <= narrow[0] and wide[-1] >= narrow[-1]) for wide, narrow in sides)


def _same(boxes: Sequence[tuple[str, Box]]) -> bool:
    """Whether all curves coincide."""
    first = boxes[0][1].values
    return all(np.allclose(box.values, first, rtol=1e-3) for _, box in boxes)


def _alike(box: Box, other: Box) -> bool:
    """Whether two maps of one box would look alike in colours."""
    if box.values.shape != other.values.shape or not np.all(np.isfinite(box.values) & (other.values > 0.0)):
        return False
    return bool(np.max(np.abs(np.log(box.values / other.values))) < _ALIKE)


def _norm(boxes: Sequence[Box]) -> Normalize:
    """One colour scale for all maps of a requirement."""
    seen = np.concatenate([box.values[np.isfinite(box.values)].ravel() for box in boxes])
    if not len(seen):
        return Normalize(0.0, 1.0)
    low, high = float(seen.min()), float(seen.max())
    if low > 0.0 and high > LOGARITHMIC * low:
        return LogNorm(low, high)
    return Normalize(low, high if high > low else low + 1.0)


def _map(box: Box, label: str, key: str, caption: str, norm: Normalize) -> Picture:
    def draw(ax: Axes) -> None:
        drawn = plots.draw_map(box.temperature_c, box.rate_dps, box.values, box.unit, title=label, ax=ax)
        drawn.mesh.set_norm(norm)
        bar = drawn.mesh.colorbar
        assert bar is not None
        logarithmic = isinstance(norm, LogNorm)
        bar.locator = LogLocator(10.0, subs=(1.0, 2.0, 5.0)) if logarithmic else MaxNLocator(5)
        bar.formatter = FuncFormatter(tick_text)
        bar.minorformatter = NullFormatter()
        if box.unit == "ratio":
            bar.set_label("ratio")
        bar.update_ticks()
        if drawn.contours is not None:
            levels = drawn.contours.levels if box.unit != "ratio" else bar.locator.tick_values(*bar.ax.get_ylim())
            drawn.contours.remove()
            shown = np.ma.masked_invalid(box.values)
            style: Any = {"levels": levels, "colors": "white", "linewidths": 0.7}
            _label(ax, ax.contour(box.rate_dps, box.temperature_c, shown, **style))

    if not np.all(np.isfinite(box.values)):
        caption += " Empty: not observable."
    return picture(key, caption, draw, _HIGH)


def _label(ax: Axes, contours: QuadContourSet) -> None:
    """Add an upright label for each level, inside the map, apart from the others and legible on any colour."""
    kept: list[np.ndarray] = []
    for value, pieces in zip(contours.levels, contours.allsegs, strict=True):
        vertices = np.concatenate([piece for piece in pieces if len(piece)] or [np.zeros((0, 2))])
        places = ax.transAxes.inverted().transform(ax.transData.transform(vertices))
        free = np.all((places > _INSIDE) & (places < 1.0 - _INSIDE), axis=1)
        for other in kept:
            free &= np.any(np.abs(places - other) > _APART, axis=1)
        if not free.any():
            continue
        inside = np.where(free, np.min(np.minimum(places, 1.0 - places), axis=1), -1.0)
        at = int(np.argmax(inside))
        kept.append(places[at])
        box = {"facecolor": "white", "alpha": 0.8, "linewidth": 0.0, "pad": 1.0}
        x, y = (float(place) for place in vertices[at])
        ax.text(x, y, figures(value, 3), fontsize=8, ha="center", va="center", bbox=box)


def _curves(boxes: Sequence[tuple[str, Box]], key: str, where: str, target: float | None, stage: str = "") -> Picture:
    by_rate = len(boxes[0][1].rate_dps) > 1
    words = "the maximum over temperature, against rate" if by_rate else "over temperature"
    caption = f"{where}: residual {stage}".rstrip() + f", {words}, one standard deviation."
    if not all(np.all(np.isfinite(box.values)) for _, box in boxes):
        caption += " If a curve is missing, its quantity is not observable."

    def draw(ax: Axes) -> None:
        plots.draw_curves(boxes, target, ax=ax)
        ax.set_title(stage, loc="left")
        # Above the frame, where it hides no curve.
        handles, names = ax.get_legend_handles_labels()
        short: Any = {"handlelength": 1.6, "handletextpad": 0.5, "columnspacing": 1.0, "borderpad": 0.1}
        ax.legend(
            handles, names, loc="lower right", bbox_to_anchor=(1.0, 1.0), ncols=min(len(names), 4),
            frameon=False, **short,
        )  # fmt: skip

    return picture(key, caption, draw, _HIGH)


def picture_key(name: str) -> str:
    return re.sub(r"[^a-z0-9]+", "-", name.lower()).strip("-") or "requirement"


def picture(
    key: str, caption: str, draw: Callable[..., object], height: float, *, projection: str | None = None, rows: int = 1
) -> Picture:
    """The drawing of `draw`, of a column's width and `height` inches; of several `rows`, it takes the axes of each."""
    with mpl.rc_context(_STYLE):
        figure = Figure(figsize=(_WIDE, height), layout="constrained")
        several = figure.subplots(rows, sharex=True, sharey=True, squeeze=False, subplot_kw={"projection": projection})
        draw(*several.ravel())
        return Picture(key, caption, svg_of(figure, key))


def svg_of(figure: Figure, key: str) -> str:
    """The figure as an `<svg>` for a page: as wide as its column, with ids of its own, without external resources."""
    stream = io.StringIO()
    nothing = dict.fromkeys(("Creator", "Date", "Format", "Type"))
    figure.savefig(stream, format="svg", metadata=nothing)
    text = stream.getvalue()
    text = text[text.index("<svg") :]
    text = re.sub(r"<metadata>.*?</metadata>", "", text, flags=re.S)
    text = re.sub(r"(?<=>)[^<>\n]+(?=</text>)", lambda label: typographic_units(label[0]), text)
    head, rest = text.split(">", 1)
    head = re.sub(r' (width|height)="[^"]*"', "", head)
    text = f'{head} role="img" aria-labelledby="{key}-caption">{rest}'
    text = re.sub(r'\bid="([^"]+)"', rf'id="{key}-\1"', text)
    text = re.sub(r'((?:xlink:)?href)="#([^"]+)"', rf'\1="#{key}-\2"', text)
    return re.sub(r"url\(#([^)]+)\)", rf"url(#{key}-\1)", text).strip()
