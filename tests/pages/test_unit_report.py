"""The page of a unit's plan: its numbers are the prediction's, it says what is not observed, and nothing is fetched."""

import json
import re
from html import unescape

import pytest

import gradcal_jax as gj
from gradcal_jax.cli import main
from gradcal_jax.files import presets

# The paper's method at a coarser ramp: a third of the cycles.
SPEC = gj.changed(
    gj.parse_spec(presets.text("gradient-three-axes")),
    {"rig.chamber.max_heating": "3 K/min", "plan.gradient": "3 K/min"},
)


@pytest.fixture(scope="module")
def written(tmp_path_factory):
    folder = tmp_path_factory.mktemp("page")
    gj.write_toml(SPEC, folder / "unit.toml")
    data = gj.report(folder / "unit.toml", folder / "page.html")
    return data, (folder / "page.html").read_text(encoding="utf-8"), folder


def test_every_number_is_the_prediction_s_and_every_warning_is_on_the_page(written):
    data, html, _ = written
    predicted = gj.predict(SPEC)
    assert [row.predicted for row in data.requirements] == [row.judged for row in predicted.requirements]
    assert [row.verdict for row in data.requirements] == [row.verdict for row in predicted.requirements]
    assert data.verdict == "missed"
    assert "Missed: the predicted residual exceeds a target" in html
    assert len(data.parameters) == len(predicted.parameters)
    bias = next(row for row in predicted.parameters if row.name == "accelerometer_x.a0")
    shown = next(row for row in data.parameters if (row.kind, row.name, row.axis) == ("accelerometer", "a0", "x"))
    assert shown.predicted_std == pytest.approx(bias.std / 9.80665e-6)
    assert shown.unit == "ug"
    for words in ("accelerometer z never points down: add a pose", "add 180 deg of spin", "k2"):
        assert words in html
    for warning in predicted.warnings:
        assert warning in unescape(html)


def test_the_page_has_a_picture_of_each_requirement_and_of_the_poses_and_fetches_nothing(written):
    _, html, _ = written
    assert html.count("<svg") == len(SPEC.requirement) + 1
    assert 'id="poses"' in html
    assert "Poses of the unit" in html
    assert "SIMULATED" not in html
    assert not re.findall(r'(?:src|href)="(?!#|data:)[^"]*"', html)
    assert "<script" not in html
    ids = re.findall(r'\bid="([^"]+)"', html)
    assert len(ids) == len(set(ids))
    assert "tilt of the base" in html
    assert "made 6 times" in html


def test_a_unit_s_page_stands_alone_and_the_command_prints_its_numbers(written, capsys, tmp_path):
    data, _, folder = written
    spec = str(folder / "unit.toml")
    for more in ([spec], ["--before", spec]):
        assert main(["report", spec, *more, "-o", str(tmp_path / "no.html")]) == 2
        said = capsys.readouterr().err
        assert "gradcal compare" in said or "second unit" in said
    assert main(["report", spec, "-o", str(tmp_path / "page.html"), "--json"]) == 0
    tables = json.loads(capsys.readouterr().out)
    assert tables["verdict"] == data.verdict
    assert [row["predicted"] for row in tables["requirements"]] == [row.predicted for row in data.requirements]
