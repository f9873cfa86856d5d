"""Units at 1 to 10 rows a second, as factories record: the motion within a move, and the stops between moves of two
axes, are those of the plan."""

from dataclasses import replace

import numpy as np
import pytest
from estimate_scenes import draw_truth, record, scene
from scipy.stats import chi2

from gradcal_jax.estimation.estimate import estimate_sensors
from gradcal_jax.estimation.fit_of_log import planned_moves
from gradcal_jax.model.imu_build import build_imu
from gradcal_jax.records.log import Log

RECORDED_HZ = 100


def slower(log: Log, rate_hz: float) -> Log:
    """Several rows as one: their mean rate and force, the last one's angle and temperature; at rest if all stand."""
    n = round(RECORDED_HZ / rate_hz)
    count = len(log.time_s) // n * n
    last = slice(n - 1, count, n)

    def mean(values: np.ndarray | None) -> np.ndarray:
        assert values is not None
        return values[:, :count].reshape(len(values), -1, n, values.shape[2]).mean(axis=2)

    assert log.standstill is not None
    assert log.temperature_c is not None
    assert log.table_angle_rad is not None
    number = log.standstill[:count].reshape(-1, n)
    return replace(
        log,
        time_s=log.time_s[last],
        rate_rad_per_s=mean(log.rate_rad_per_s),
        specific_force_m_per_s2=mean(log.specific_force_m_per_s2),
        temperature_c=log.temperature_c[:, last],
        table_angle_rad=log.table_angle_rad[last],
        standstill=np.where(np.all(number == number[:, :1], axis=1), number[:, 0], -1),
        stretch_starts=np.array([0]),
        rows_read=count // n,
    )


LONG = pytest.mark.evidence
CASES = [
    ("two axes", 2.0, True),
    ("two axes", 2.0, False),
    ("two axes", 10.0, True),
    *(pytest.param("two axes", hz, True, marks=LONG) for hz in (1.0, 5.0)),
    *(pytest.param("one axis, three mountings", hz, True, marks=LONG) for hz in (1.0, 2.0, 5.0, 10.0)),
]


@pytest.mark.parametrize(("plan", "rate_hz", "marked"), CASES)
def test_a_unit_is_estimated_within_its_covariance(plan, rate_hz, marked):
    spec, rng = scene(plan, 1.0), np.random.default_rng(11)
    truth = draw_truth(spec, rng)
    logs = [slower(log, rate_hz) for log in record(spec, truth, rng, rate_hz=float(RECORDED_HZ))]
    (report,) = estimate_sensors(spec, logs if marked else [replace(log, standstill=None) for log in logs])
    values = np.linalg.solve(report.built.model.to_reported, np.array(list(truth.values())))
    white = np.linalg.solve(report.solution.known.spread, report.solution.parameters - values)
    assert 1e-3 < chi2.sf(white @ white, len(white)) < 1.0 - 1e-3
    assert 1e-3 < report.consistency.fit.probability < 1.0 - 1e-3


def test_the_moves_between_rests_are_the_plans():
    spec = scene("two axes", 1.0)
    groups = planned_moves(build_imu(spec))
    turns = [step for step in spec.schedule.steps if step.axis >= 0]
    assert sum(map(len, groups)) == len(turns)
    assert {len(group) for group in groups} == {1, 2}
    # The last moves of a cycle and the first ones of the next lie between the same rests.
    assert spec.schedule.steps[0].axis < 0
    assert spec.schedule.steps[-1].axis >= 0
    for move, step in zip((m for group in [*groups[1:], groups[0]] for m in group), turns, strict=True):
        assert (move.axis, move.duration) == (step.axis, step.move.duration)
        assert move.angle == pytest.approx(step.move.angle, rel=1e-9)
        assert (move.profile[0], move.profile[-1]) == (0.0, pytest.approx(1.0))
        # A symmetrical turn is half done after half its time.
        assert move.profile[len(move.profile) // 2] == pytest.approx(0.5, abs=1e-9)
        assert np.all(np.diff(move.profile) >= 0.0)
