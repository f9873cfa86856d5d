"""A calibration certificate of one sensor in two parts, for a laboratory to sign, from calibration, run and rig file.

Uncertainties are expanded, U = k·u, with the coverage of the requirement (2 by default). The budget is the exact share
of each input in the variance of a requirement's residual: contributions √share·u add up in squares. The certificate
claims no accreditation; unknown entries are "not stated".
"""

import re
from collections.abc import Iterator, Sequence
from datetime import UTC, date, datetime
from math import sqrt
from pathlib import Path
from typing import Any, Final, NamedTuple

import numpy as np

import gradcal_jax
from gradcal_jax.calibration import LOG_HASH, CalibratedChannel, Calibration, Result
from gradcal_jax.estimation.calibrations import calibration_map
from gradcal_jax.information.prediction import counted_shares
from gradcal_jax.information.verdicts import finite, specific_risk
from gradcal_jax.pages.numbers import figures, one_sign, percent, with_uncertainty
from gradcal_jax.pages.requirements import SUMMED
from gradcal_jax.pages.sources import Sources, stated_figures
from gradcal_jax.pages.templates import page_file, page_templates
from gradcal_jax.records.log import SERIAL_NUMBER
from gradcal_jax.spec.absent import with_typical
from gradcal_jax.spec.rig import Laboratory, RigFile
from gradcal_jax.tables.writing import write_whole

NOT_STATED: Final = "not stated"
_COVERAGE: Final = 2.0
_TEMPERATURES: Final = 7
# Of the variance; below it an input is left out of a budget.
_SMALLEST_SHARE: Final = 5e-4


class Input(NamedTuple):
    """A line of the uncertainty budget: an input's value, its share of the variance, and its contribution."""

    name: str
    value: str
    distribution: str
    type: str
    sensitivity: float
    contribution: float


class Budget(NamedTuple):
    """The uncertainty budget of one requirement: `total` is the standard uncertainty, in `unit`."""

    requirement: str
    axis: str
    unit: str
    total: float
    inputs: tuple[Input, ...]


class ResultRow(NamedTuple):
    """A requirement: standard and expanded uncertainty, maximum, target, verdict, decision rule and risk."""

    name: str
    axis: str
    statistic: str
    unit: str
    standard: float | None
    coverage: float
    expanded: float | None
    worst: float | None
    target: float | None
    verdict: str
    rule: str
    risk: float | None


class Correction(NamedTuple):
    """A correction of one channel over temperature: the value of `term` in `unit` and its expanded uncertainty U at
    each of `temperature_c`; U is None where it is not known. A map over rate has one at each end of its rates."""

    channel: str
    term: str
    unit: str
    temperature_c: tuple[float, ...]
    value: tuple[float, ...]
    expanded: tuple[float | None, ...]


class Certificate(NamedTuple):
    """The contents of the two parts."""

    heading: tuple[tuple[str, str], ...]
    laboratory: Laboratory | None
    method: str
    traceability: tuple[tuple[str, str, str, str], ...]
    conditions: tuple[tuple[str, str], ...]
    results: tuple[ResultRow, ...]
    budgets: tuple[Budget, ...]
    fit: tuple[tuple[str, float, int, float], ...]
    corrections: tuple[Correction, ...]
    order: str
    serial_number: str
    validity: tuple[str, ...]
    simulated: bool


def certificate_of(
    sources: Sources,
    rig: RigFile | None = None,
    *,
    number: str = "",
    customer: str = "",
    operator: str = "",
    performed: str = "",
) -> Certificate:
    """The contents of a certificate. `performed`: a date, or the
    first and the last as "2026-11-21..2026-11-22"; by default that of the run. Errors: `ValueError` without a
    calibration, or for an invalid date."""
    calibration = sources.calibration
    if calibration is None:
        raise ValueError("a certificate needs a calibration: name its file, or the folder of a run with a calibration")
    laboratory = None if rig is None else rig.laboratory
    who = operator or ("" if laboratory is None or laboratory.operator is None else laboratory.operator)
    where = "" if laboratory is None else ", ".join(filter(None, (laboratory.name, laboratory.address)))
    number_of_unit = calibration.provenance.get(SERIAL_NUMBER, NOT_STATED)
    heading = (
        ("certificate number", number or NOT_STATED),
        ("date", datetime.now(UTC).strftime("%Y-%m-%d")),
        ("laboratory", where or NOT_STATED),
        ("customer", customer or NOT_STATED),
        ("operator", who or NOT_STATED),
        # A name in a rig file or in a log is no number of the device.
        ("unit", f"{calibration.title or 'inertial sensor'}, named {calibration.serial_number} in the data"),
        ("serial number", number_of_unit),
        ("performed", _performed(performed, sources)),
    )
    return Certificate(
        heading=heading,
        laboratory=laboratory,
        method=_method(sources, calibration),
        traceability=tuple(
            (r.device, r.identity, r.certificate or NOT_STATED, r.due or NOT_STATED)
            for r in (() if rig is None else rig.reference)
        ),
        conditions=_conditions(calibration),
        results=tuple(_result(row) for row in calibration.result),
        budgets=tuple(_budgets(sources)),
        fit=tuple((t.name.replace("_", " "), t.statistic, t.degrees, t.chance) for t in calibration.fit),
        corrections=tuple(row for channel in calibration.channel for row in _corrections(calibration, channel)),
        order=calibration.order,
        serial_number=number_of_unit,
        validity=_validity(calibration),
        simulated=calibration.simulated,
    )


def _performed(stated: str, sources: Sources) -> str:
    text = stated or ("" if sources.run is None else str(sources.run.notes().get("begun", ""))[:10])
    try:
        days = [date.fromisoformat(day) for day in text.split("..")] if text else []
    except ValueError:
        days = []
    if text and not (len(days) in (1, 2) and days == sorted(days)):
        raise ValueError(f'expected a date such as "2026-11-22", or "2026-11-21..2026-11-22", not "{text}"')
    return text or NOT_STATED


def _method(sources: Sources, calibration: Calibration) -> str:
    how = "As recorded in the log"
    if sources.spec is not None:
        how = "Stable temperatures, with a reference rate at each"
        if sources.spec.plan.method == "gradient":
            parts = ["Temperature ramp; references: the angle of the table before and after each turn"]
            parts += ["gravity at each pose"] if sources.spec.sensor.accelerometer is not None else []
            how = ", and ".join(parts)
    estimator = calibration.provenance.get("estimator", NOT_STATED)
    return (
        f"{how}. Estimator: {estimator}. Uncertainties are computed by linear propagation of Gaussian covariances "
        "(GUM)."
    )


def _conditions(calibration: Calibration) -> tuple[tuple[str, str], ...]:
    rows = [("frame", calibration.frame)]
    spans = [(f"{c.valid_temperature[0]} to {c.valid_temperature[1]}", c) for c in calibration.channel]
    spans += [(f"{c.valid_rate[0]} to {c.valid_rate[1]}", c) for c in calibration.channel if c.kind == "gyro"]
    ranges: dict[tuple[str, str], list[str]] = {}
    for k, (span, channel) in enumerate(spans):
        what = "temperature" if k < len(calibration.channel) else "rates"
        ranges.setdefault((what, span), []).append(channel.label)
    rows += [(f"{what}, {', '.join(labels)}", span) for (what, span), labels in ranges.items()]
    if (digest := calibration.provenance.get(LOG_HASH)) is not None:
        rows.append(("recording (SHA-256)", digest))
    return tuple(rows)


def _validity(calibration: Calibration) -> tuple[str, ...]:
    rows: list[str] = []
    if calibration.contradicted:
        failed = "; ".join(test.replace("_", " ") for test in calibration.contradicted)
        rows.append(f"NOT VALID: the data contradict the model ({failed}); nothing is certified.")
    rows += [
        "The values are valid for the sensor on the day of the recording, within the temperatures and rates "
        "above. Outside these ranges, the values at their edges apply, without a stated uncertainty.",
        "The stated uncertainty of the bias corrections does not include the turn-on bias, which is different at "
        "every power-on. The result of a bias requirement includes the turn-on bias, unless the requirement is for a "
        "single run.",
    ]
    if names := dict.fromkeys(error.name for error in calibration.unseen):
        rows.append(
            f"Every uncertainty also includes errors that the residuals of the fit cannot show: {', '.join(names)}."
        )
    if calibration.unobservable:
        rows.append(f"The data do not observe: {', '.join(calibration.unobservable)}.")
    return tuple(rows)


def _result(row: Result) -> ResultRow:
    k = row.coverage or _COVERAGE
    if row.verdict == "not valid":
        # Nothing is certified of a unit whose data contradict the model.
        row = row.model_copy(update={"value": None, "worst": None})
    expanded = None if row.value is None else k * row.value
    risk = None
    if row.verdict in ("met", "missed") and row.target is not None and row.worst is not None:
        risk = specific_risk(0.0, row.worst, row.target)
    what = row.name, _elements(row.axis), row.statistic.removesuffix(", 1 sigma"), row.unit
    judged = row.verdict or "no limit stated", row.rule or "", risk
    return ResultRow(*what, row.value, k, expanded, row.worst, row.target, *judged)


def _budgets(sources: Sources) -> Iterator[Budget]:
    """The budget of each requirement of the plan, scaled to the uncertainty of the estimate."""
    spec, calibration = sources.spec, sources.calibration
    if spec is None or calibration is None:
        return
    stated = stated_figures(with_typical(spec))
    shares = counted_shares(spec)
    for row in calibration.result:
        parts = shares.get(row.name, {})
        if not parts or row.value is None or row.verdict == "not valid":
            continue
        inputs = (
            Input(part, _value_of(part, row.quantity, stated), "normal", "B", share, row.value * sqrt(max(share, 0.0)))
            for part, share in parts.items()
            if share >= _SMALLEST_SHARE
        )
        yield Budget(row.name, _elements(row.axis), row.unit, row.value, tuple(inputs))


def _value_of(part: str, quantity: str, stated: Sequence[tuple[str, str]]) -> str:
    """The figures of an input of the budget, those of several axes together."""
    of_accelerometer = quantity.startswith("accelerometer") or quantity == "second_order"
    for name in (f"accelerometer {part}", part)[not of_accelerometer :]:
        pattern = re.compile(rf"(.*: )?{re.escape(name)}( error|, \d+ a turn| \d+)?")
        if own := dict.fromkeys(value for of, value in stated if pattern.fullmatch(of)):
            return "; ".join(own)
    return NOT_STATED


def _elements(axis: str) -> str:
    """The axis of a result, or how several elements are summed up."""
    return SUMMED.get(axis, f"axis {axis}")


def _corrections(calibration: Calibration, channel: CalibratedChannel) -> list[Correction]:
    low, high = (float(t) for t in channel.valid_temperature)
    temperatures = np.linspace(low, high, _TEMPERATURES if len(calibration.channel) <= 3 else 3)
    rows: list[Correction] = []
    for term in channel.term:
        ends = np.degrees([float(r) for r in channel.valid_rate]) if term.rate is not None else np.zeros(1)
        value, deviation = calibration_map(calibration, channel, term.name, temperatures, ends)
        for k, rate in enumerate(ends):
            at = f" at {rate:.4g} deg/s" if term.rate is not None else ""
            expanded = [finite(_COVERAGE * float(u)) for u in deviation.values[:, k]]
            known = [None] * len(expanded) if calibration.contradictions_of(channel) else expanded
            name = term.name.replace("_", " ") + at
            values = tuple(float(v) for v in value.values[:, k])
            rows.append(Correction(channel.label, name, value.unit, tuple(temperatures.tolist()), values, tuple(known)))
    return rows


def certificate_tables(certificate: Certificate) -> dict[str, Any]:
    """The certificate as plain numbers and texts, for `--json`."""
    return certificate._asdict() | {
        "heading": dict(certificate.heading),
        "laboratory": certificate.laboratory and certificate.laboratory.model_dump(),
        "conditions": dict(certificate.conditions),
        "traceability": [
            dict(zip(("device", "identity", "certificate", "due"), r, strict=True)) for r in certificate.traceability
        ],
        "results": [row._asdict() for row in certificate.results],
        "budgets": [b._asdict() | {"inputs": [i._asdict() for i in b.inputs]} for b in certificate.budgets],
        "fit": [dict(zip(("test", "statistic", "degrees", "chance"), r, strict=True)) for r in certificate.fit],
        "corrections": [row._asdict() for row in certificate.corrections],
        "made_by": f"gradcal {gradcal_jax.__version__}",
    }


def _shown(value: float | None, digits: int = 4, unit: str = "") -> str:
    """A value in its unit; a dash alone where it is not known."""
    return "–" if value is None else f"{figures(value, digits)} {unit}".rstrip()


def _corrected(value: float, expanded: float | None) -> str:
    """A correction; without an uncertainty if none is valid."""
    return figures(value, 5) if expanded is None else with_uncertainty(value, expanded)


def write_certificate(certificate: Certificate, output: str | Path) -> None:
    """The two parts as one HTML file. Errors: `OSError` where it cannot be written."""
    template = page_templates(figures=_shown, percent=percent, corrected=_corrected).get_template("certificate.html")
    program = f"gradcal {gradcal_jax.__version__}"
    write_whole(output, one_sign(template.render(c=certificate, css=page_file("style.css"), program=program)))
