"""A calibration certificate as the first part of a page, for a laboratory to sign.

Uncertainties are expanded, U = k·u, with the coverage of the requirement (2 by default). The budget is the exact share
of each input in the variance of a requirement's residual: contributions √share·u add up in squares. The certificate
claims no accreditation; unknown entries are "not stated".
"""

from collections.abc import Iterator, Mapping
from datetime import UTC, datetime
from math import sqrt
from typing import Final

import gradcal_jax
from gradcal_jax.calibration.file import LOG_HASH, Calibration
from gradcal_jax.information.prediction import counted_shares
from gradcal_jax.pages.section import PagePart, PageSection
from gradcal_jax.pages.sources import Sources
from gradcal_jax.pages.tables import results
from gradcal_jax.records.log import SERIAL_NUMBER
from gradcal_jax.spec.rig import RigFile
from gradcal_jax.tables.table import Column, Table

NOT_STATED: Final = "not stated"
# Of the variance; below it an input is left out of a budget.
_SMALLEST_SHARE: Final = 5e-4


def certificate_part(sources: Sources, rig: RigFile | None, words: Mapping[str, str]) -> PagePart:
    """The certificate of a calibration; `words`: "number" and "customer". Errors: `ValueError` without a
    calibration."""
    calibration, spec = sources.calibration, sources.spec
    if calibration is None:
        raise ValueError("a certificate needs a calibration: name its file, or the folder of a run with a calibration")
    laboratory, known = None if rig is None else rig.laboratory, calibration.provenance
    method = "As recorded in the log"
    if spec is not None:
        gravity = ", and gravity at each pose" if spec.sensor.accelerometer is not None else ""
        method = "Stable temperatures, with a reference rate at each"
        if spec.plan.method == "gradient":
            method = f"Temperature ramp; references: the angle of the table before and after each turn{gravity}"
    stated = {
        "certificate number": words.get("number"),
        "date": datetime.now(UTC).strftime("%Y-%m-%d"),
        "laboratory": "" if laboratory is None else ", ".join(filter(None, (laboratory.name, laboratory.address))),
        "operator": None if laboratory is None else laboratory.operator,
        "customer": words.get("customer"),
        "unit": f"{calibration.title or 'inertial sensor'}, named {calibration.serial_number} in the data",
        # A name in a rig file or in a log is no number of the device.
        "serial number": known.get(SERIAL_NUMBER),
        "performed": "" if sources.run is None else str(sources.run.notes().get("begun", ""))[:10],
        "method": f"{method}. Estimator: {known.get('estimator', NOT_STATED)}. Uncertainties: linear propagation of "
        "Gaussian covariances (GUM).",
        "frame": calibration.frame,
        "temperatures and rates": calibration.valid_range,
        "recording (SHA-256)": known.get(LOG_HASH),
        "corrections": f"the coefficients on this page. {calibration.order}",
        "made by": f"gradcal {gradcal_jax.__version__}, which does not sign this certificate",
    }
    references = [
        (r.device, r.identity, r.certificate or NOT_STATED, r.due or NOT_STATED)
        for r in (() if rig is None else rig.reference)
    ]
    standards = Table.of(["standard", "identity", "certificate", "valid until"], references)
    none = [] if references else ["Not stated: the rig file names no [[reference]]."]
    heading = Table.of(["what", "value"], [(name, text or NOT_STATED) for name, text in stated.items()])
    sections = [
        PageSection("Certificate", [], [heading]),
        PageSection("Traceability", none, [standards]),
        PageSection("Results", ["Error that remains after correction; U = k·u is the expanded uncertainty."],
                [results(calibration)]),
        PageSection("Uncertainty budget", ["Type B: each input is a figure of the spec, or typical of the class."],
                list(_budgets(sources, calibration))),
        PageSection("Validity", [*_validity(calibration),
                    "This document claims no accreditation. It may be copied only as a whole.",
                    "Date and signature: ______________________________"]),
    ]  # fmt: skip
    title = " ".join(filter(None, ("Calibration certificate", words.get("number"))))
    return PagePart(title, [section for section in sections if not section.is_empty])


def _budgets(sources: Sources, calibration: Calibration) -> Iterator[Table]:
    """The budget of each requirement of the plan, scaled to the uncertainty of the estimate."""
    shares = {} if sources.spec is None else counted_shares(sources.spec)
    for row in calibration.result:
        if row.name not in shares or row.value is None or row.verdict == "not valid":
            continue
        inputs = sorted(shares[row.name].items(), key=lambda one: -one[1])
        parts = [(name, 100.0 * part, row.value * sqrt(part)) for name, part in inputs if part >= _SMALLEST_SHARE]
        heads = [f"input of {row.name}", Column("share of the variance", "%", 3), Column("contribution", row.unit, 3)]
        yield Table.of(heads, parts)


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
