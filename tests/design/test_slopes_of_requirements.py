"""The derivative of what a cycle leaves of each requirement of an IMU, against differences."""

from pathlib import Path

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import gradcal_jax as gj
from gradcal_jax.design.cycle_plan import CyclePlan
from gradcal_jax.design.slots import _UNITS as UNITS

IMU = Path(__file__).parents[2] / "experiments" / "imu"
QUICKLY = {"xla_backend_optimization_level": 0, "xla_llvm_disable_expensive_passes": True}
# A cycle that closes, with all eight requirements; axes of limited travel; and a plan that observes no second order of
# the accelerometers. Each with a step, and an error in units of the largest slope: values of the second are rounded to
# 2e-10; turns of whole circles, in the third, hardly show anything of accelerometers, and a microradian more does.
SPECS = {
    "hand2": (lambda: gj.read_spec(IMU / "hand2.toml"), 1e-5, 1e-6),
    "skew": (lambda: gj.read_spec(IMU / "skew.toml"), 1e-4, 1e-5),
    "gradient-three-axes": (lambda: gj.parse_spec(gj.presets.text("gradient-three-axes")), 1e-7, 1e-3),
}


@pytest.mark.evidence
@pytest.mark.parametrize("name", SPECS)
def test_the_slope_of_each_requirement_is_that_of_differences(name: str) -> None:
    """Along coordinates and at random; at the start, and with an angle, a rate and a rest at their bounds."""
    read, step, within = SPECS[name]
    spec = read()
    unobserved = name == "gradient-three-axes"
    assert any("not observable" in said for said in gj.check(spec)) == unobserved
    plan = CyclePlan(spec)
    of = jax.tree.map(jnp.asarray, plan.structure(plan.start))
    start = plan.coordinates.encode(plan.start.turns, plan.structure(plan.start))
    args = (of, plan.course(plan.start.cycles).ramps, np.inf)

    def logs(z):
        return plan.objective.logs(plan.coordinates.decode(z, of), *args)[0]

    value = jax.jit(logs, compiler_options=QUICKLY)
    slope = jax.jit(jax.grad(lambda z, w: w @ logs(z)), compiler_options=QUICKLY)
    rng, counted = np.random.default_rng(4), len(spec.requirement)
    # An angle at the end of a limited travel, a rate a thousandth below the fastest, a rest near the shortest.
    first, second, *_ = np.flatnonzero(np.asarray(of.axis) >= 0)
    (rest, *_) = np.flatnonzero(of.rests)
    ends = start.copy()
    ends[[0, 1, 2], [first, second, rest]] = np.array([0.5 * np.pi, 7.0, -8.0]) / np.ravel(UNITS)
    turned = plan.coordinates.decode(ends, of)
    if name == "skew":
        (_, high), here = plan.coordinates.limits.reach[of.axis[first]], plan.coordinates.limits.start[of.axis[first]]
        assert float(here + turned.angle[first]) == pytest.approx(high)
    for z in (start, ends):
        slopes = np.stack([np.asarray(slope(z, w)) for w in np.eye(counted)])
        assert np.all(np.isfinite(slopes))
        size = np.max(np.abs(slopes))
        ways = [*rng.standard_normal((6, *z.shape)), *np.eye(z.size)[rng.choice(z.size, 6)].reshape(6, *z.shape)]
        for way in (way / np.linalg.norm(way) for way in ways):
            expected = np.tensordot(slopes, way, axes=2)
            difference = (np.asarray(value(z + step * way)) - np.asarray(value(z - step * way))) / (2.0 * step)
            assert np.max(np.abs(difference - expected)) < within * size
