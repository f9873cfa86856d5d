"""The panel of a page: every number is a prediction, from the file alone, at each width, and nothing on paper."""

import json
import re

import pytest
from headless_chromium import BOXES, Chromium, browser, overlaps
from report_samples import recipe, spec

import gradcal_jax as gj
from gradcal_jax.cli import main
from gradcal_jax.pages.page import ANGLES, RAMPS, SLOPES, panel_of, report


@pytest.fixture(scope="module")
def made():
    return recipe()


@pytest.fixture(scope="module")
def panel(made):
    return panel_of(made.spec)


def place(slope, ramps, angle):
    return (SLOPES.index(slope) * len(RAMPS) + RAMPS.index(ramps)) * len(ANGLES) + ANGLES.index(angle)


def test_the_plan_itself_is_a_point_of_the_grid(made, panel):
    own = [choice["own"] for choice in panel["choices"]]
    at = (own[0] * len(RAMPS) + own[1]) * len(ANGLES) + own[2]
    for row, told in zip(made.prediction.requirements, panel["requirements"], strict=True):
        assert told["values"][at] == pytest.approx(row.judged, rel=1e-5)
        assert told["verdicts"][at] == row.verdict
        assert told["allowed"] == (None if row.target is None else row.target / row.coverage)
    assert panel["hours"][at] == pytest.approx(made.duration_s / 3600.0)


@pytest.mark.parametrize(("slope", "ramps", "angle"), [(0.7, 1, 2.0), (1.4, 3, 0.25), (0.5, 2, 1.0)])
def test_a_point_is_what_predict_says_of_such_a_spec(made, panel, slope, ramps, angle):
    """Written here as a file would have it."""
    ways = ["26 degC", "20 degC"]
    course = [{"ramp_to": ways[k % 2], "rate": f"{slope} K/min"} for k in range(ramps)]
    other = gj.changed(
        made.spec,
        {
            "plan.temperature": None,
            "plan.gradient": None,
            "plan.soak": None,
            "plan.programme": [{"soak": "60 s", "at": "20 degC", "used": False}, *course],
            "rig.table.angle.reading_noise": f"{0.05 * angle} deg",
        },
    )
    rows = gj.predict(other).requirements
    for row, told in zip(rows, panel["requirements"], strict=True):
        assert told["values"][place(slope, ramps, angle)] == pytest.approx(row.judged, rel=1e-5)


def test_what_does_not_fit_has_no_number():
    slow = panel_of(spec(**{"rig.chamber.max_heating": "1 K/min", "rig.chamber.max_cooling": "0.8 K/min"}))
    assert slow["hours"][place(1.0, 1, 1.0)] is not None
    assert slow["hours"][place(1.4, 1, 1.0)] is None
    assert slow["hours"][place(1.0, 2, 1.0)] is None
    assert slow["requirements"][0]["values"][place(1.4, 1, 1.0)] is None
    assert slow["hours"][place(0.7, 2, 1.0)] is not None


def test_a_page_has_it_only_where_it_is_asked_for(made, tmp_path, capsys):
    gj.write_toml(made, tmp_path / "recipe.toml")
    without, with_it = tmp_path / "without.html", tmp_path / "with.html"
    report(tmp_path / "recipe.toml", without)
    assert main(["report", str(tmp_path / "recipe.toml"), "--panel", "-o", str(with_it)]) == 0
    assert "<script" not in without.read_text(encoding="utf-8")
    text = with_it.read_text(encoding="utf-8")
    assert text.count("<script") == 1
    assert not re.search(r"<script[^>]+src|fetch\(|import\(|XMLHttp", text)
    assert with_it.stat().st_size - without.stat().st_size < 300_000
    programme = [{"soak": "60 s", "at": "20 degC"}, {"ramp_to": "26 degC", "rate": "1 K/min"}]
    course = {"plan.temperature": None, "plan.gradient": None, "plan.soak": None, "plan.programme": programme}
    gj.write_toml(gj.recipe(gj.changed(made.spec, course)), tmp_path / "other.toml")
    assert main(["report", str(tmp_path / "other.toml"), "--panel", "-o", str(tmp_path / "x.html")]) == 2
    assert "leave out --panel" in capsys.readouterr().err
    assert not (tmp_path / "x.html").exists()


@pytest.mark.browser
@pytest.mark.skipif(browser() is None, reason="there is no Chromium on the path")
@pytest.mark.parametrize("width", [400, 1400])
def test_sliders_show_the_numbers_of_the_grid(made, panel, tmp_path, width):
    gj.write_toml(made, tmp_path / "recipe.toml")
    page = tmp_path / "page.html"
    report(tmp_path / "recipe.toml", page, panel=True)
    with Chromium(browser()) as chromium:
        chromium.open(page, width)
        assert chromium.messages == []
        assert all(url.startswith(("file:", "data:")) for url in chromium.requests)
        for at in [(2, 0, 2), (0, 1, 4), (4, 2, 0), (3, 1, 1)]:
            shown = json.loads(chromium.evaluate(_MOVE.replace("AT", json.dumps(at))))
            k = (at[0] * len(RAMPS) + at[1]) * len(ANGLES) + at[2]
            assert shown["labels"] == [c["labels"][i] for c, i in zip(panel["choices"], at, strict=True)]
            if panel["lasts"][k] is None:
                assert "does not fit" in shown["time"]
                assert {told[0] for told in shown["rows"]} == {"–"}
                continue
            assert panel["lasts"][k] in shown["time"]
            for told, row in zip(shown["rows"], panel["requirements"], strict=True):
                assert float(told[0].split("\N{NO-BREAK SPACE}")[0]) == pytest.approx(row["values"][k], rel=1e-3)
                assert told[0].endswith(row["unit"])
                assert told[1] == (row["verdicts"][k] or "")
            fits = [h for place, h in enumerate(panel["hours"]) if place % len(ANGLES) == at[2] and h is not None]
            assert shown["dots"] == len(fits) + 1
            assert shown["widest"] <= width
            assert overlaps(chromium.evaluate(BOXES)) == []
        chromium.call("Emulation.setEmulatedMedia", media="print")
        assert chromium.evaluate("getComputedStyle(document.getElementById('panel')).display") == "none"


_MOVE = """
(() => {
  const at = AT, panel = document.getElementById("panel");
  panel.querySelectorAll("input").forEach((input, i) => {
    input.value = at[i];
    input.dispatchEvent(new Event("input"));
  });
  const texts = nodes => [...nodes].map(n => n.textContent);
  return JSON.stringify({
    labels: texts(panel.querySelectorAll("output")),
    time: document.getElementById("panel-time").textContent,
    rows: [...panel.querySelectorAll("tbody tr")].map(
      r => texts(r.querySelectorAll("td span")).filter((_, i) => i % 2)
    ),
    dots: panel.querySelectorAll("circle").length,
    widest: document.documentElement.scrollWidth,
  });
})()
"""
