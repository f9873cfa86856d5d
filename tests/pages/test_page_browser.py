"""Pages in a real browser, at the width of a telephone and of a desk."""

import shutil

import pytest
from headless_chromium import BOXES, Chromium, browser, overlaps

import gradcal_jax as gj
from gradcal_jax.cli import main

pytestmark = [
    pytest.mark.browser,
    pytest.mark.skipif(
        browser() is None, reason="there is no Chromium on the path: install one, or set GRADCAL_BROWSER"
    ),
]


@pytest.fixture(scope="module", params=["a gyro's axis", "an IMU"])
def page(request, tmp_path_factory):
    """The page of a simulated run and of its calibration, a certificate in front."""
    folder = tmp_path_factory.mktemp("browser")
    run = request.getfixturevalue("imu_run" if request.param == "an IMU" else "axis_run") / "run"
    if request.param == "an IMU":
        shutil.copytree(run, folder / "run")
        run = folder / "run"
        (found,) = gj.estimate(
            gj.read_recipe(request.getfixturevalue("imu_run") / "recipe.toml").spec, gj.log(run, "unit1")
        ).sensors
        gj.write_calibration(found.calibration, run / "calibration.toml")
    assert main(["report", str(run), "--certificate", "-o", str(folder / "page.html")]) == 0
    return folder / "page.html"


@pytest.fixture(scope="module")
def chromium():
    with Chromium(browser()) as running:
        yield running


@pytest.mark.parametrize("width", [400, 1400])
def test_every_figure_shows_and_no_text_lies_on_another(page, chromium, width):
    chromium.open(page, width)
    assert chromium.messages == []
    assert all(address.startswith(("file:", "data:")) for address in chromium.requests)
    figures = chromium.evaluate(
        "[...document.querySelectorAll('figure svg')].map(s => [s.getBoundingClientRect().width,"
        " s.getBoundingClientRect().height, s.querySelectorAll('text').length])"
    )
    assert len(figures) == page.read_text(encoding="utf-8").count("<figure") >= 4
    for wide, high, texts in figures:
        assert wide > 250.0
        assert high > 150.0
        assert texts > 5
    boxes = chromium.evaluate(BOXES)
    assert len(boxes) > 200
    assert overlaps(boxes) == []
    visible = chromium.evaluate("document.documentElement.clientWidth")
    assert chromium.evaluate("document.documentElement.scrollWidth") <= visible
    assert max(box[3] for box in boxes) <= visible + 1.0


def test_the_check_of_overlaps_finds_one(tmp_path, chromium):
    path = tmp_path / "wrong.html"
    path.write_text('<p>one line</p><p style="margin-top:-1.6em">another line</p>', encoding="utf-8")
    chromium.open(path, 400)
    assert overlaps(chromium.evaluate(BOXES)) == [("one line", "another line")]


def test_on_paper_tables_are_tables(page, chromium):
    """A page of A4 is as narrow as a small tablet, whose layout is not for paper."""
    chromium.open(page, 680)
    chromium.call("Emulation.setEmulatedMedia", media="print")
    try:
        displays = chromium.evaluate("[...document.querySelectorAll('td')].map(c => getComputedStyle(c).display)")
        assert set(displays) == {"table-cell"}
        assert overlaps(chromium.evaluate(BOXES)) == []
        assert chromium.evaluate("document.documentElement.scrollWidth") <= 680
    finally:
        chromium.call("Emulation.setEmulatedMedia", media="")
