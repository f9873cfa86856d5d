"""A calibration certificate as the first part of a page, for a laboratory to sign.

Uncertainties are expanded, U = k·u, with the coverage of the requirement (2 by default). The budget is the exact share
of each input in the variance of a requirement's residual: contributions √share·u add up in squares. The certificate
claims no accreditation; unknown entries are "not stated".
"""

from collections.abc import Iterator, Mapping
from datetime import UTC, date, datetime
from math import isfinite, sqrt
from typing import Final

import numpy as np

import gradcal_jax
from gradcal_jax.calibration import LOG_HASH, Calibration
from gradcal_jax.estimation.calibrations import calibration_map
from gradcal_jax.information.prediction import counted_shares
from gradcal_jax.pages.section import PagePart, PageSection
from gradcal_jax.pages.sources import Sources
from gradcal_jax.pages.tables import COVERAGE, results, tests
from gradcal_jax.records.log import SERIAL_NUMBER
from gradcal_jax.spec.rig import RigFile
from gradcal_jax.tables.table import Column, Table

NOT_STATED: Final = "not stated"
_TEMPERATURES: Final = 5
# Of the variance; below it an input is left out of a budget.
_SMALLEST_SHARE: Final = 5e-4


def certificate_part(sources: Sources, rig: RigFile | None, words: Mapping[str, str]) -> PagePart:
    """The certificate of a calibration. `words`: "number", "customer" and "performed": a date, or the first and the
    last as "2026-11-21..2026-11-22"; by default that of the run. Errors: `ValueError` without a calibration, or for an
    invalid date."""
    calibration = sources.calibration
    if calibration is None:
        raise ValueError("a certificate needs a calibration: name its file, or the folder of a run with a calibration")
    number = words.get("number") or NOT_STATED
    traceability = [
        (r.device, r.identity, r.certificate or NOT_STATED, r.due or NOT_STATED)
        for r in (() if rig is None else rig.reference)
    ]
    standards = Table.of(["standard", "identity", "certificate", "valid until"], traceability)
    none = [] if traceability else ["Not stated: the rig file names no [[reference]]."]
    heading = _heading(sources, calibration, rig, number, words)
    sections = [
        PageSection("Certificate", [], [Table.of(["what", "value"], heading)]),
        PageSection("Method", [_method(sources, calibration)]),
        PageSection("Traceability", none, [standards]),
        PageSection("Conditions", [], [Table.of(["what", "value"], _conditions(calibration))]),
        PageSection("Results", ["Error that remains after correction; U = k·u is the expanded uncertainty."],
                [results(calibration)]),
        PageSection("Uncertainty budget", ["Type B: each input is a figure of the spec, or typical of the class."],
                list(_budgets(sources, calibration))),
        PageSection("Tests", [], [tests(calibration)]),
        PageSection("Corrections", ["Value ± U, with k = 2.", f"{calibration.order}."], [_corrections(calibration)]),
        PageSection("Validity", _validity(calibration)),
        PageSection("Signature", ["This document claims no accreditation. It may be copied only as a whole.",
                              "Date and signature: ______________________________"]),
    ]  # fmt: skip
    return PagePart(f"Calibration certificate {number}", [section for section in sections if not section.is_empty])


def _heading(
    sources: Sources, calibration: Calibration, rig: RigFile | None, number: str, words: Mapping[str, str]
) -> list[tuple[str, str]]:
    laboratory = None if rig is None else rig.laboratory
    where = "" if laboratory is None else ", ".join(filter(None, (laboratory.name, laboratory.address)))
    operator = None if laboratory is None else laboratory.operator
    return [
        ("certificate number", number),
        ("date", datetime.now(UTC).strftime("%Y-%m-%d")),
        ("laboratory", where or NOT_STATED),
        ("customer", words.get("customer") or NOT_STATED),
        ("operator", operator or NOT_STATED),
        ("unit", f"{calibration.title or 'inertial sensor'}, named {calibration.serial_number} in the data"),
        # A name in a rig file or in a log is no number of the device.
        ("serial number", calibration.provenance.get(SERIAL_NUMBER, NOT_STATED)),
        ("performed", _performed(words.get("performed", ""), sources)),
        ("made by", f"gradcal {gradcal_jax.__version__}, which does not sign this certificate"),
    ]


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
            how = "Temperature ramp; references: the angle of the table before and after each turn"
            how += ", and gravity at each pose" if sources.spec.sensor.accelerometer is not None else ""
    estimator = calibration.provenance.get("estimator", NOT_STATED)
    return f"{how}. Estimator: {estimator}. Uncertainties: linear propagation of Gaussian covariances (GUM)."


def _conditions(calibration: Calibration) -> list[tuple[str, str]]:
    rows = [("frame", calibration.frame), ("temperatures and rates", calibration.valid_range)]
    if (digest := calibration.provenance.get(LOG_HASH)) is not None:
        rows.append(("recording (SHA-256)", digest))
    return rows


def _budgets(sources: Sources, calibration: Calibration) -> Iterator[Table]:
    """The budget of each requirement of the plan, scaled to the uncertainty of the estimate."""
    if sources.spec is None:
        return
    shares = counted_shares(sources.spec)
    for row in calibration.result:
        if row.value is None or row.verdict == "not valid":
            continue
        inputs = sorted(shares.get(row.name, {}).items(), key=lambda one: -one[1])
        parts = [(name, 100.0 * part, row.value * sqrt(part)) for name, part in inputs if part >= _SMALLEST_SHARE]
        heads = [f"input of {row.name}", Column("share of the variance", "%", 3), Column("contribution", row.unit, 3)]
        yield Table.of(heads, parts)


def _corrections(calibration: Calibration) -> Table:
    low, high = (float(t) for t in calibration.valid_temperature)
    temperatures = np.linspace(low, high, _TEMPERATURES)
    rows: list[tuple[str, ...]] = []
    for channel in calibration.channel:
        valid = not calibration.contradictions_of(channel)
        for term in channel.term:
            rates = np.degrees([float(r) for r in channel.valid_rate]) if term.rate is not None else np.zeros(1)
            value, deviation = calibration_map(calibration, channel, term.name, temperatures, rates)
            for k, rate in enumerate(rates):
                at = f" at {rate:.4g} deg/s" if term.rate is not None else ""
                pairs = zip(value.values[:, k], deviation.values[:, k], strict=True)
                cells = [_with_uncertainty(float(v), COVERAGE * float(u), valid) for v, u in pairs]
                rows.append((channel.label, term.name.replace("_", " ") + at, *cells, value.unit))
    return Table.of(["channel", "term", *(f"{t:.4g} °C" for t in temperatures), "unit"], rows)


def _with_uncertainty(value: float, expanded: float, valid: bool) -> str:
    if not (valid and isfinite(expanded)):
        return f"{value:.5g}"
    return f"{value:.5g} ± {expanded:.2g}"


def _validity(calibration: Calibration) -> list[str]:
    rows: list[str] = []
    if calibration.contradicted:
        failed = "; ".join(test.replace("_", " ") for test in calibration.contradicted)
        rows.append(f"NOT VALID: the data contradict the model ({failed}); nothing is certified.")
    rows.append(
        "The values are valid for the sensor on the day of the recording, within the temperatures and rates above. The "
        "uncertainty of the bias corrections does not include the turn-on bias, which is different at every power-on."
    )
    if names := dict.fromkeys(error.name for error in calibration.unseen):
        rows.append(f"Every uncertainty includes errors that no residual of the fit can show: {', '.join(names)}.")
    return rows
