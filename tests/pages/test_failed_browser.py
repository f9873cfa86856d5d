"""Certificate and page of a calibration whose data contradict the model, in a real browser: no green and no "met"."""

import re

import pytest
from headless_chromium import BOXES, Chromium, browser, overlaps
from report_samples import calibration, recipe

import gradcal_jax as gj
from gradcal_jax.calibration import LOG_HASH
from gradcal_jax.cli import main

pytestmark = [
    pytest.mark.browser,
    pytest.mark.skipif(
        browser() is None, reason="there is no Chromium on the path: install one, or set GRADCAL_BROWSER"
    ),
]
# Colours of all that shows, but for pictures and the list of terms: what is drawn, as red, green and blue.
COLOURS = """
[...document.querySelectorAll('body, body *:not(svg *):not(#words *)')].flatMap(e => {
  const s = getComputedStyle(e);
  return [s.color, s.backgroundColor, ...['Top', 'Left', 'Bottom', 'Right']
    .filter(side => parseFloat(s[`border${side}Width`]) > 0).map(side => s[`border${side}Color`])];
})
"""
TEXT = "(document.querySelector('#words')?.remove(), document.body.innerText)"


def greens(colours):
    """Opaque colours of which green is clearly the strongest part."""
    parts = ([float(n) for n in re.findall(r"[\d.]+", colour)] for colour in set(colours))
    return [rgb for rgb in parts if rgb[3:] != [0.0] and rgb[1] > rgb[0] + 20 and rgb[1] > rgb[2] + 20]


@pytest.fixture(scope="module", params=["met", "not valid"])
def pages(request, tmp_path_factory):
    """The verdict of a calibration, its page and its certificate."""
    folder = tmp_path_factory.mktemp("failed")
    gj.write_toml(recipe(), folder / "recipe.toml")
    found = calibration(recipe())
    row = found.result[0].model_copy(
        update={"verdict": request.param, "worst": 800.0, "coverage": 2.0, "rule": "simple acceptance"}
    )
    failed = ("gyro_x: chi-squared",) if request.param == "not valid" else ()
    provenance = {**found.provenance, LOG_HASH: "0123456789abcdef" * 4}
    made = found.model_copy(update={"result": (row,), "contradicted": failed, "provenance": provenance})
    gj.write_calibration(made, folder / "cal.toml")
    for name, options in {"page": [], "certificate": ["--certificate"]}.items():
        words = ["report", folder / "recipe.toml", folder / "cal.toml", *options, "-o", folder / f"{name}.html"]
        assert main([str(word) for word in words]) == 0
    return request.param, folder


@pytest.mark.parametrize("name", ["page", "certificate"])
def test_nothing_is_green_or_met_that_failed_and_it_fits(pages, name):
    verdict, folder = pages
    with Chromium(browser()) as chromium:
        for width in (400, 1400):
            chromium.open(folder / f"{name}.html", width)
            assert chromium.evaluate("document.documentElement.scrollWidth") <= width
            boxes = chromium.evaluate(BOXES)
            assert max(box[3] for box in boxes) <= width
            assert overlaps(boxes) == []
        colours, text = chromium.evaluate(COLOURS), chromium.evaluate(TEXT)
    says_met = re.search(r"(?<!not )\bmet\b", text, re.IGNORECASE) is not None
    # Both checks see what a calibration that holds shows.
    assert says_met == (verdict == "met")
    assert bool(greens(colours)) == (verdict == "met" and name == "page")
    assert ("not valid" in text.lower()) == (verdict == "not valid")
    assert name == "page" or "0123456789abcdef" * 4 in text
    if name == "certificate":
        assert "– ppm" not in text
        assert "± –" not in text
        # At the head of both parts, and in the paragraph on validity.
        assert text.count("NOT VALID: the data contradict") == (3 if verdict == "not valid" else 0)
        assert ("Not stated: nothing is certified." in text) == (verdict == "not valid")
