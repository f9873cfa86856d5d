"""Columns of a map and its discrepancy at once, on few nodes: with nothing lost."""

from pathlib import Path

import numpy as np
import pytest

from gradcal_jax.model import Map
from gradcal_jax.model.build import assemble
from gradcal_jax.motion import gauss_nodes, rule_of
from gradcal_jax.spec.changes import changed
from gradcal_jax.spec.spec import read_spec

SPEC = read_spec(Path(__file__).parents[2] / "experiments/designs/headline.toml")
HIDDEN = {"standard_deviation": "5 ppm", "temperature_degree": 5, "rate_degree": 4}
CHANGES = {
    "cubic": {},
    "hidden": {"sensor.gyro.scale_factor.discrepancy": HIDDEN},
}


def test_map_and_discrepancy_at_once_are_each_alone():
    built = assemble(changed(SPEC, CHANGES["hidden"]))
    nodes = gauss_nodes(built.trajectory(), built.model)
    scale = built.model.scale
    assert isinstance(scale, Map)
    assert scale.beyond is not None
    own, beyond = scale.columns_with_beyond(nodes)
    np.testing.assert_allclose(own, scale.columns(nodes), rtol=0, atol=1e-13 * np.max(np.abs(own)))
    np.testing.assert_allclose(beyond, scale.beyond.columns(nodes), rtol=0, atol=1e-13 * np.max(np.abs(beyond)))


@pytest.mark.parametrize("name", ["cubic", "hidden"])
def test_half_waves_are_resolved_by_their_fewer_nodes(name):
    built = assemble(changed(SPEC, CHANGES[name]))
    line = built.trajectory()
    rule = rule_of(built.model, line)
    assert rule.moving == {"cubic": 13, "hidden": 14}[name]
    result = built.model.columns(gauss_nodes(line, built.model, rule))
    fine = built.model.columns(gauss_nodes(line, built.model, rule._replace(moving=40)))
    np.testing.assert_allclose(result, fine, rtol=0, atol=1e-12 * np.max(np.abs(fine)))
