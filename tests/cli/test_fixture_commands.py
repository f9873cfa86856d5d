"""The commands of a fixture of two IMUs, from the run to a page and a certificate of each."""

import shutil
from pathlib import Path

import pytest
from imu_bench import made, short

from gradcal_jax.cli import main
from gradcal_jax.spec.changes import changed, tables_of
from gradcal_jax.tables.writing import write_toml

PLACES = [{"name": "left"}, {"name": "right", "x": "+x", "y": "-y", "z": "-z"}]


@pytest.mark.long
def test_logs_pages_and_certificates_of_all_imus(tmp_path: Path, capsys, monkeypatch):
    recipe, run = tmp_path / "recipe.toml", tmp_path / "run"
    # (A page has some forty pictures of all requirements, which tests/pages draw.)
    monkeypatch.setattr("gradcal_jax.pages.figures.svg_of", lambda figure, key: "<svg/>")
    few = [row for row in tables_of(short())["requirement"] if row["quantity"] in ("gyro_bias", "accelerometer_bias")]
    write_toml(made(changed(short(), {"rig.table.place": PLACES, "requirement": few})), recipe)

    def say(*words: object) -> str:
        status = main([str(word) for word in words])
        assert status in (0, 1), words
        return capsys.readouterr().out

    say("run", recipe, "--simulate", "--seed", 3, "--json", "-o", run)
    assert [line for line in say("log", run).splitlines() if "wrote" in line] == [
        f"wrote {run / f'log-{name}.nc'}" for name in ("left", "right")
    ]
    say("estimate", *sorted(run.glob("*.nc")), "--recipe", recipe, "-o", run / "calibration.toml")
    written = say("report", run, "-o", tmp_path / "page.html")
    assert written.split() == ["wrote", str(tmp_path / "page-left.html"), "wrote", str(tmp_path / "page-right.html")]
    say("report", run, "--certificate", "-o", tmp_path / "certificate.html")
    for name, own, other in (("left", "SIMULATED1", "SIMULATED2"), ("right", "SIMULATED2", "SIMULATED1")):
        certificate = (tmp_path / f"certificate-{name}.html").read_text(encoding="utf-8")
        assert own in certificate
        assert other not in certificate
    # One that is named has a page of the usual name.
    say("report", run, run / "calibration-right.toml", "-o", tmp_path / "one.html")
    assert (tmp_path / "one.html").exists()
    # And a page of the recipe alone is of the worst place.
    shutil.rmtree(run)
    say("report", recipe, "-o", tmp_path / "plan.html")
