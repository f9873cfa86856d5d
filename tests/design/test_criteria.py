"""A search looks at a map's residual in few places, and integrates map and discrepancy at once: with nothing lost."""

from pathlib import Path

import numpy as np
import pytest

from gradcal_jax.design import polynomial_grid
from gradcal_jax.design.turn_plan import criterion_of
from gradcal_jax.information import information
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
    "bins": {
        "sensor.gyro.scale_factor.temperature": {"basis": "bins", "edges": ["-30 degC", "0 degC", "40 degC", "70 degC"]}
    },
}


@pytest.mark.parametrize("name", CHANGES)
@pytest.mark.parametrize("statistic", ["mean of max", "rms"])
def test_few_places_tell_the_residual_of_all(name, statistic):
    built = assemble(changed(SPEC, CHANGES[name]))
    info = information(built.trajectory(), built.model)
    requirement = built.spec.requirement[0]
    few, all_of_them = (criterion_of(built.model, requirement, statistic, most) for most in (1000, None))
    np.testing.assert_allclose(few.map(info), all_of_them.map(info), rtol=1e-11)
    assert few(info, 40.0) == pytest.approx(all_of_them(info, 40.0), rel=1e-11)
    assert len(few.rows) <= {"cubic": 49, "hidden": 99, "bins": 101 * 7}[name]


def test_a_polynomial_is_known_by_its_values_in_few_places():
    at = np.linspace(-30.0, 70.0, 41)
    few, between = polynomial_grid(at, 3)
    square = np.polynomial.Polynomial([2.0, -0.3, 0.01, 2e-4]) ** 2
    np.testing.assert_allclose(between @ square(few), square(at), rtol=0, atol=1e-13 * np.max(square(at)))
    same, one = polynomial_grid(at[:5], 3)
    np.testing.assert_array_equal(one @ same, at[:5])


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
