"""Pages in a real browser, at the width of a telephone and of a desk."""

import shutil

import pytest
from headless_chromium import browser, measured, overlaps

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


@pytest.mark.parametrize(("width", "printed"), [(400, False), (1400, False), (680, True)])
def test_every_figure_shows_and_no_text_lies_on_another(page, width, printed):
    """A page of A4 is as narrow as a small tablet, whose layout is not for paper."""
    found = measured(page, width, printed=printed)
    assert len(found["figures"]) == page.read_text(encoding="utf-8").count("<figure") >= 4
    for wide, high, texts in found["figures"]:
        assert wide > 250.0
        assert high > 150.0
        assert texts > 5
    assert len(found["boxes"]) > 200
    assert overlaps(found["boxes"]) == []
    assert found["wide"] <= found["visible"] == width
    assert max(box[3] for box in found["boxes"]) <= width + 1.0
    assert (set(found["cells"]) == {"table-cell"}) == (width > 400)


def test_the_check_of_overlaps_finds_one(tmp_path):
    path = tmp_path / "wrong.html"
    path.write_text('<p>one line</p><p style="margin-top:-1.6em">another line</p>', encoding="utf-8")
    assert overlaps(measured(path, 400)["boxes"]) == [("one line", "another line")]
