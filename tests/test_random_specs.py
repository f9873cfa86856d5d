"""The generator of random specs: all that it draws is valid, small and of every kind."""

import numpy as np
import pytest
from random_specs import BASES, FAMILIES, MOST_READINGS, SHAPES, random_spec

from gradcal_jax.spec.motion_plan import row_count
from gradcal_jax.spec.schedule import StandardSchedule
from gradcal_jax.spec.spec import spec_of


def test_random_specs_are_valid_small_and_of_every_kind():
    seen: set[str] = set()
    for seed in range(300):
        tables = random_spec(np.random.default_rng(seed))
        schedule, table = (spec := spec_of(tables)).schedule, spec.rig.table
        readings = schedule.readings if isinstance(schedule, StandardSchedule) else row_count(schedule, table)
        assert 0 < readings <= MOST_READINGS, seed
        assert random_spec(np.random.default_rng(seed)) == tables
        assert spec.requirement
        text = repr(tables)
        wanted = (*FAMILIES, *SHAPES, *BASES, "hand", "least squares", "programme", "harmonics", "discrepancy")
        wanted += ("smoothness", "turn_on_bias", "rate_random_walk", "bias_temperature_gradient", "thermal_lag")
        wanted += ("'read': 'end'", "'read': 'none'", "'used': False", "step_to", "repeat")
        seen |= {word for word in wanted if word in text}
    assert seen == set(wanted)


@pytest.mark.parametrize(
    ("restrict", "holds"),
    [
        ({"family": "dynamic standard", "estimator": "least squares"}, lambda s: "estimator" in s["plan"]),
        ({"family": "static gradient", "temperature": "programme"}, lambda s: "programme" in s["plan"]),
        ({"processes": False}, lambda s: "drift" not in s["sensor"]["gyro"]),
        ({"bases": ("bins",)}, lambda s: "knots" not in repr(s)),
    ],
)  # fmt: skip
def test_what_is_restricted_is_not_drawn(restrict, holds):
    for seed in range(20):
        tables = random_spec(np.random.default_rng(seed), **restrict)
        spec_of(tables)
        assert holds(tables)
