"""A certificate as a Digital Calibration Certificate (DCC), XML of the Physikalisch-Technische Bundesanstalt: schema
3.2.1 with quantities in the Digital System of Units, D-SI 2.1.0.

All values are in SI (rad/s, ratios, degrees Celsius). An error that is left after correction has the best estimate 0
and the expanded uncertainty U = k·u; a certificate without a required entry is refused.
"""

import math
import xml.etree.ElementTree as ET
from pathlib import Path
from typing import Final

import gradcal_jax
from gradcal_jax.api.imu_residual import UNITS_OF_TERMS
from gradcal_jax.files.writing import write_whole
from gradcal_jax.pages.certificate import NOT_STATED, Certificate, Correction, ResultRow

VERSION: Final = "3.2.1"
_DCC: Final = "https://ptb.de/dcc"
_SI: Final = "https://ptb.de/si"
_XSI: Final = "http://www.w3.org/2001/XMLSchema-instance"
_ONE: Final = r"\one"
_CELSIUS: Final = r"\degreecelsius"
# SI units in the D-SI's spelling.
_D_SI: Final = {
    "1": _ONE,
    "rad": r"\radian",
    "m": r"\metre",
    "rad/s": r"\radian\second\tothe{-1}",
    "m/s^2": r"\metre\second\tothe{-2}",
    "1/K": r"\kelvin\tothe{-1}",
    "rad/K": r"\radian\kelvin\tothe{-1}",
    "s/K": r"\second\kelvin\tothe{-1}",
    "rad/s/K": r"\radian\second\tothe{-1}\kelvin\tothe{-1}",
    "m/s/K": r"\metre\second\tothe{-1}\kelvin\tothe{-1}",
    "m/s^2/K": r"\metre\second\tothe{-2}\kelvin\tothe{-1}",
    "rad/s/(m/s^2)": r"\radian\second\metre\tothe{-1}",
    "rad/s/(m/s^2)^2": r"\radian\second\tothe{3}\metre\tothe{-2}",
    "1/(m/s^2)": r"\second\tothe{2}\metre\tothe{-1}",
    "1/(m/s^2)^2": r"\second\tothe{4}\metre\tothe{-2}",
}
# The certificate's units: how many SI units one of them is, and which.
_IN_SI: Final = {shown: (1.0 / factor, _D_SI[si]) for si, (shown, factor) in UNITS_OF_TERMS.items()} | {
    "m": (1.0, _D_SI["m"]),
    "deg": (math.pi / 180.0, _D_SI["rad"]),
}


def write_dcc(certificate: Certificate, path: str | Path) -> None:
    """Write a certificate as a DCC. Errors: `ValueError` where a required entry is missing; `OSError`."""
    for prefix, space in (("dcc", _DCC), ("si", _SI), ("xsi", _XSI)):
        ET.register_namespace(prefix, space)
    root = _document(certificate)
    ET.indent(root)
    text = ET.tostring(root, encoding="unicode")
    write_whole(path, f'<?xml version="1.0" encoding="UTF-8"?>\n{text}\n')


def _document(certificate: Certificate) -> ET.Element:
    stated = dict(certificate.heading)
    if (laboratory := certificate.laboratory) is None or laboratory.country is None:
        raise ValueError('a DCC names the laboratory and its country: [laboratory] name = "…", country = "DE" in --rig')
    for key, option in (("certificate number", "--number"), ("performed", "--performed 2026-11-22")):
        if stated[key] == NOT_STATED:
            raise ValueError(f"a DCC says the {key}: give {option}")
    begin, _, end = stated["performed"].partition("..")
    root = ET.Element(f"{{{_DCC}}}digitalCalibrationCertificate", {"schemaVersion": VERSION})
    root.set(f"{{{_XSI}}}schemaLocation", f"{_DCC} {_DCC}/v{VERSION}/dcc.xsd")
    data = _add(root, "administrativeData")
    software = _add(_add(data, "dccSoftware"), "software")
    _text(software, "name", "gradcal")
    _add(software, "release", gradcal_jax.__version__)
    _add(software, "type", "application")
    core = _add(data, "coreData")
    _add(core, "countryCodeISO3166_1", laboratory.country)
    _add(core, "usedLangCodeISO639_1", "en")
    _add(core, "mandatoryLangCodeISO639_1", "en")
    _add(core, "uniqueIdentifier", stated["certificate number"])
    _add(core, "beginPerformanceDate", begin)
    _add(core, "endPerformanceDate", end or begin)
    _add(core, "performanceLocation", "laboratory")
    _add(core, "issueDate", stated["date"])
    item = _add(_add(data, "items"), "item")
    _text(item, "name", stated["unit"])
    identification = _add(_add(item, "identifications"), "identification")
    _add(identification, "issuer", "manufacturer")
    _add(identification, "value", certificate.serial_number)
    _text(identification, "name", "serial number")
    _contact(_add(_add(data, "calibrationLaboratory"), "contact"), laboratory.name, laboratory.address)
    person = _add(_add(data, "respPersons"), "respPerson")
    _text(_add(person, "person"), "name", stated["operator"])
    _add(person, "mainSigner", "true")
    _contact(_add(data, "customer"), stated["customer"], None)
    statements = _add(data, "statements")
    sentences = ["This document claims no accreditation.", *certificate.validity]
    if certificate.simulated:
        sentences.insert(
            0, "SIMULATED: the data come from simulated devices. This is not a certificate of a real sensor."
        )
    for sentence in sentences:
        _text(_add(statements, "statement"), "declaration", sentence)
    _measurement(_add(_add(root, "measurementResults"), "measurementResult"), certificate)
    return root


def _measurement(result: ET.Element, certificate: Certificate) -> None:
    _text(result, "name", "Calibration of bias and scale factor")
    method = _add(_add(result, "usedMethods"), "usedMethod")
    _text(method, "name", "Calibration of an inertial sensor over temperature and rate")
    _text(method, "description", certificate.method)
    if certificate.traceability:
        equipments = _add(result, "measuringEquipments")
        for device, identity, number, due in certificate.traceability:
            equipment = _add(equipments, "measuringEquipment")
            _text(equipment, "name", device)
            _text(equipment, "description", f"certificate {number}, valid until {due}")
            identification = _add(_add(equipment, "identifications"), "identification")
            _add(identification, "issuer", "owner")
            _add(identification, "value", identity)
    conditions = _add(result, "influenceConditions")
    for name, words in certificate.conditions:
        condition = _add(conditions, "influenceCondition")
        _text(condition, "name", name)
        _text(_add(condition, "data"), "text", words)
    results = _add(result, "results")
    for row in certificate.results:
        _error(results, row)
    for channel in dict.fromkeys(row.channel for row in certificate.corrections):
        _corrections(results, channel, [row for row in certificate.corrections if row.channel == channel])
    for budget in certificate.budgets:
        factor, unit = _IN_SI[budget.unit]
        data = _result(results, f"Uncertainty budget: {budget.requirement}, {budget.axis}")
        for entry in budget.inputs:
            words = f"{entry.name} ({entry.value}; {entry.distribution}, type {entry.type}): contribution to u"
            _real(data, words, entry.contribution * factor, unit)
    for name, statistic, degrees, chance in certificate.fit:
        data = _result(results, f"Test of the fit: {name}")
        for words, value in (("statistic", statistic), ("degrees of freedom", float(degrees)), ("chance", chance)):
            _real(data, words, value, _ONE)


def _error(results: ET.Element, row: ResultRow) -> None:
    """A requirement: the error that is left, its limit, and the decision."""
    if row.standard is None or row.expanded is None:
        return
    factor, unit = _IN_SI[row.unit]
    data = _result(results, f"{row.name}, {row.axis}: error after correction")
    # The schema has no coverage factor below 1.
    k = max(row.coverage, 1.0)
    quantity = _real(data, "error after correction", 0.0, unit, (k * row.standard * factor, k))
    if row.target is not None:
        _real(data, "limit on the error", row.target * factor, unit)
    if row.worst is not None:
        _real(data, "standard uncertainty at the worst point", row.worst * factor, unit)
    if row.risk is not None:
        _real(data, "specific risk (JCGM 106) at the worst point", row.risk, _ONE)
    if row.rule and row.verdict in ("met", "missed"):
        meta = _add(_add(quantity, "measurementMetaData"), "metaData")
        _text(meta, "declaration", f"Decision rule: {row.rule}.")
        _add(meta, "conformity", "pass" if row.verdict == "met" else "fail")


def _corrections(results: ET.Element, channel: str, rows: list[Correction]) -> None:
    data = _add(_result(results, f"Corrections of {channel} over temperature"), "list")
    _reals(data, "temperature", list(rows[0].temperature_c), _CELSIUS)
    for row in rows:
        factor, unit = _IN_SI[row.unit]
        known = [factor * u for u in row.expanded if u is not None]
        values = [value * factor for value in row.value]
        _reals(data, row.term, values, unit, known if len(known) == len(values) else None)


def _result(results: ET.Element, name: str) -> ET.Element:
    result = _add(results, "result")
    _text(result, "name", name)
    return _add(result, "data")


def _real(
    data: ET.Element, words: str, value: float, unit: str, expanded: tuple[float, float] | None = None
) -> ET.Element:
    """A quantity with a number, its expanded uncertainty and coverage factor."""
    quantity = _add(data, "quantity")
    _text(quantity, "name", words)
    real = ET.SubElement(quantity, f"{{{_SI}}}real")
    _si(real, "value", repr(float(value)))
    _si(real, "unit", unit)
    if expanded is not None:
        _uncertainty(_si(real, "expandedUnc"), "", repr(float(expanded[0])), expanded[1], 1)
    return quantity


def _reals(data: ET.Element, words: str, values: list[float], unit: str, expanded: list[float] | None = None) -> None:
    """A quantity with a list of numbers, and of expanded uncertainties (k = 2)."""
    quantity = _add(data, "quantity")
    _text(quantity, "name", words)
    numbers = ET.SubElement(quantity, f"{{{_SI}}}realListXMLList")
    _si(numbers, "valueXMLList", " ".join(repr(float(v)) for v in values))
    _si(numbers, "unitXMLList", unit)
    if expanded is not None:
        spread = " ".join(repr(float(u)) for u in expanded)
        _uncertainty(_si(numbers, "expandedUncXMLList"), "XMLList", spread, 2.0, len(values))


def _uncertainty(parent: ET.Element, ending: str, spread: str, k: float, count: int) -> None:
    _si(parent, f"uncertainty{ending}", spread)
    _si(parent, f"coverageFactor{ending}", " ".join([f"{k:.6f}"] * count))
    _si(parent, f"coverageProbability{ending}", " ".join([f"{math.erf(k / math.sqrt(2.0)):.6f}"] * count))
    _si(parent, f"distribution{ending}", " ".join(["normal"] * count))


def _contact(parent: ET.Element, name: str, address: str | None) -> None:
    _text(parent, "name", name)
    _text(_add(parent, "location"), "further", address or NOT_STATED)


def _add(parent: ET.Element, name: str, text: str | None = None) -> ET.Element:
    element = ET.SubElement(parent, f"{{{_DCC}}}{name}")
    # The schema allows neither blanks at the ends nor an empty text.
    element.text = None if text is None else " ".join(text.split()) or NOT_STATED
    return element


def _si(parent: ET.Element, name: str, text: str | None = None) -> ET.Element:
    element = ET.SubElement(parent, f"{{{_SI}}}{name}")
    element.text = text
    return element


def _text(parent: ET.Element, name: str, words: str) -> None:
    """Add a text with its language, nested as in the schema."""
    _add(_add(parent, name), "content", words).set("lang", "en")
