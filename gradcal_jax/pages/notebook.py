"""Results as they show themselves in a notebook: the tables that their commands print, in HTML."""

from collections.abc import Callable, Iterator, Mapping, Sequence
from html import escape
from typing import Any, Final, NamedTuple

from gradcal_jax.api.estimate import EstimateReport
from gradcal_jax.files.calibration import Calibration
from gradcal_jax.files.contracts import Prediction
from gradcal_jax.files.log import Log
from gradcal_jax.files.requirement_table import requirement_table
from gradcal_jax.pages.coefficients import coefficient_table, estimated_coefficients, parameters
from gradcal_jax.units import times_text


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
    yield _Table(*coefficient_table(parameters(prediction, None, {})))
    yield _list([row.sentence for row in prediction.notices] + list(prediction.warnings))


def _estimate(report: EstimateReport) -> Iterator[str | _Table]:
    for one in report.sensors:
        yield _head("Estimate of " + _named(one.unit, one.calibration.simulated))
        yield _text(f"{len(one.solution.weights)} readings; {one.calibration.valid_range}")
        yield _Table(*estimated_coefficients(one.calibration))
        yield _tests(one.calibration)
        if one.requirements:
            yield _Table(requirement_table(one.requirements), (2, 3, 4, 5))
        yield _list(one.messages)


def _tests(calibration: Calibration) -> _Table:
    rows = [(t.name, f"{t.statistic:.1f}", str(t.degrees), f"{t.chance:.2g}") for t in calibration.fit]
    return _Table([("test", "statistic", "degrees", "chance"), *rows], (1, 2, 3))


def _calibration(calibration: Calibration) -> Iterator[str | _Table]:
    yield _head("Calibration of " + _named(calibration.serial_number, calibration.simulated))
    yield _text("; ".join(filter(None, (calibration.title, calibration.valid_range))))
    yield _Table(*coefficient_table(parameters(None, calibration, {})))
    if calibration.result:
        yield _Table(
            [("requirement", "statistic", "residual 1σ", "target", "verdict"), *calibration.result_rows], (2, 3)
        )
    if calibration.fit:
        yield _tests(calibration)
    yield _list([*(f"not observable: {name}" for name in calibration.unobservable), calibration.lacks or ""])


def _log(log: Log) -> Iterator[str | _Table]:
    heading, *_ = log.summary_lines()
    yield _head(heading)
    for unit in log.units:
        yield _Table([(f"rows of {unit}", "number"), *((use, str(n)) for use, n in log.counts(unit).items())], (1,))
    if log.findings:
        yield _Table([("action", "fault"), *((finding.done, finding.message) for finding in log.findings)])


_PARTS: Final[Mapping[str, Callable[[Any], Iterator[str | _Table]]]] = {
    "Prediction": _prediction,
    "EstimateReport": _estimate,
    "Calibration": _calibration,
    "Log": _log,
}


def _named(serial_number: str, simulated: bool) -> str:
    return serial_number + (", SIMULATED" if simulated else "")


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
