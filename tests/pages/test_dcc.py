"""The certificate as a Digital Calibration Certificate: as PTB's schema 3.2.1 wants it, with the certificate's numbers.

The schema itself is under a licence of its own (LGPL) and not here. Where it is at hand, in the folder that
GRADCAL_DCC_SCHEMA names or in shared/dcc beside the checkout, as dcc.xsd, SI_Format.xsd (2.1.0) and
xmldsig-core-schema.xsd, every document is validated; what it asks for stands below, too, and is tested without it.
"""

import json
import math
import os
import re
import xml.etree.ElementTree as ET
from pathlib import Path

import pytest
from report_samples import calibration, calibration_of_plan, recipe
from test_certificate import REFERENCES

import gradcal_jax as gj
from gradcal_jax.calibration import FitTest
from gradcal_jax.cli import main
from gradcal_jax.spec.rig import TEMPLATE

SCHEMA = Path(os.environ.get("GRADCAL_DCC_SCHEMA", Path(__file__).parents[3] / "shared" / "dcc"))
D, S = "{https://ptb.de/dcc}", "{https://ptb.de/si}"
TEXT = re.compile(r"\S+(\s+\S+)*")
NUMBER = re.compile(r"[-+]?((\d*\.\d+)|(\d+\.?))([Ee][-+]?\d+)?")
# Children of each element, in order, as regular expressions over their names: facts of the schema.
ORDER = {
    "digitalCalibrationCertificate": "administrativeData measurementResults( comment)?( document)?( Signature)*",
    "administrativeData": "dccSoftware coreData items calibrationLaboratory respPersons customer( statements)?",
    "software": "name release( type)?( description)?",
    "coreData": "countryCodeISO3166_1( usedLangCodeISO639_1)+( mandatoryLangCodeISO639_1)+ uniqueIdentifier"
    "( identifications)?( receiptDate)? beginPerformanceDate endPerformanceDate performanceLocation( issueDate)?",
    "item": "name( equipmentClass)*( description)?( manufacturer)?( model)? identifications( itemQuantities)?",
    "identification": "issuer value( name)?",
    "contact": "name( eMail)?( phone)?( fax)? location",
    "customer": "name( eMail)?( phone)?( fax)? location",
    "respPerson": "person( description)?( role)?( mainSigner)?",
    "measurementResult": "name( description)?( usedMethods)?( usedSoftware)?( measuringEquipments)?"
    "( influenceConditions)? results( measurementMetaData)?",
    "usedMethod": "name( description)?( norm)*( reference)*",
    "measuringEquipment": "name( equipmentClass)*( description)?( certificate)?( manufacturer)?( model)?"
    "( identifications)?",
    "influenceCondition": "name( description)?( status)?( certificate)? data",
    "result": "name( description)? data",
    "quantity": "name( description)? (real|realListXMLList)( relativeUncertainty)?( usedMethods)?( usedSoftware)?"
    "( measuringEquipments)?( influenceConditions)?( measurementMetaData)?",
    "metaData": "(name )?(description )?declaration( conformity)?( data)?",
    "statement": "(name )?(description )?declaration( conformity)?( data)?",
    "real": "(label )?value unit( dateTime)?( expandedUnc| coverageInterval)?",
    "expandedUnc": "uncertainty coverageFactor coverageProbability( distribution)?",
    "realListXMLList": "(labelXMLList )?valueXMLList unitXMLList( expandedUncXMLList)?",
    "expandedUncXMLList": "uncertaintyXMLList coverageFactorXMLList coverageProbabilityXMLList( distributionXMLList)?",
}


def local(element):
    return element.tag.rsplit("}", 1)[1]


def structure_faults(root):
    """What the facts above, and those of single values, say against a document."""
    faults = [] if root.get("schemaVersion") == "3.2.1" else ["version"]
    for element in root.iter():
        name, children = local(element), " ".join(local(child) for child in element)
        if name in ORDER and not re.fullmatch(ORDER[name], children):
            faults.append(f"{name}: {children}")
        text = element.text or ""
        if not len(element) and not (TEXT.fullmatch(text) or name == "content"):
            faults.append(f"{name} is empty or has blanks at its ends")
        if name in ("value", "uncertainty") and element.tag.startswith(S) and not NUMBER.fullmatch(text):
            faults.append(f"{name} {text}")
        if name.startswith("coverageFactor") and not all(re.fullmatch(r"[1-9]\d*(\.\d*)?", k) for k in text.split()):
            faults.append(f"{name} {text}")
        if name.startswith("coverageProbability") and not all(
            re.fullmatch(r"0\.\d*|1(\.0*)?", p) for p in text.split()
        ):
            faults.append(f"{name} {text}")
        if name == "countryCodeISO3166_1" and not re.fullmatch("[A-Z]{2}", text):
            faults.append(name)
        if name.endswith("Date") and not re.fullmatch(r"\d{4}-\d\d-\d\d", text):
            faults.append(f"{name} {text}")
    for numbers in root.iter(f"{S}realListXMLList"):
        lengths = {
            len(e.text.split()) for e in numbers.iter() if local(e).endswith("XMLList") and e.text and not len(e)
        }
        if len(lengths - {1}) > 1:
            faults.append("lists of other lengths")
    return faults


def schema_faults(path):
    """What the schema itself says, where it is at hand."""
    if not (SCHEMA / "dcc.xsd").is_file():
        pytest.skip(f"there is no dcc.xsd in {SCHEMA.name}: set GRADCAL_DCC_SCHEMA")
    etree = pytest.importorskip("lxml.etree")

    class Beside(etree.Resolver):
        def resolve(self, url, public, context):
            return self.resolve_filename(str(SCHEMA / url.rsplit("/", 1)[1]), context)

    parser = etree.XMLParser()
    parser.resolvers.add(Beside())
    schema = etree.XMLSchema(etree.parse(str(SCHEMA / "dcc.xsd"), parser))
    schema.validate(etree.parse(str(path)))
    return [str(error) for error in schema.error_log]


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    folder = tmp_path_factory.mktemp("dcc")
    made = recipe()
    gj.write_toml(made, folder / "recipe.toml")
    found = calibration(made)
    tested = FitTest(name="gyro_x: χ² of the fit", statistic=101.0, degrees=98, chance=0.4)
    row = found.result[0].model_copy(update={"worst": 800.0, "coverage": 2.0, "rule": "simple acceptance"})
    changed = found.model_copy(update={"fit": (tested,), "result": (row, *found.result[1:])})
    gj.write_calibration(type(found).model_validate(changed.model_dump(exclude_unset=True)), folder / "cal.toml")
    rig = TEMPLATE + REFERENCES.replace("operator =", 'country = "DE"\noperator =')
    (folder / "rig.toml").write_text(rig, encoding="utf-8")
    return folder


def words(folder, *more):
    given = ["report", "recipe.toml", "cal.toml", "--certificate", "--rig", "rig.toml", "-o", "c.html", "--force"]
    given += [
        "--number",
        "K-1",
        "--customer",
        "A & B",
        "--performed",
        "2026-11-21..2026-11-22",
        "--dcc",
        "c.xml",
        *more,
    ]
    return [str(folder / w) if "." in w and not w.startswith(("-", "2026")) else w for w in given]


@pytest.fixture(scope="module")
def written(folder):
    assert main(words(folder)) == 0
    return folder / "c.xml"


def test_the_document_is_as_the_facts_of_the_schema_say(written):
    assert structure_faults(ET.parse(written).getroot()) == []


def test_the_document_is_valid_against_the_schema(written):
    assert schema_faults(written) == []


@pytest.mark.parametrize(
    ("was", "becomes"),
    [
        ("<dcc:issuer>manufacturer</dcc:issuer>", ""),
        ("<dcc:countryCodeISO3166_1>DE", "<dcc:countryCodeISO3166_1>Germany"),
        (r"<si:value>0\.0</si:value>", "<si:value>0,0</si:value>"),
        ("(<dcc:endPerformanceDate>[^<]*</dcc:endPerformanceDate>)", r"\1\1"),
        ('schemaVersion="3.2.1"', 'schemaVersion="3.1.2"'),
        ("<si:coverageFactor>2", "<si:coverageFactor>0"),
        ("<dcc:uniqueIdentifier>K-1", "<dcc:uniqueIdentifier>"),
    ],
)
def test_a_fault_is_noticed_by_the_facts_and_by_the_schema(written, tmp_path, was, becomes):
    text = written.read_text(encoding="utf-8")
    broken = tmp_path / "broken.xml"
    broken.write_text(re.sub(was, becomes, text, count=1), encoding="utf-8")
    assert broken.read_text(encoding="utf-8") != text
    assert structure_faults(ET.parse(broken).getroot())
    if (SCHEMA / "dcc.xsd").is_file():
        assert schema_faults(broken)


def test_the_numbers_are_the_certificates_in_si(folder, written, capsys):
    assert main(words(folder, "--json")) == 0
    told = json.loads(capsys.readouterr().out)
    root = ET.parse(written).getroot()
    by_name = {}
    for result in root.iter(f"{D}result"):
        name = result.find(f"{D}name/{D}content").text
        by_name[name] = {q.find(f"{D}name/{D}content").text: q for q in result.iter(f"{D}quantity")}
    row = told["results"][0]
    left = by_name["all rates, axis x: error after correction"]
    real = left["error after correction"].find(f"{S}real")
    assert float(real.find(f"{S}expandedUnc/{S}uncertainty").text) == pytest.approx(row["expanded"] * 1e-6, rel=1e-12)
    assert float(real.find(f"{S}expandedUnc/{S}coverageFactor").text) == row["coverage"]
    probability = float(real.find(f"{S}expandedUnc/{S}coverageProbability").text)
    assert probability == pytest.approx(math.erf(math.sqrt(2.0)), abs=1e-6)
    assert left["error after correction"].find(f".//{D}conformity").text == "pass"
    limit = left["limit on the error"].find(f"{S}real")
    assert (float(limit.find(f"{S}value").text), limit.find(f"{S}unit").text) == (pytest.approx(0.002), r"\one")
    corrections = by_name["Corrections of gyro x over temperature"]
    values = [float(v) for v in corrections["bias"].find(f".//{S}valueXMLList").text.split()]
    expected = [math.radians(value) / 3600.0 for value in told["corrections"][0]["value"]]
    assert values == pytest.approx(expected, rel=1e-12)
    warm = [float(v) for v in corrections["temperature"].find(f".//{S}valueXMLList").text.split()]
    assert warm == told["corrections"][0]["temperature_c"]
    assert root.find(f".//{D}beginPerformanceDate").text == "2026-11-21"
    assert root.find(f".//{D}endPerformanceDate").text == "2026-11-22"
    said = [e.text for e in root.iter(f"{D}content")]
    assert "This document claims no accreditation." in said
    assert any(s.startswith("SIMULATED") for s in said)


def test_an_imu_s_document_has_every_quantity_in_its_si_unit(folder, tmp_path, capsys):
    spec = gj.parse_spec(gj.presets.text("gradient-three-axes"))
    gj.write_toml(spec, tmp_path / "spec.toml")
    found = calibration_of_plan(spec)
    gj.write_calibration(found, tmp_path / "imu.toml")
    command = ["report", tmp_path / "spec.toml", tmp_path / "imu.toml", "--certificate", "--rig", folder / "rig.toml"]
    command += ["--number", "K-2", "--performed", "2026-11-22", "--json"]
    command += ["-o", tmp_path / "c.html", "--dcc", tmp_path / "c.xml"]
    assert main([str(word) for word in command]) == 0
    told = json.loads(capsys.readouterr().out)
    root = ET.parse(tmp_path / "c.xml").getroot()
    assert structure_faults(root) == []
    assert schema_faults(tmp_path / "c.xml") == []
    by_name = {result.find(f"{D}name/{D}content").text: result for result in root.iter(f"{D}result")}
    g = 9.80665
    sizes = {
        "accelerometer bias, worst axis": (1e-6 * g, r"\metre\second\tothe{-2}"),
        "accelerometer second order, worst axis": (1e-6 / g, r"\second\tothe{2}\metre\tothe{-1}"),
        "acceleration sensitivity, all axes together": (
            math.radians(1.0) / 3600.0 / g,
            r"\radian\second\metre\tothe{-1}",
        ),
        "gyro misalignment, all axes together": (1e-6, r"\radian"),
    }
    for name, (factor, unit) in sizes.items():
        real = by_name[f"{name}: error after correction"].find(f".//{S}real")
        row = next(row for row in told["results"] if f"{row['name']}, {row['axis']}" == name)
        assert float(real.find(f"{S}expandedUnc/{S}uncertainty").text) == pytest.approx(row["expanded"] * factor)
        assert real.find(f"{S}unit").text == unit
    forces = by_name["Corrections of accelerometer z over temperature"]
    bias = next(q for q in forces.iter(f"{D}quantity") if q.find(f"{D}name/{D}content").text == "bias")
    coefficients = found.channel_of("accelerometer", "z").term_of("bias").coefficients
    warm = [(t - 20.0) / 50.0 for t in (-30.0, 20.0, 70.0)]
    expected = [sum(c * t**k for k, c in enumerate(coefficients.values())) for t in warm]
    assert [float(v) for v in bias.find(f".//{S}valueXMLList").text.split()] == pytest.approx(expected)
    budgets = {budget["requirement"]: budget for budget in told["budgets"]}
    assert set(budgets) == {row.name for row in found.result}
    for budget in budgets.values():
        assert sum(i["contribution"] ** 2 for i in budget["inputs"]) == pytest.approx(budget["total"] ** 2, rel=0.01)
    inputs = {i["name"]: i["value"] for i in budgets["accelerometer bias"]["inputs"]}
    assert inputs["turn-on bias"] == "0.75 mg"
    assert inputs["velocity random walk"] == "0.05 m/s/√h"


@pytest.mark.parametrize(
    ("leave", "said"),
    [
        ("--number", "certificate number"),
        ("--rig", "[laboratory] name"),
        ("--performed", "a DCC must state the performed"),
    ],
)
def test_what_nobody_stated_is_asked_for(folder, tmp_path, leave, said, capsys):
    given = words(folder)
    given[given.index("--dcc") + 1] = str(tmp_path / "d.xml")
    where = given.index(leave)
    del given[where : where + 2]
    assert main(given) == 2
    assert said in capsys.readouterr().err
    assert not (tmp_path / "d.xml").exists()


def test_what_is_no_date_is_refused(folder, capsys):
    for day in ("yesterday", "2026-11-22..2026-11-21", "2026-13-01"):
        given = words(folder)
        given[given.index("--performed") + 1] = day
        assert main(given) == 2
        assert "expected a date" in capsys.readouterr().err
