"""A log that ends before its plan does: what it lacks is said, with what the executed part predicts beside it."""

import numpy as np
import pytest
from estimate_scenes import aligned, draw_truth, record, scene
from logs_zoo import STANDARD, spec_of
from simulated_log import simulate_log

from gradcal_jax.estimation.contradictions import lacks_of
from gradcal_jax.estimation.estimate import estimate_log, estimate_rows, estimate_sensors
from gradcal_jax.information.prediction import requirement_rows
from gradcal_jax.records.log import Log, part_of


def cut(log: Log, share: float) -> Log:
    return part_of(log, rows=(0, int(share * len(log.time_s))))


def test_an_axis_log_that_ends_early_says_what_it_lacks_and_what_the_rest_predicts():
    spec = spec_of()
    log = simulate_log(spec, sample_rate_hz=20.0, seed=5, readings=True).log
    planned = sum(stretch.duration for stretch in spec.schedule.stretches)
    part = cut(log, 0.6)
    report = estimate_log(spec, [part])
    (calibration,), (said,) = report.calibrations, report.messages.values()
    assert calibration.lacks is not None
    assert f"of the plan's {planned:.4g} s (60%); predicted for the executed part" in calibration.lacks
    assert calibration.lacks in said
    assert calibration.lacks in estimate_rows(report)["units"][0]["messages"]
    # What the executed part predicts is what is estimated from it.
    predicted = requirement_rows(spec, float(part.time_s[-1]))
    (verdicts,) = report.verdicts.values()
    assert len(predicted) == len(verdicts) > 0
    for before, after in zip(predicted, verdicts, strict=True):
        assert after.decisive == pytest.approx(before.decisive, rel=0.05)
        assert f"{before.name}: {before.decisive:.4g} {before.unit}" in calibration.lacks
    assert estimate_log(spec, [log]).calibrations[0].lacks is None


def test_a_unit_s_log_that_ends_early_says_what_it_lacks_and_what_the_rest_predicts():
    rng = np.random.default_rng(3)
    spec = scene("two axes", 0.1)
    # A prediction counts no product of a misalignment and a scale factor's error, which is large beyond the data.
    logs = record(spec, aligned(draw_truth(spec, rng)), rng)
    assert lacks_of(spec, logs) is None
    part = cut(logs[0], 0.85)
    (report,) = estimate_sensors(spec, [part])
    lacks = report.calibration.lacks
    assert lacks is not None
    assert "(85%); predicted for the executed part" in lacks
    assert report.messages[0] == lacks
    for before, after in zip(requirement_rows(spec, float(part.time_s[-1])), report.requirements, strict=True):
        assert after.decisive == pytest.approx(before.decisive, rel=0.1)


def test_points_that_lack_are_named_by_themselves():
    spec = spec_of(STANDARD)
    assert lacks_of(spec, [cut(simulate_log(spec, sample_rate_hz=5.0).log, 0.5)]) is None
