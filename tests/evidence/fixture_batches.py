"""A fixture of twelve IMUs in six orientations: batches of simulated runs, each estimated together: one share of many.

Runs through simulated devices, journal and log (`hardware.simulate`), estimated as a user would. The errors of every
IMU are compared with the joint covariance of the prediction and of the estimate.
`PYTHONPATH=.:tests:tests/hardware python tests/evidence/fixture_batches.py --first 0 --count 5 FOLDER` writes one file;
`pytest -m evidence tests/evidence/test_fixtures.py` judges those of `experiments/evidence/fixtures`.
"""

import argparse
import json
import tempfile
from functools import cache
from pathlib import Path
from typing import Any, NamedTuple

import jax
import numpy as np
from imu_bench import made, short
from matrix_errors import nees_of

from gradcal_jax.estimation import posteriors_together
from gradcal_jax.estimation.estimate import estimate_sensors
from gradcal_jax.hardware import execute
from gradcal_jax.information import Posterior
from gradcal_jax.model.imu_build import BuiltImu, build_imu, imu_posterior
from gradcal_jax.records import run_log
from gradcal_jax.spec.changes import changed
from gradcal_jax.spec.places import specs_at_places
from gradcal_jax.spec.spec_sections import Spec

SIX = (
    {},
    {"x": "+x", "y": "-y", "z": "-z"},
    {"x": "+y", "y": "+z", "z": "+x"},
    {"x": "-y", "y": "+z", "z": "-x"},
    {"x": "+z", "y": "+x", "z": "+y"},
    {"x": "-z", "y": "+x", "z": "-y"},
)
# At a constant temperature, with maps that are constant: the air of the simulated chamber follows a ramp of two minutes
# 40 s late, which no spec says.
LEVEL = {"basis": "polynomial", "degree": 0, "centre": "23 degC", "scale": "5 K"}
CONSTANT = {
    "plan.temperature": None, "plan.gradient": None,
    "plan.programme": [{"soak": "108 s", "at": "23 degC", "used": True}],
    **{f"sensor.{kind}.{key}.temperature": LEVEL
       for kind in ("gyro", "accelerometer") for key in ("bias", "scale_factor", "misalignment")},
}  # fmt: skip
PLACES = [{"name": f"place{k + 1}", **SIX[k % 6]} for k in range(12)]


class Planned(NamedTuple):
    """The spec; of each orientation the model and the posteriors of one IMU and of all together."""

    spec: Spec
    at: dict[str, Spec]
    built: list[BuiltImu]
    alone: list[Posterior]
    together: list[Posterior]


@cache
def planned() -> Planned:
    spec = changed(short(2), CONSTANT | {"rig.table.place": PLACES})
    at = specs_at_places(spec)
    built = [build_imu(at[place["name"]]) for place in PLACES[:6]]
    alone = [imu_posterior(one) for one in built]
    plans = [(b.model, b.motion, b.body_nodes(), one) for b, one in zip(built, alone, strict=True)]
    return Planned(spec, at, built, alone, posteriors_together(plans, [2] * 6, clock=spec.sensor.takes_host_clock))


def predicted_shares() -> dict[str, float]:
    """Of the table's errors: σ by all IMUs over σ by one."""
    model, of = planned().built[0].model, planned()
    table = np.eye(model.size)[model.calibrated :]
    ratio = of.together[0].deviations(table) / of.alone[0].deviations(table)
    return dict(zip(model.names()[model.calibrated :], map(float, ratio), strict=True))


def batch(seed: int, *, alone: bool = False) -> dict[str, Any]:
    """One batch: by place the squared errors over the predicted variances (mean), NEES in the estimate's covariance, of
    coefficients and of a matrix's elements, and their degrees, and the IMUs that are named as contradicting the others;
    `alone`: the table's share, too."""
    spec, at, built, _, together = planned()
    with tempfile.TemporaryDirectory() as place:
        folder = Path(place) / "run"
        assert execute.run(made(spec), folder, simulate=True, seed=seed).exit_status == "success"
        hidden = json.loads((folder / "hidden_truth.json").read_text(encoding="utf-8"))
        logs = [run_log.log(folder, name) for name in hidden["units"]]
        reports = estimate_sensors(spec, logs)
        result: dict[str, Any] = {"seed": seed, "squares": [], "nees": [], "elements": [], "degrees": [], "named": 0}
        for k, report in enumerate(reports):
            truth, names = hidden["units"][report.unit], report.built.model.names()
            own = [j for j, name in enumerate(names) if name in truth and name in report.calibration.values()]
            reported = report.built.model.to_reported[own]
            found, true = reported @ report.solution.parameters, np.array([truth[names[j]] for j in own])
            error = found - true
            covariance = report.solution.known.covariance(reported)
            scale = np.sqrt(np.diag(covariance))
            scaled = covariance / np.outer(scale, scale)
            # By name: the estimate's clock may be another one than the plan's.
            plan = built[k % 6].model
            rows = plan.to_reported[[plan.names().index(names[j]) for j in own]]
            result["squares"].append(float(np.mean((error / together[k % 6].deviations(rows)) ** 2)))
            result["nees"].append(float(error / scale @ np.linalg.solve(scaled, error / scale)))
            result["elements"].append(nees_of([names[j] for j in own], found, true, covariance))
            result["degrees"].append(len(own))
            result["named"] += any("contradicts the other IMUs" in message for message in report.messages)
        if alone:
            first, model = reports[0], reports[0].built.model
            (one,) = estimate_sensors(at[first.unit], logs[:1])
            table = np.eye(model.size)[model.calibrated :]
            ratio = first.solution.known.deviations(table) / one.solution.known.deviations(table)
            result["shares"] = dict(zip(model.names()[model.calibrated :], map(float, ratio), strict=True))
    return result


def main() -> None:
    """One share, the first batch of which has the table's share."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("folder", type=Path)
    parser.add_argument("--first", type=int, required=True)
    parser.add_argument("--count", type=int, required=True)
    chosen = parser.parse_args()
    jax.config.update("jax_enable_x64", True)
    chosen.folder.mkdir(parents=True, exist_ok=True)
    numbers = range(chosen.first, chosen.first + chosen.count)
    rows = [json.dumps(batch(n, alone=n == chosen.first)) + "\n" for n in numbers]
    (chosen.folder / f"{chosen.first:03d}.jsonl").write_text("".join(rows), encoding="utf-8")


if __name__ == "__main__":
    main()
