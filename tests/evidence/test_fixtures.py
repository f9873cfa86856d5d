"""A fixture of twelve IMUs in six orientations: batches of simulated runs, each estimated together.

Runs through simulated devices, journal and log (`hardware.simulate`), estimated as a user would. The errors of every
IMU are compared with the joint covariance of the prediction and of the estimate, and with that of its estimate alone.
"""

import json
import time
from pathlib import Path

import numpy as np
import pytest
from imu_bench import made, short
from scipy.stats import chi2

from gradcal_jax.api.estimate import estimate_sensors
from gradcal_jax.api.imu_build import build_imu, imu_posterior
from gradcal_jax.decoding import run_log
from gradcal_jax.estimation import posteriors_together
from gradcal_jax.files import changed
from gradcal_jax.files.places import specs_at_places
from gradcal_jax.hardware import execute

pytestmark = pytest.mark.evidence

REPORT = Path(__file__).parents[2] / "experiments" / "evidence" / "fixtures.md"
BATCHES, COMPARED = 5, 2
SIX = (
    {},
    {"x": "+x", "y": "-y", "z": "-z"},
    {"x": "+y", "y": "+z", "z": "+x"},
    {"x": "-y", "y": "+z", "z": "-x"},
    {"x": "+z", "y": "+x", "z": "+y"},
    {"x": "-z", "y": "+x", "z": "-y"},
)
PLACES = [{"name": f"place{k + 1}", **SIX[k % 6]} for k in range(12)]

_HEAD = """# A fixture of twelve IMUs in six orientations

Made by `pytest -m evidence tests/evidence/test_fixtures.py`: {batches} batches of a short plan on a two-axis table, run
on simulated devices and estimated together. Reached over predicted: root mean square of the errors of an IMU's own
coefficients over the joint standard deviations that `predict` gives; χ²: in the estimate's joint covariance, all
batches, with its 99 % band.

| orientation | IMUs | reached over predicted | χ² | of | band |
|---|---|---|---|---|---|
"""


def test_batches_err_as_the_joint_covariance_says(tmp_path):
    spec = changed(short(2), {"rig.table.place": PLACES})
    at = specs_at_places(spec)
    builts = [build_imu(at[place["name"]]) for place in PLACES[:6]]
    before = [imu_posterior(built) for built in builts]
    plans = [(b.model, b.motion, b.body_nodes(), one) for b, one in zip(builts, before, strict=True)]
    planned = posteriors_together(plans, [2] * 6, clock=spec.sensor.takes_host_clock)
    squares: dict[int, list[float]] = {k: [] for k in range(6)}
    nees, degrees = np.zeros(6), np.zeros(6, int)
    shares, false = [], 0
    for seed in range(BATCHES):
        folder = tmp_path / f"run{seed}"
        assert execute.run(made(spec), folder, simulate=True, seed=seed).exit_status == "success"
        hidden = json.loads((folder / "hidden_truth.json").read_text(encoding="utf-8"))
        logs = [run_log.log(folder, name) for name in hidden["units"]]
        reports = estimate_sensors(spec, logs)
        for k, report in enumerate(reports):
            truth, names = hidden["units"][report.unit], report.built.model.names()
            own = [j for j, name in enumerate(names) if name in truth and name in report.calibration.values()]
            reported = report.built.model.to_reported
            error = (reported @ report.solution.parameters)[own] - [truth[names[j]] for j in own]
            covariance = report.solution.known.covariance(reported[own])
            scale = np.sqrt(np.diag(covariance))
            squares[k % 6] += ((error / planned[k % 6].deviations(reported[own])) ** 2).tolist()
            nees[k % 6] += error / scale @ np.linalg.solve(covariance / np.outer(scale, scale), error / scale)
            degrees[k % 6] += len(own)
            false += any("contradicts the other IMUs" in message for message in report.messages)
        if seed < COMPARED:
            first = reports[0]
            (alone,) = estimate_sensors(at[first.unit], logs[:1])
            table = np.eye(first.built.model.size)[first.built.model.calibrated :]
            shares.append(first.solution.known.deviations(table) / alone.solution.known.deviations(table))
    reached = np.array([np.sqrt(np.mean(squares[k])) for k in range(6)])
    bands = [chi2.ppf([0.005, 0.995], degrees[k]) for k in range(6)]
    rows = "\n".join(
        f"| {k + 1} | {2 * BATCHES} | {reached[k]:.3f} | {nees[k]:.0f} | {degrees[k]} | {low:.0f} … {high:.0f} |"
        for k, (low, high) in enumerate(bands)
    )
    names = first.built.model.names()[first.built.model.calibrated :]
    of_plan = builts[0].model
    each = np.eye(of_plan.size)[of_plan.calibrated :]
    predicted = planned[0].deviations(each) / before[0].deviations(each)
    estimated = dict(zip(names, np.mean(shares, axis=0), strict=True))
    found = np.array([estimated[name] for name in of_plan.names()[of_plan.calibrated :]])
    ratios = ", ".join(f"{n} {a:.3f} ({b:.3f})" for (n, a), b in zip(estimated.items(), predicted, strict=False))
    text = f"{_HEAD.format(batches=BATCHES)}{rows}\n\n"
    text += f"Errors of the table, σ together over σ by one IMU, estimated (and predicted): {ratios}.\n"
    text += f"\nNamed as a contradiction, where there is none: {false} of {12 * BATCHES} IMUs (at 1 %).\n"
    REPORT.write_text(f"{text}\n{time.strftime('%Y-%m-%d')}\n", encoding="utf-8")
    # Of all orientations; of one, so few IMUs scatter by some 5 % themselves.
    assert abs(np.sqrt(np.mean(np.concatenate(list(squares.values())))) - 1.0) < 0.05
    assert np.all(np.abs(reached - 1.0) < 0.2)
    assert all(low < value < high for value, (low, high) in zip(nees, bands, strict=True))
    assert np.all(np.stack(shares) < 1.0)
    np.testing.assert_allclose(found, predicted, rtol=0.03)
    assert false <= 0.01 * 12 * BATCHES + 4.0 * np.sqrt(0.01 * 12 * BATCHES)
