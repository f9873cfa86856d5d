"""The generator of random specs: all that it draws is valid, small and of every kind."""

import numpy as np
from random_specs import BASES, FAMILIES, MOST_READINGS, SHAPES, random_spec

from gradcal_jax.spec.motion_plan import row_count
from gradcal_jax.spec.spec import spec_of


def test_random_specs_are_valid_small_and_of_every_kind():
    seen: set[str] = set()
    wanted = {*SHAPES, *BASES, "hand", "programme", "harmonics", "discrepancy", "smoothness", "turn_on_bias", "repeat"}
    wanted |= {"rate_random_walk", "bias_temperature_gradient", "thermal_lag", "step_to"}
    wanted |= {"'read': 'end'", "'read': 'none'", "'used': False"}
    for seed in range(100):
        tables = random_spec(np.random.default_rng(seed), FAMILIES[seed % len(FAMILIES)])
        spec = spec_of(tables)
        assert 0 < row_count(spec.schedule, spec.rig.table) <= MOST_READINGS, seed
        assert spec.requirement
        seen |= {word for word in wanted if word in repr(tables)}
    assert seen == wanted
