"""A fixture of three IMUs from the run on simulated devices to the calibrations, a log each."""

import json

import numpy as np
import pytest
from imu_bench import made, short
from scipy.stats import chi2

from gradcal_jax.calibration import read_calibration
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
def test_every_imu_of_a_run_has_its_calibration_by_its_place(run):
    spec, folder = run
    hidden = json.loads((folder / "hidden_truth.json").read_text(encoding="utf-8"))
    assert list(hidden["units"]) == [place["name"] for place in PLACES]
    reports = estimate_sensors(spec, [run_log.log(folder, name) for name in hidden["units"]])
    assert [report.calibration.serial_number for report in reports] == list(hidden["units"])
    for report in reports:
        truth = hidden["units"][report.unit]
        names = report.built.model.names()
        own = [k for k, name in enumerate(names) if name in truth and name in report.calibration.values()]
        reported = report.built.model.to_reported
        error = (reported @ report.solution.parameters)[own] - [truth[names[k]] for k in own]
        covariance = report.solution.known.covariance(reported[own])
        scale = np.sqrt(np.diag(covariance))
        nees = error / scale @ np.linalg.solve(covariance / np.outer(scale, scale), error / scale)
        assert len(own) > 20
        assert 1e-4 < chi2.sf(nees, len(own)) < 1.0 - 1e-4


@pytest.mark.long
def test_an_imu_at_another_place_than_the_spec_has_is_noticed(run):
    spec, folder = run
    wrong = [PLACES[0], PLACES[1] | {"x": "-y", "y": "+x"}, PLACES[2]]
    logs = [run_log.log(folder, place["name"]) for place in PLACES]
    with pytest.raises(ValueError, match=r"right, gyro y: the output is -1 times .* or the mounting"):
        estimate_sensors(changed(spec, {"rig.table.place": wrong}), logs)


@pytest.mark.long
def test_the_command_writes_a_calibration_of_each(run, tmp_path, capsys):
    _, folder = run
    logs = []
    for place in PLACES:
        logs.append(str(tmp_path / f"{place['name']}.nc"))
        assert main(["log", str(folder), "--unit", place["name"], "-o", logs[-1]]) == 0
    cal = tmp_path / "cal.toml"
    status = main(["estimate", *logs, "--recipe", str(folder / "recipe.toml"), "-o", str(cal)])
    printed = capsys.readouterr()
    assert status in (0, 1), printed.err
    assert [read_calibration(tmp_path / f"cal-{place['name']}.toml").serial_number for place in PLACES] == [
        place["name"] for place in PLACES
    ]
