"""Pages in a real browser, at the width of a telephone and of a desk."""

import re

import pytest
from headless_chromium import BOXES, Chromium, browser, overlaps
from imu_bench import short, triad
from report_samples import calibration, recipe, rehearse

from gradcal_jax.calibration import read_calibration, write_calibration
from gradcal_jax.cli import main
from gradcal_jax.estimation.estimate import estimate_sensors
from gradcal_jax.hardware import execute
from gradcal_jax.information import prediction
from gradcal_jax.pages.page import write_page
from gradcal_jax.pages.sources import read_sources
from gradcal_jax.records import run_log

pytestmark = [
    pytest.mark.browser,
    pytest.mark.skipif(
        browser() is None, reason="there is no Chromium on the path: install one, or set GRADCAL_BROWSER"
    ),
]


@pytest.fixture(scope="module", params=["a gyro's axis", "three gyros", "an IMU"])
def html(request, tmp_path_factory):
    """The page of a simulated run and of its calibration."""
    folder = tmp_path_factory.mktemp("browser")
    if request.param != "a gyro's axis":
        plan = prediction.make_recipe(short() if request.param == "an IMU" else triad())
        execute.run(plan, folder / "run", simulate=True, seed=3)
        (found,) = estimate_sensors(plan.spec, [run_log.log(folder / "run")])
        write_calibration(found.calibration, folder / "run" / "calibration.toml")
    else:
        plan = recipe()
        rehearse(plan, folder / "run")
        write_calibration(calibration(plan), folder / "run" / "calibration.toml")
    write_page(read_sources([folder / "run"]), folder / "page.html")
    return folder / "page.html"


@pytest.fixture(scope="module")
def chromium():
    with Chromium(browser()) as running:
        yield running


@pytest.mark.parametrize("width", [400, 1400])
def test_a_page_shows_every_figure_and_no_text_lies_on_another(html, chromium, width):
    chromium.open(html, width)
    assert chromium.messages == []
    assert all(url.startswith(("file:", "data:")) for url in chromium.requests)
    sizes = chromium.evaluate(
        "[...document.querySelectorAll('figure svg')].map(s => [s.getBoundingClientRect().width,"
        " s.getBoundingClientRect().height, s.querySelectorAll('text').length])"
    )
    assert len(sizes) == html.read_text(encoding="utf-8").count("<figure") >= 9
    for wide, high, texts in sizes:
        assert wide > 250.0
        assert high > 150.0
        assert texts > 5
    loaded = chromium.evaluate("[...document.querySelectorAll('svg image')].map(i => i.getBoundingClientRect().width)")
    assert loaded
    assert min(loaded) > 5.0
    boxes = chromium.evaluate(BOXES)
    assert len(boxes) > 300
    assert overlaps(boxes) == []
    visible = chromium.evaluate("document.documentElement.clientWidth")
    assert chromium.evaluate("document.documentElement.scrollWidth") <= visible
    assert max(box[3] for box in boxes) <= visible + 1.0
    assert min(box[1] for box in boxes) >= 0.0


@pytest.mark.parametrize("width", [400, 1400])
def test_a_certificate_fits_and_no_text_lies_on_another(html, chromium, width):
    """That of an accelerometer too."""
    words = ["report", html.parent / "run", "--certificate", "-o", html.parent / "certificate.html", "--force"]
    assert main([str(word) for word in words]) == 0
    chromium.open(html.parent / "certificate.html", width)
    boxes = chromium.evaluate(BOXES)
    assert len(boxes) > 100
    assert overlaps(boxes) == []
    assert max(box[3] for box in boxes) <= width
    assert chromium.evaluate("document.documentElement.scrollWidth") <= width


def test_a_certificate_prints_on_few_sheets(html, chromium, tmp_path):
    words = ["report", html.parent / "run", "--certificate", "-o", tmp_path / "certificate.html"]
    assert main([str(word) for word in words]) == 0
    chromium.open(tmp_path / "certificate.html", 1400)
    chromium.print_pdf(tmp_path / "certificate.pdf")
    data = (tmp_path / "certificate.pdf").read_bytes()
    channels = len(read_calibration(html.parent / "run" / "calibration.toml").channel)
    assert len(re.findall(rb"/Type\s*/Page\b", data)) == {1: 2, 3: 3, 6: 4}[channels]


def test_the_check_of_overlaps_finds_one(tmp_path, chromium):
    path = tmp_path / "wrong.html"
    path.write_text('<p>one line</p><p style="margin-top:-1.6em">another line</p>', encoding="utf-8")
    chromium.open(path, 400)
    assert overlaps(chromium.evaluate(BOXES)) == [("one line", "another line")]


def test_a_page_prints(html, chromium, tmp_path):
    chromium.open(html, 1400)
    chromium.print_pdf(tmp_path / "page.pdf")
    data = (tmp_path / "page.pdf").read_bytes()
    assert data.startswith(b"%PDF")
    # At least three figures on a sheet, and tables.
    most = 6 + html.read_text(encoding="utf-8").count("<figure") // 3
    assert 2 <= data.count(b"/Type /Page\n") + data.count(b"/Type /Page ") <= most


def test_on_paper_tables_are_tables(html, chromium):
    """A page of A4 is as narrow as a small tablet, whose layout is not for paper."""
    chromium.open(html, 680)
    chromium.call("Emulation.setEmulatedMedia", media="print")
    try:
        displays = chromium.evaluate(
            "[...document.querySelectorAll('td, thead')].map(c => getComputedStyle(c).display)"
        )
        assert set(displays) == {"table-cell", "table-header-group"}
        assert overlaps(chromium.evaluate(BOXES)) == []
        assert chromium.evaluate("document.documentElement.scrollWidth") <= 680
    finally:
        chromium.call("Emulation.setEmulatedMedia", media="")
