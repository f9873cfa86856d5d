"""Logs of a table whose angle is read while it stands (`standing = "read"`): estimated as they are predicted."""

from typing import Any

import numpy as np
import pytest
from estimate_scenes import aligned, draw_truth, estimated, scene, squared
from imu_twin import record
from scipy.stats import chi2

from gradcal_jax.estimation.estimate import estimate_sensors
from gradcal_jax.information.plan_information import imu_posterior
from gradcal_jax.model.build import build_imu
from gradcal_jax.spec.spec import spec_of
from gradcal_jax.spec.spec_sections import Spec

ANGLE = {"reading_noise": "20 arcsec", "standstill_offset": "10 arcsec", "read_every": "1 s"}


def read_scene(plan: str) -> Spec:
    document: dict[str, Any] = scene(plan, 1.0).model_dump(mode="json", exclude_unset=True)
    document["rig"]["table"]["standing"] = "read"
    for axis in document["rig"]["table"]["axis"]:
        axis["angle"] = axis.get("angle", {}) | ANGLE
    return spec_of(document)


@pytest.mark.long
@pytest.mark.parametrize("plan", ["two axes", "one axis, three mountings"])
def test_a_unit_is_estimated_within_its_covariance_and_as_predicted(plan):
    spec = read_scene(plan)
    total = size = 0
    for seed in (11, 12, 13):
        report, truth = estimated(spec, seed, punctual=True)
        total, size = total + squared(report, truth), size + report.built.model.size
        assert 1e-3 < report.solution.test.probability < 1.0 - 1e-3
        # A row of each gyro for every reading of each axis.
        assert report.solution.test.degrees > 2000
    assert 1e-3 < chi2.sf(total, size) < 1.0 - 1e-3
    predicted = imu_posterior(build_imu(spec))
    rng = np.random.default_rng(14)
    (report,) = estimate_sensors(spec, record(spec, aligned(draw_truth(spec, rng)), rng, punctual=True))
    reported = report.built.model.to_reported
    ratio = report.solution.known.deviations(reported) / predicted.deviations(reported)
    assert np.median(ratio) == pytest.approx(1.0, abs=0.02)
    if plan == "two axes":
        assert np.max(np.abs(ratio - 1.0)) < 0.08
