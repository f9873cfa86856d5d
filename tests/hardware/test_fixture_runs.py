"""A fixture of three IMUs from the run on simulated devices to the calibrations, a log each."""

import json

import pytest
from imu_bench import made, short
from scipy.stats import chi2
from test_end_to_end import distance

from gradcal_jax.calibration.file import read_calibration
from gradcal_jax.cli import main
from gradcal_jax.estimation.estimate import estimate_sensors
from gradcal_jax.hardware import execute
from gradcal_jax.records import run_log
from gradcal_jax.spec.changes import changed

PLACES = [
    {"name": "left"},
    {"name": "right", "x": "+y", "y": "-x"},
    {"name": "back", "rotation": ["53.13010235415598 deg", "0 deg", "0 deg"]},
]


@pytest.fixture(scope="module")
def run(tmp_path_factory):
    folder = tmp_path_factory.mktemp("fixture") / "run"
    spec = changed(short(2), {"rig.table.place": PLACES})
    assert execute.run(made(spec), folder, simulate=True, seed=1).exit_status == "success"
    return spec, folder


@pytest.mark.long
def test_an_imu_at_another_place_than_the_spec_has_is_noticed(run):
    spec, folder = run
    wrong = [PLACES[0], PLACES[1] | {"x": "-y", "y": "+x"}, PLACES[2]]
    logs = [run_log.log(folder, place["name"]) for place in PLACES]
    with pytest.raises(ValueError, match=r"right, gyro y: the output is -1 times .* or the mounting"):
        estimate_sensors(changed(spec, {"rig.table.place": wrong}), logs)


@pytest.mark.long
def test_every_imu_of_a_run_has_its_calibration_by_its_place(run, tmp_path, capsys):
    _, folder = run
    hidden = json.loads((folder / "hidden_truth.json").read_text(encoding="utf-8"))
    names = [place["name"] for place in PLACES]
    assert list(hidden["units"]) == names
    logs = [str(tmp_path / f"{name}.nc") for name in names]
    for name, log in zip(names, logs, strict=True):
        assert main(["log", str(folder), "--unit", name, "-o", log]) == 0
    words = ["estimate", *logs, "--recipe", str(folder / "recipe.toml"), "-o", str(tmp_path / "cal.toml")]
    assert main(words) in (0, 1), capsys.readouterr().err
    for name in names:
        calibration = read_calibration(tmp_path / f"cal-{name}.toml")
        assert calibration.serial_number == name
        nees, count = distance(calibration, hidden["units"][name])
        assert count > 20
        assert 1e-4 < chi2.sf(nees, count) < 1.0 - 1e-4
