"""The simulated table, chamber and gyro at the set points of the standard method: errors as the model has them.

Without the run, whose end-to-end proofs are elsewhere: what is asked here is whether the simulated data have the
variance that prediction and estimate take them to have. Fifty seeds of the paper's own spec.
"""

import numpy as np
from expected_errors import Observations, solve, whitened
from helpers import NoEarth
from scipy.stats import chi2

from gradcal_jax.hardware.simulate.draws import draw_table, draw_truth
from gradcal_jax.hardware.simulate.imu import SimulatedImu, TableTruth
from gradcal_jax.hardware.simulate.plants import AxisPlant, ChamberPlant, ChamberTruth
from gradcal_jax.information import imu_system
from gradcal_jax.model.build import build_imu
from gradcal_jax.motion import body_nodes, held, table_motion
from gradcal_jax.spec import presets
from gradcal_jax.spec.changes import changed
from gradcal_jax.spec.spec import parse_spec
from gradcal_jax.spec.spec_sections import Spec

SEEDS, RATE_HZ = 50, 4.0
SETTLED_S, SPINNING_S = 1800.0, 2.0
# An east-pointing axis, where the Earth's rate has no component.
EAST = TableTruth(((1.0, 0.0, 0.0),), np.radians(45.0), 9.8)


def recorded(spec: Spec, seed: int) -> tuple[np.ndarray, np.ndarray, np.ndarray, dict[str, float]]:
    """Of every set point temperature (°C), the gyro's integral and the encoder's angle (deg); and the truth."""
    plan, truth, (_, encoders, _) = spec.schedule, draw_truth(spec, seed, 1), draw_table(spec, seed)
    chamber = ChamberPlant(ChamberTruth(start_c=float(plan.temperatures[0]), load_time_constant_s=1.0))
    axis = AxisPlant(encoders[0])
    sensor = SimulatedImu(truth, EAST, chamber, [axis], sample_rate_hz=RATE_HZ, seed=seed + 1)
    now, rows = 0.0, []

    def last(time_s: float):
        nonlocal now
        now += time_s
        chamber.advance(now)
        return sensor.take(round(time_s * RATE_HZ))

    for temperature in plan.temperatures:
        chamber.command(now, target_c=float(temperature))
        axis.spin(now, 0.0, 1500.0)
        last(SETTLED_S)
        for rate in plan.rates:
            axis.spin(now, float(np.degrees(rate)), 1500.0)
            last(SPINNING_S)
            before = axis.reading(now)
            said = last(float(plan.integration))
            turned = axis.reading(now) - before
            rows.append((np.mean(said.temperature_c), np.sum(said.rate_dps[:, 0]) / RATE_HZ, turned))
    return *np.array(rows).T, truth.names


def test_fifty_seeds_scatter_as_the_model_says():
    spec = changed(parse_spec(presets.text("paper-dynamic-standard")), {"plan.integration": "1 min"})
    model = build_imu(spec).model
    residuals = errors = 0.0
    for seed in range(SEEDS):
        warmth, said, turned, truth = recorded(spec, seed)
        count, lasts = len(warmth), float(spec.schedule.integration)
        every, start = np.ones(count, bool), np.arange(count) * (lasts + SPINNING_S)
        rate = np.radians(turned) / lasts
        line = held(
            start, np.full(count, lasts), rate, warmth, warmth,
            read=every, at_rest=~every, moving=every, gap=~every, rates=True, points="independent",
        )  # fmt: skip
        table = NoEarth(np.eye(3)[:1], np.eye(3), np.eye(3)[None], np.zeros(()), np.zeros(()))
        motion = table_motion(line, np.zeros(count, int), np.zeros(count, int), table, np.zeros(1), None)
        steps, columns = imu_system(motion, model, body_nodes(motion, 4))
        readings = np.radians(said - turned)[:, None]
        found = solve(whitened(Observations(steps, columns, readings), model))
        residuals += float(np.sum(found.residuals**2))
        error = model.to_reported @ found.parameters[:, 0] - np.array([truth[name] for name in model.names()])
        errors += float(np.sum(np.linalg.solve(model.to_reported @ found.known.spread, error) ** 2))
    freedom = SEEDS * (count - model.size)
    assert (count, model.size) == (36, 16)
    assert 1e-3 < chi2.sf(residuals, freedom) < 1.0 - 1e-3, residuals / freedom
    assert 1e-3 < chi2.sf(errors, SEEDS * model.size) < 1.0 - 1e-3, errors / (SEEDS * model.size)
