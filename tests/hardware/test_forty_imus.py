"""Forty units on simulated tables of two and three axes: tilted, mounted a little askew, the Earth turning beneath."""

import json
import tomllib
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from hardware_evidence import record
from imu_bench import MOVES, made, short
from matrix_errors import nees_of
from scipy.stats import chi2

from gradcal_jax.estimation.estimate import estimate_sensors
from gradcal_jax.estimation.log_rows import clock_fit
from gradcal_jax.hardware import execute
from gradcal_jax.information.imu_residual import quantity_of
from gradcal_jax.model.imu_build import build_imu
from gradcal_jax.records import run_log
from gradcal_jax.spec import presets
from gradcal_jax.spec.changes import changed
from gradcal_jax.spec.spec_sections import Spec

RUNS, UNITS = 20, 2


def three_axes() -> Spec:
    """The same plan on the inner axes of a three-axis table, with two poses of the outer one."""
    table = tomllib.loads(presets.text("standard-three-axes"))["rig"]["table"]
    inner = {"tilt": "middle", "spin": "inner"}

    def renamed(move: dict[str, Any]) -> dict[str, Any]:
        if "pose" in move:
            return move | {"pose": {inner[axis]: to for axis, to in move["pose"].items()}}
        return move | ({"axis": inner[move["axis"]]} if "axis" in move else {})

    # Upright, the outer and the inner axis are parallel: without a rest no gyro tells one from the other.
    moves = [*(renamed(move) for move in MOVES), {"rest": "3 s"}]
    moves += [{"pose": {"outer": goal}, "rest": "3 s"} for goal in ("90 deg", "0 deg")]
    return changed(short(3), {"rig.table": table | {"tilt": "100 urad"}, "plan.cycle.moves": moves})


@pytest.mark.evidence
@pytest.mark.parametrize(("axes", "spec"), [("two", short(3)), ("three", three_axes())])
def test_forty_units_err_as_predicted(tmp_path: Path, axes: str, spec: Spec) -> None:
    """Runs through devices, journal and log: every quantity's residual over its prediction, χ² of the data, and the
    errors of each unit's own parameters in their covariance."""
    built = build_imu(spec)
    quantities = [quantity_of(built, requirement) for requirement in spec.requirement]
    square, expected, nees, chi, degrees, own = [], [], 0.0, 0.0, 0, 0

    def power(quantity: Any, values: np.ndarray) -> float:
        each = [np.asarray(e.contrasts().rows) @ values[e.where] for e in quantity.elements]
        return float(np.mean([np.sum(e**2) / len(e) for e in each]))

    for seed in range(RUNS):
        folder = tmp_path / f"run {seed}"
        assert execute.run(made(spec), folder, simulate=True, seed=seed, units=UNITS).exit_status == "success"
        hidden = json.loads((folder / "hidden_truth.json").read_text(encoding="utf-8"))
        for unit, found in hidden["units"].items():
            log = run_log.log(folder, unit)
            (report,) = estimate_sensors(spec, [log])
            # Rates are integrated over the computer's time; the simulated unit's clock is right.
            truth = {"sample_clock": clock_fit(log).slope - 1.0} | found | hidden["installation"]
            names, reported = report.built.model.names(), report.built.model.to_reported
            values, hidden_values = reported @ report.solution.parameters, np.array([truth[name] for name in names])
            error = np.linalg.solve(reported, values - hidden_values)
            known = report.solution.known
            square.append([power(q, error) for q in quantities])
            expected.append([power(q, known.spread) for q in quantities])
            # The table is the same for all units of a run: its errors would count again and again.
            its = [k for k, name in enumerate(names) if name in found]
            covariance = known.covariance(reported[its])
            nees += nees_of([names[k] for k in its], values[its], hidden_values[its], covariance)
            own += len(found)
            chi += report.consistency.fit.statistic
            degrees += report.consistency.fit.degrees
    ratio = np.sqrt(np.mean(square, axis=0) / np.mean(expected, axis=0))
    # Units of one run share a table: what is left of a quantity counts run by run.
    by_run = np.mean(np.reshape(square, (RUNS, UNITS, -1)), axis=1)
    doubt = 0.5 * np.std(by_run, axis=0, ddof=1) / np.sqrt(RUNS) / np.mean(by_run, axis=0)
    together = float(np.exp(np.mean(np.log(ratio))))
    assert abs(together - 1.0) < 0.05, ratio
    assert np.all(np.abs(ratio - 1.0) < 3.0 * doubt), (ratio, doubt)
    assert chi2.ppf(0.005, degrees) < chi < chi2.ppf(0.995, degrees), (chi, degrees)
    assert chi2.ppf(0.005, own) < nees < chi2.ppf(0.995, own), (nees, own)
    record(
        f"forty units on a table of {axes} axes",
        f"residual over prediction {together:.3f} in the geometric mean of {len(ratio)} quantities ({ratio.min():.3f} "
        f"to {ratio.max():.3f}, each ± {np.median(doubt):.3f}); χ² of the data {chi:.0f} of {degrees}, of the units' "
        f"parameters {nees:.0f} of {own}",
        "test_forty_imus",
    )
