"""The page of a plan, a run and a calibration: its numbers are those of the files."""

import html
import json
import re
from html.parser import HTMLParser

import pytest

import gradcal_jax as gj
from gradcal_jax.cli import main
from gradcal_jax.tables.display import amount
from gradcal_jax.tables.table import Column, Table
from gradcal_jax.tables.writing import to_toml


@pytest.fixture
def made(axis_run):
    """The folder, the recipe and the calibration in it."""
    return axis_run, gj.read_recipe(axis_run / "recipe.toml"), gj.read_calibration(axis_run / "run/calibration.toml")


class Outside(HTMLParser):
    """Collects what a page would load, and its ids."""

    def __init__(self):
        super().__init__()
        self.loaded, self.ids = [], []

    def handle_starttag(self, tag, attrs):
        at = dict(attrs)
        self.loaded += [at[key] for key in ("src", "href", "xlink:href") if key in at and not at[key].startswith("#")]
        self.ids += [at["id"]] if "id" in at else []
        assert tag != "script"


@pytest.mark.long
def test_a_page_of_a_run_has_the_numbers_of_its_files(made, tmp_path):
    folder, plan, found = made
    told = gj.report(folder / "run", tmp_path / "page.html")
    page = (tmp_path / "page.html").read_text(encoding="utf-8")
    (rows,) = told["sections"]["Requirements"]["tables"]
    assert [row["requirement"] for row in rows] == [row.name for row in plan.prediction.requirements]
    results = {row.name: row for row in found.result}
    for row, predicted in zip(rows, plan.prediction.requirements, strict=True):
        assert row["predicted"] == amount(predicted.judged, predicted.unit)
        if (result := results.get(predicted.name)) is not None:
            assert row["achieved"] == amount(result.value, result.unit)
    assert told["simulated"]
    assert "SIMULATED" in page
    assert "A small plan &lt;of &amp; for&gt; a page" in page
    assert html.escape(found.serial_number) in page
    assert set(told["sections"]) >= {"Plan", "Run", "Calibration", "Coefficients", "Assumptions", "Provenance"}
    (coefficients,) = told["sections"]["Coefficients"]["tables"]
    assert [row["coefficient"] for row in coefficients] == list(found.values())
    outside = Outside()
    outside.feed(page)
    assert all(address.startswith("data:") for address in outside.loaded)
    assert sorted(outside.ids) == sorted(set(outside.ids))
    assert page.count("<svg") == page.count("<figure") >= 4


def test_a_plan_alone_has_a_page(made, tmp_path):
    folder, plan, _ = made
    told = gj.report(folder / "recipe.toml", tmp_path / "page.html")
    assert told["verdict"] == ("met" if plan.prediction.requirements[0].verdict == "met" else "missed")
    assert "Calibration" not in told["sections"]


def test_the_certificate_is_the_first_part_of_the_page(made, tmp_path, capsys):
    folder, _, found = made
    rig = tmp_path / "rig.toml"
    rig.write_text(
        'format = "gradcal-rig/1"\n[laboratory]\nname = "Laboratory X"\noperator = "A. Person"\n'
        '[[reference]]\ndevice = "encoder"\nidentity = "E 1"\n[chamber]\ndriver = "espec"\nport = "/dev/no"\n'
        'safe = "hold"\n',
        encoding="utf-8",
    )
    page = tmp_path / "page.html"
    words = ["report", str(folder / "run"), "--certificate", "--rig", str(rig), "--number", "K-1", "-o", str(page)]
    assert main([*words, "--json"]) == 0
    sections = json.loads(capsys.readouterr().out)["sections"]
    text = page.read_text(encoding="utf-8")
    assert text.index("Calibration certificate K-1") < text.index("Calibration report")
    heading = {row["what"]: row["value"] for row in sections["Certificate"]["tables"][0]}
    assert (heading["laboratory"], heading["customer"]) == ("Laboratory X", "not stated")
    for row, result in zip(sections["Results"]["tables"][0], found.result, strict=True):
        assert row["U"] == pytest.approx((result.coverage or 2.0) * result.value)
    for budget, result in zip(sections["Uncertainty budget"]["tables"], found.result, strict=True):
        parts = [next(v for k, v in row.items() if k == "contribution") for row in budget]
        assert sum(part**2 for part in parts) == pytest.approx(result.value**2, rel=0.01)


@pytest.mark.parametrize(
    ("words", "said"),
    [
        (["NOTHING"], "does not exist"),
        (["RECIPE", "RECIPE"], "a second recipe"),
        (["RECIPE", "--number", "1"], "belong to --certificate"),
        (["RECIPE", "--certificate"], "a certificate needs a calibration"),
    ],
)
def test_what_cannot_be_shown_is_a_sentence(words, said, made, tmp_path, capsys):
    at = {"RECIPE": str(made[0] / "recipe.toml"), "NOTHING": str(tmp_path / "nothing.toml")}
    out = tmp_path / "x.html"
    assert main(["report", *(at.get(word, word) for word in words), "-o", str(out)]) == 2
    assert said in " ".join(capsys.readouterr().err.split())
    assert not out.exists()


def test_a_calibration_that_the_data_contradict_is_not_certified(made, tmp_path, capsys):
    found = made[2]
    rows = tuple(row.model_copy(update={"verdict": "not valid"}) for row in found.result)
    wrong = found.model_copy(update={"result": rows, "contradicted": ("gyro_x: whiteness",)})
    path = tmp_path / "calibration.toml"
    path.write_text(to_toml(wrong), encoding="utf-8")
    page = tmp_path / "page.html"
    assert main(["report", str(path), "--certificate", "-o", str(page), "--json"]) == 0
    told = json.loads(capsys.readouterr().out)
    assert told["verdict"] == "not valid"
    assert all(row["U"] is None for row in told["sections"]["Results"]["tables"][0])
    assert "nothing is certified" in page.read_text(encoding="utf-8")


def test_one_table_for_all():
    table = Table.of(["name", Column("size", "m", 3), "remark"], [("a<b", 1234.5, ""), ("c", None, "none")])
    assert table.json()[0] == {"name": "a<b", "size": 1234.5, "remark": ""}
    assert [line.split() for line in table.text().splitlines()][1:] == [["a<b", "1230"], ["c", "–", "none"]]
    assert "a&lt;b" in table.html()
    assert re.search(r'<td data-label="size, m" class="number"><span>1230</span>', table.html())
