"""The certificate: every item is there, its numbers hang together, and it prints on two pages."""

import json
import re

import numpy as np
import pytest
from headless_chromium import Chromium, browser
from report_samples import calibration, recipe

import gradcal_jax as gj
from gradcal_jax.calibration import FitTest
from gradcal_jax.calibration.correction import term_values
from gradcal_jax.cli import main
from gradcal_jax.pages.certificate import _value_of
from gradcal_jax.spec.rig import TEMPLATE

REFERENCES = """
[laboratory]
name = "Laboratory <1>"
operator = "A. Person"
[[reference]]
device = "encoder"
identity = "RON 905, 12345"
certificate = "K-2026-17"
due = "2027-06-30"
[[reference]]
device = "chamber"
identity = "WK 111"
"""


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    folder = tmp_path_factory.mktemp("certificate")
    made = recipe()
    gj.write_toml(made, folder / "recipe.toml")
    found = calibration(made)
    tested = FitTest(name="gyro_x: χ² of the fit", statistic=101.0, degrees=98, chance=0.4)
    row = found.result[0].model_copy(
        update={"worst": 800.0, "coverage": 2.0, "rule": "simple acceptance: 2 × mean of max (1σ) within 2000 ppm"}
    )
    gj.write_calibration(
        type(found).model_validate(
            found.model_copy(update={"fit": (tested,), "result": (row, *found.result[1:])}).model_dump(
                exclude_unset=True
            )
        ),
        folder / "cal.toml",
    )
    (folder / "rig.toml").write_text(TEMPLATE + REFERENCES, encoding="utf-8")
    return folder


@pytest.fixture(scope="module")
def made(folder):
    words = ["report", folder / "recipe.toml", folder / "cal.toml", "--certificate", "--rig", folder / "rig.toml"]
    words += ["--number", "K-1", "--customer", "A & B", "-o", folder / "c.html", "--force"]
    return [str(word) for word in words]


def test_the_json_hangs_together(made, capsys):
    assert main([*made, "--json"]) == 0
    told = json.loads(capsys.readouterr().out)
    assert told["heading"]["certificate number"] == "K-1"
    assert told["heading"]["laboratory"] == "Laboratory <1>"
    assert told["heading"]["operator"] == "A. Person"
    assert [row["device"] for row in told["traceability"]] == ["encoder", "chamber"]
    assert told["traceability"][1]["due"] == "not stated"
    for row in told["results"]:
        assert row["statistic"] in ("mean of max", "max", "mean", "rms")
        assert row["expanded"] == pytest.approx(row["coverage"] * row["standard"])
    first = told["results"][0]
    # 2·Φ(−2000/800)
    assert first["risk"] == pytest.approx(0.0124193, rel=1e-5)
    (budget, *_) = told["budgets"]
    assert sum(i["sensitivity"] for i in budget["inputs"]) == pytest.approx(1.0, abs=0.01)
    assert sum(i["contribution"] ** 2 for i in budget["inputs"]) == pytest.approx(budget["total"] ** 2, rel=0.01)
    assert told["fit"][0]["test"] == "gyro x: χ² of the fit"


def test_corrections_are_those_of_apply_and_their_uncertainty_the_covariances(made, folder, capsys):
    assert main([*made, "--json"]) == 0
    told = json.loads(capsys.readouterr().out)
    found = gj.read_calibration(folder / "cal.toml")
    channel = found.channel[0]
    bias, slow, fast = told["corrections"]
    assert [row["term"] for row in told["corrections"]] == [
        "bias",
        "scale factor at -200 deg/s",
        "scale factor at 200 deg/s",
    ]
    at = np.array(bias["temperature_c"])
    assert len(at) == 7
    expected = term_values(channel.term_of("bias"), at) * np.degrees(1.0) * 3600.0
    np.testing.assert_allclose(bias["value"], expected, rtol=1e-9)
    for row, end in zip((slow, fast), channel.valid_rate, strict=True):
        expected = term_values(channel.term_of("scale_factor"), at, np.full(len(at), float(end))) * 1e6
        np.testing.assert_allclose(row["value"], expected, rtol=1e-9)
    assert min(min(row["expanded"]) for row in told["corrections"]) > 0.0


def test_the_page_has_every_item_and_claims_nothing(made, folder):
    assert main(made) == 0
    page = (folder / "c.html").read_text(encoding="utf-8")
    for words in ("part 1 of 2", "part 2 of 2", "Laboratory &lt;1&gt;", "A &amp; B", "RON 905, 12345", "K-2026-17"):
        assert words in page
    for title in (
        "Method",
        "Traceability",
        "Conditions",
        "Results",
        "Uncertainty budget",
        "Tests of the fit",
        "Validity",
    ):
        assert f"<h2>{title}</h2>" in page
    assert "claims no accreditation" in page
    assert ">mean of max<" in page
    assert "as in the spec" not in page
    assert not re.search(r"accredited|ISO/IEC 17025|https?://", page)
    assert "nan" not in re.sub(r"<style>.*?</style>", "", page, flags=re.S)


def test_what_is_not_known_is_not_stated(folder, tmp_path, capsys):
    out = tmp_path / "c.html"
    assert main(["report", str(folder / "cal.toml"), "--certificate", "-o", str(out)]) == 0
    page = out.read_text(encoding="utf-8")
    assert page.count("not stated") >= 3
    assert "the rig file names no [[reference]]" in page
    assert "without the recipe that was run" in page
    assert main(["report", str(folder / "recipe.toml"), "--certificate", "-o", str(tmp_path / "d.html")]) == 2
    assert "a certificate needs a calibration" in capsys.readouterr().err
    assert main(["report", str(folder / "cal.toml"), "--customer", "x", "-o", str(tmp_path / "d.html")]) == 2


def test_the_serial_number_is_what_the_device_said(folder, tmp_path, capsys):
    """The name of its table in the rig file, or of its column in a log, is none."""
    command = ["report", str(folder / "cal.toml"), "--certificate", "--json"]
    assert main([*command, "-o", str(tmp_path / "a.html")]) == 0
    heading = json.loads(capsys.readouterr().out)["heading"]
    assert heading["serial number"] == "not stated"
    assert "unit <7>" in heading["unit"]
    found = gj.read_calibration(folder / "cal.toml")
    stated = found.model_copy(update={"provenance": {**found.provenance, "serial_number": "N2558"}})
    gj.write_calibration(stated, tmp_path / "said.toml")
    assert main(["report", str(tmp_path / "said.toml"), "--certificate", "--json", "-o", str(tmp_path / "b.html")]) == 0
    assert json.loads(capsys.readouterr().out)["heading"]["serial number"] == "N2558"


@pytest.mark.parametrize(("verdict", "shown"), [("met", "exceeds the limit: < 0.01 %."), ("not covered", None)])
def test_a_risk_is_a_bound_if_it_is_minute_and_is_stated_only_with_a_decision(verdict, shown, folder, tmp_path):
    kept = gj.read_calibration(folder / "cal.toml")
    row = kept.result[0].model_copy(update={"worst": 100.0, "verdict": verdict})
    gj.write_calibration(kept.model_copy(update={"result": (row,)}), tmp_path / "cal.toml")
    words = ["report", folder / "recipe.toml", tmp_path / "cal.toml", "--certificate", "-o", tmp_path / "c.html"]
    assert main([str(word) for word in words]) == 0
    text = (tmp_path / "c.html").read_text(encoding="utf-8")
    assert "Decision rule" in text
    assert ("Specific risk" in text, shown is None or shown.replace("<", "&lt;") in text) == (shown is not None, True)


@pytest.mark.browser
@pytest.mark.skipif(browser() is None, reason="there is no Chromium on the path")
def test_it_prints_on_two_pages_and_fits_narrow_and_wide(made, folder, tmp_path):
    assert main(made) == 0
    with Chromium(browser()) as running:
        for width in (400, 1400):
            running.open(folder / "c.html", width)
            assert running.evaluate("document.documentElement.scrollWidth") <= width
        running.print_pdf(tmp_path / "c.pdf")
    assert len(re.findall(rb"/Type\s*/Page\b", (tmp_path / "c.pdf").read_bytes())) == 2


def test_the_second_order_of_an_accelerometer_is_known_by_the_figures_of_accelerometers():
    stated = [("prior knowledge", "bias 5 deg/h"), ("accelerometer prior knowledge", "bias 20 mg")]
    assert _value_of("prior knowledge", "second_order", stated) == "bias 20 mg"
    assert _value_of("prior knowledge", "accelerometer_bias", stated) == "bias 20 mg"
    assert _value_of("prior knowledge", "gyro_bias", stated) == "bias 5 deg/h"
