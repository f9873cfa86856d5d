"""The derivative of what a cycle leaves of each requirement of an IMU, against differences."""

from pathlib import Path

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import gradcal_jax as gj
from gradcal_jax.api.cycle_plan import CyclePlan

IMU = Path(__file__).parents[2] / "experiments" / "imu"
QUICKLY = {"xla_backend_optimization_level": 0, "xla_llvm_disable_expensive_passes": True}
# A cycle that closes, with all eight requirements; and a plan that observes no second order of the accelerometers.
SPECS = {
    "hand2": lambda: gj.read_spec(IMU / "hand2.toml"),
    "gradient-three-axes": lambda: gj.parse_spec(gj.presets.text("gradient-three-axes")),
}


@pytest.mark.evidence
@pytest.mark.parametrize("name", SPECS)
def test_the_slope_of_each_requirement_is_that_of_differences(name: str) -> None:
    """Along coordinates and in directions at random; at the start, and with the first coordinates at their bounds."""
    spec = SPECS[name]()
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
    # Turns of whole circles show next to nothing of accelerometers, and a microradian more shows much.
    step, within = (1e-7, 1e-3) if unobserved else (1e-5, 1e-6)
    rng, counted = np.random.default_rng(4), len(spec.requirement)
    ends = start.copy()
    ends[:, :2] = [[1.0, 0.0], [0.0, 1.0], [1.0, 0.0]]
    for z in (start, ends):
        slopes = np.stack([np.asarray(slope(z, w)) for w in np.eye(counted)])
        assert np.all(np.isfinite(slopes))
        size = np.max(np.abs(slopes))
        ways = [*rng.standard_normal((6, *z.shape)), *np.eye(z.size)[rng.choice(z.size, 6)].reshape(6, *z.shape)]
        for way in ways:
            expected = np.tensordot(slopes, way, axes=2)
            difference = (np.asarray(value(z + step * way)) - np.asarray(value(z - step * way))) / (2.0 * step)
            assert np.max(np.abs(difference - expected)) < within * size * np.linalg.norm(way) + 1e-8
