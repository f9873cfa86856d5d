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
from gradcal_jax.information.imu_residual import UNITS_OF_TERMS
from gradcal_jax.pages.certificate import NOT_STATED, Certificate, Correction
from gradcal_jax.pages.templates import page_templates
from gradcal_jax.tables.writing import write_whole

VERSION: Final = "3.2.1"
_ONE: Final = r"\one"
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
    """Write a certificate as a DCC, by `dcc.xml`. Errors: `ValueError` where a required entry is missing; `OSError`."""
    stated = dict(certificate.heading)
    if certificate.laboratory is None or certificate.laboratory.country is None:
        raise ValueError(
            'a DCC must name the laboratory and its country: state [laboratory] name = "…", country = "DE" in the '
            "rig file given by --rig"
        )
    for key, option in (("certificate number", "--number"), ("performed", "--performed 2026-11-22")):
        if stated[key] == NOT_STATED:
            raise ValueError(f"a DCC must state the {key}: give {option}")
    begin, _, end = stated["performed"].partition("..")
    sentences = ["This document claims no accreditation.", *certificate.validity]
    if certificate.simulated:
        sentences.insert(
            0, "SIMULATED: the data come from simulated devices. This is not a certificate of a real sensor."
        )
    environment = page_templates(
        # The schema allows neither blanks at the ends nor an empty text.
        plain=lambda text: " ".join(text.split()) or NOT_STATED,
        number=lambda value: repr(float(value)),
        times=lambda value, factor: value * factor,
    )
    corrections: dict[str, list[Correction]] = {}
    for row in certificate.corrections:
        corrections.setdefault(row.channel, []).append(row)
    text = environment.get_template("dcc.xml").render(
        c=certificate,
        stated=stated,
        begin=begin,
        end=end or begin,
        sentences=sentences,
        corrections=corrections,
        in_si=_IN_SI,
        one=_ONE,
        celsius=r"\degreecelsius",
        chance=lambda k: math.erf(k / math.sqrt(2.0)),
        version=VERSION,
        program=gradcal_jax.__version__,
    )
    for prefix, space in (("dcc", "https://ptb.de/dcc"), ("si", "https://ptb.de/si")):
        ET.register_namespace(prefix, space)
    root = ET.fromstring(text)
    for element in root.iter():
        element.text, element.tail = (element.text or "").strip() or None, None
    ET.indent(root)
    write_whole(path, f'<?xml version="1.0" encoding="UTF-8"?>\n{ET.tostring(root, encoding="unicode")}\n')
