"""How objects are shown in a notebook: the tables that their commands print, and a small picture, in HTML."""

import base64
import io
from collections.abc import Callable, Iterator, Mapping, Sequence
from html import escape
from typing import TYPE_CHECKING, Any, Final, NamedTuple

import numpy as np

from gradcal_jax.calibration import Calibration
from gradcal_jax.estimation.estimate import EstimateReport
from gradcal_jax.pages.coefficients import coefficient_table, estimated_coefficients, parameters
from gradcal_jax.recipe.bench_tables import CHAMBER_HEAD, chamber_rows
from gradcal_jax.recipe.recipe import Recipe
from gradcal_jax.records.log import Log
from gradcal_jax.spec.schedule import StandardSchedule
from gradcal_jax.spec.spec_sections import Spec
from gradcal_jax.tables.contracts import Prediction, notice_sentences, requirement_table
from gradcal_jax.units import times_text

if TYPE_CHECKING:
    from matplotlib.axes import Axes

_SIZE: Final = (4.8, 2.4)
_MOST_POINTS: Final = 2000


class _Table(NamedTuple):
    """Rows after a head; the columns numbered in `right` are numbers."""

    rows: Sequence[Sequence[str]]
    right: Sequence[int] = ()


def tables_of(value: Any) -> str:
    """The result in HTML. Errors: `KeyError` for objects of other classes than those of `_PARTS`."""
    return "\n".join(_table(part) if isinstance(part, _Table) else part for part in _PARTS[type(value).__name__](value))


def _prediction(prediction: Prediction) -> Iterator[str | _Table]:
    yield _head(f"Prediction: {prediction.title}" if prediction.title else "Prediction")
    yield _text(times_text(prediction.duration_s, prediction.soak_s, prediction.motion_s))
    if prediction.requirements:
        yield _Table(requirement_table(prediction.requirements), (2, 3, 4, 5))
        yield from _shares(prediction)
    yield _Table(*coefficient_table(parameters(prediction, None, {})))
    yield _list([*notice_sentences(prediction.notices), *prediction.warnings])


def _shares(prediction: Prediction) -> Iterator[str]:
    """The residual of each requirement that has a target, in shares of it."""
    rows = [row for row in prediction.requirements if row.target and row.judged is not None][::-1]

    def draw(ax: "Axes") -> None:
        shares = [100.0 * (row.coverage or 1.0) * (row.judged or 0.0) / (row.target or 1.0) for row in rows]
        ax.barh([row.name for row in rows], shares)
        ax.axvline(100.0, color="black", linewidth=0.8)
        ax.set_xlabel("share of the target, %")

    if rows:
        yield _picture(draw)


def _spec(spec: Spec) -> Iterator[str | _Table]:
    first, *lines = repr(spec).splitlines()
    yield _head(first)
    yield "<pre>" + escape("\n".join(lines)) + "</pre>"
    schedule = spec.schedule
    if isinstance(schedule, StandardSchedule):
        each = schedule.duration / len(schedule.temperatures)
        points = [at for k, t in enumerate(schedule.temperatures) for at in ((k * each, t), ((k + 1) * each, t))]
    else:
        ends = [((s.start, s.temperature_start), (s.end, s.temperature_end)) for s in schedule.segments]
        points = [at for pair in ends for at in pair]

    def draw(ax: "Axes") -> None:
        ax.plot([start / 3600.0 for start, _ in points], [temperature for _, temperature in points])
        ax.set(xlabel="time, h", ylabel="chamber, °C")

    yield _picture(draw)


def _recipe(recipe: Recipe) -> Iterator[str | _Table]:
    yield _head(recipe.title or "Recipe")
    yield _text(f"{recipe.made.by}; {recipe.status}; recipe {recipe.fingerprint[:12]}")
    yield _Table([CHAMBER_HEAD, *chamber_rows(recipe)])
    yield _Table(requirement_table(recipe.prediction.requirements), (2, 3, 4, 5))

    def draw(ax: "Axes") -> None:
        from gradcal_jax.plots import draw_planned_temperature

        draw_planned_temperature(recipe, ax=ax)

    yield _picture(draw)


def _estimate(report: EstimateReport) -> Iterator[str | _Table]:
    for one in report.sensors:
        yield _head("Estimate of " + _named(one.unit, one.calibration.simulated))
        yield _text(f"{len(one.solution.weights)} readings; {one.calibration.valid_range}")
        yield _Table(*estimated_coefficients(one.calibration))
        yield _tests(one.calibration)
        yield from _map_pictures(one.calibration)
        if one.requirements:
            yield _Table(requirement_table(one.requirements), (2, 3, 4, 5))
        yield _list(one.messages)


def _tests(calibration: Calibration) -> _Table:
    rows = [(t.name, f"{t.statistic:.1f}", str(t.degrees), f"{t.chance:.2g}") for t in calibration.fit]
    return _Table([("test", "statistic", "degrees", "p-value"), *rows], (1, 2, 3))


def _calibration(calibration: Calibration) -> Iterator[str | _Table]:
    yield _head("Calibration of " + _named(calibration.serial_number, calibration.simulated))
    yield _text("; ".join(filter(None, (calibration.title, calibration.valid_range))))
    yield _Table(*coefficient_table(parameters(None, calibration, {})))
    yield from _map_pictures(calibration)
    if calibration.result:
        yield _Table(
            [("requirement", "statistic", "residual 1σ", "target", "verdict"), *calibration.result_rows], (2, 3)
        )
    if calibration.fit:
        yield _tests(calibration)
    yield _list([*(f"not observable: {name}" for name in calibration.unobservable), calibration.lacks or ""])


def _map_pictures(calibration: Calibration) -> Iterator[str]:
    """The first map of the calibration over temperature."""
    from gradcal_jax.plots.calibration_maps import panels_of

    def draw(ax: "Axes") -> None:
        from gradcal_jax.plots import draw_calibrated_term

        draw_calibrated_term(calibration, *maps[0], ax=ax)

    if (maps := panels_of(calibration)) and calibration.covariance is not None:
        yield _picture(draw)


def _log(log: Log) -> Iterator[str | _Table]:
    heading, *_ = log.summary_lines()
    yield _head(heading)
    for unit in log.units:
        yield _Table([(f"rows of {unit}", "number"), *((use, str(n)) for use, n in log.counts(unit).items())], (1,))
    if log.findings:
        yield _Table([("action", "fault"), *((finding.done, finding.message) for finding in log.findings)])
    every = max(1, len(log.time_s) // _MOST_POINTS)

    def draw(ax: "Axes") -> None:
        for k, axis in enumerate(log.axes):
            ax.plot(
                log.time_s[::every] / 3600.0, np.degrees(log.rate_rad_per_s[0, ::every, k]), linewidth=0.5, label=axis
            )
        ax.set(xlabel="time, h", ylabel="rate, deg/s")
        ax.legend()

    if log.axes:
        yield _picture(draw)


_PARTS: Final[Mapping[str, Callable[[Any], Iterator[str | _Table]]]] = {
    "Prediction": _prediction,
    "EstimateReport": _estimate,
    "Calibration": _calibration,
    "Log": _log,
    "Spec": _spec,
    "Recipe": _recipe,
}


def _named(serial_number: str, simulated: bool) -> str:
    return serial_number + (", SIMULATED" if simulated else "")


def _picture(draw: "Callable[[Axes], None]") -> str:
    """A small picture within the HTML."""
    from gradcal_jax.plots.style import new_axes

    ax, image = new_axes(None, _SIZE), io.BytesIO()
    draw(ax)
    ax.get_figure(root=True).savefig(image, format="png", dpi=80)  # pyright: ignore[reportOptionalMemberAccess]
    return f'<img alt="" src="data:image/png;base64,{base64.b64encode(image.getvalue()).decode()}">'


def _head(text: str) -> str:
    return f"<p><b>{escape(text)}</b></p>"


def _text(text: str) -> str:
    return f"<p>{escape(text)}</p>"


def _list(sentences: Sequence[str]) -> str:
    items = "".join(f"<li>{escape(sentence)}</li>" for sentence in sentences if sentence)
    return f"<ul>{items}</ul>" if items else ""


def _table(table: _Table) -> str:
    head, *rows = table.rows
    lines = ["<table>", _row(head, "th", table.right), *(_row(row, "td", table.right) for row in rows), "</table>"]
    return "\n".join(lines)


def _row(cells: Sequence[str], tag: str, right: Sequence[int]) -> str:
    shown = (
        f'<{tag} style="text-align: {"right" if k in right else "left"}">{escape(cell)}</{tag}>'
        for k, cell in enumerate(cells)
    )
    return f"<tr>{''.join(shown)}</tr>"
