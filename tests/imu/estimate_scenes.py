"""Units of which a plan's recording is estimated: specs of four kinds of table, their truths, their estimates."""

import tomllib
from typing import Any

import imu_twin
import numpy as np
from imu_helpers import shipped

from gradcal_jax.estimation.estimate import SensorEstimate, estimate_sensors
from gradcal_jax.model.build import build_imu
from gradcal_jax.spec import presets
from gradcal_jax.spec.spec import spec_of
from gradcal_jax.spec.spec_sections import Spec

PLANS = ("two axes", "one axis, three mountings", "three axes", "by hand")
_PRESETS = {
    "one axis, three mountings": "one-axis-table",
    "three axes": "standard-three-axes",
    "by hand": "gimbal-by-hand",
}
# Minutes.
_TWO_CYCLES = {"three axes": 20.0, "by hand": 27.0}


def scene(plan: str, installation_mrad: float, minutes: float = 8.0) -> Spec:
    """A spec whose table is uncertain by so much; its ramp is made quick, so that one recording costs little."""
    document = shipped("hand2") if plan == "two axes" else tomllib.loads(presets.text(_PRESETS[plan]))
    accuracy = f"{installation_mrad} mrad"
    table = document["rig"]["table"]
    table["tilt"] = accuracy
    for axis in table["axis"][:-1]:
        axis["orthogonality"] = accuracy
    for mounting in _list(table.get("mounting", [])):
        if "accuracy" in mounting:
            mounting["accuracy"] = accuracy
    document["rig"]["chamber"] |= {"max_heating": "60 K/min", "max_cooling": "60 K/min"}
    # The same cycle as often as the time allows, over the same temperatures.
    minutes = max(minutes, _TWO_CYCLES.get(plan, 0.0))
    document["plan"] |= {"temperature": ["-30 degC", "70 degC"], "gradient": f"{100.0 / minutes:.6g} K/min"}
    # Two rests that follow one another are one standstill of a log: they are planned as one here.
    moves: list[dict[str, Any]] = []
    for move in document["plan"]["cycle"]["moves"]:
        if moves and set(move) == set(moves[-1]) == {"rest"}:
            moves[-1] = {"rest": f"{float(moves[-1]['rest'].split()[0]) + float(move['rest'].split()[0])} s"}
        else:
            moves.append(move)
    document["plan"]["cycle"]["moves"] = moves
    document["plan"].pop("programme", None)
    document["plan"].pop("soak", None)
    for part in ("gyro", "accelerometer"):
        triad = document["sensor"].get(part, {})
        triad.pop("scale_factor_instability", None)
    document["sensor"].pop("thermal_lag", None)
    return spec_of(document)


def _list(value: Any) -> list[dict[str, Any]]:
    return [value] if isinstance(value, dict) else list(value)


def draw_truth(spec: Spec, rng: np.random.Generator) -> dict[str, float]:
    """Every parameter, drawn from what the spec knows of it before."""
    model = build_imu(spec).model
    rows = model.prior_rows()
    reported = model.to_reported
    root = np.linalg.inv(np.linalg.cholesky(rows.T @ rows)).T
    values = reported @ (root @ rng.standard_normal(model.size))
    return dict(zip(model.names(), values.tolist(), strict=True))


def aligned(truth: dict[str, float]) -> dict[str, float]:
    """The truth of sensors that are hardly misaligned, as ideal as those about which a plan is predicted: where a scale
    factor is poorly known, its error in what a sensor senses across its axis counts for large misalignments."""
    return {name: value * (0.02 if ".m_" in name else 1.0) for name, value in truth.items()}


def squared(report: SensorEstimate, truth: dict[str, float]) -> float:
    """The error of all parameters, normalised by their covariance: χ² with as many degrees of freedom (NEES)."""
    solution, values = report.solution, np.array(list(truth.values()))
    error = solution.parameters - np.linalg.solve(report.built.model.to_reported, values)
    white = np.linalg.solve(solution.known.spread, error)
    return float(white @ white)


def estimated(spec: Spec, seed: int, **options: Any) -> tuple[SensorEstimate, dict[str, float]]:
    """One unit drawn, simulated and estimated; and its true reported parameters."""
    rng = np.random.default_rng(seed)
    truth = draw_truth(spec, rng)
    (report,) = estimate_sensors(spec, imu_twin.record(spec, truth, rng, **options))
    return report, truth
