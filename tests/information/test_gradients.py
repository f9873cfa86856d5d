"""Gradients of smooth criteria with respect to every continuous quantity, against differences; at the bounds, too."""

from dataclasses import replace

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from helpers import DEG, SCENES, core
from jax.flatten_util import ravel_pytree

from gradcal_jax.information import at_readings, contrasts, information
from gradcal_jax.motion import rule_of

# A harmonic's phase is some thousand degrees, so that relative steps must be small for the differences to converge.
_STEP = 2e-4


def criteria(plan, model, lag, rule):
    """Mean residual variance, log-determinant and one deviation, in units that make all of them of order one."""
    line = plan.trajectory(lag)
    info = information(line, model, rule)
    t, w = (g.ravel() for g in jnp.meshgrid(jnp.linspace(0.0, 40.0, 4), jnp.linspace(-4.0, 4.0, 5)))
    residual = info.deviations(contrasts(model, "scale_factor", t, w)[0])
    log_det = jnp.sum(jnp.log(jnp.diagonal(info.factor) * info.scale))
    return jnp.stack([1e8 * jnp.mean(residual**2), log_det, 1e4 * info.deviations(jnp.eye(len(info.scale))[:1])[0]])


def in_relative_coordinates(scene, sizes=None):
    """`f(x)` with every continuous number `θ = θ₀(1 + x)`, or `θ₀ + size·x` where θ₀ is 0; and the names of them."""
    plan, model = core(scene)
    rule = rule_of(model, plan.trajectory(scene.lag))
    everything = jax.tree.map(jnp.asarray, (plan, model, scene.lag))
    is_number = lambda x: eqx.is_inexact_array(x) and bool(np.all(np.isfinite(x)))  # noqa: E731
    numbers, fixed = eqx.partition(everything, is_number)
    start, unravel = ravel_pytree(numbers)
    names = [
        jax.tree_util.keystr(path) + (f"[{i}]" if np.ndim(leaf) else "")
        for path, leaf in jax.tree_util.tree_flatten_with_path(numbers)[0]
        for i in range(np.size(leaf))
    ]
    size = jnp.where(start == 0.0, 0.0, start)
    for k, name in enumerate(names):
        for part, value in (sizes or {}).items():
            if part in name and float(start[k]) == 0.0:
                size = size.at[k].set(value)

    @jax.jit
    def f(x):
        made, lagging = (tree := eqx.combine(unravel(start + size * x), fixed))[:2], tree[2]
        return criteria(*made, lagging, rule)

    return f, names, np.asarray(size)


def differences(f, count, chosen, one_sided=()):
    """Fourth-order central differences; for the one-sided, as accurate forward ones."""
    columns = []
    for k in chosen:
        at = lambda s, k=k: np.asarray(f(jnp.zeros(count).at[k].set(s * _STEP)))  # noqa: E731
        if k in one_sided:
            weights = {0: -25 / 12, 1: 4.0, 2: -3.0, 3: 4 / 3, 4: -1 / 4}
        else:
            weights = {-2: 1 / 12, -1: -2 / 3, 1: 2 / 3, 2: -1 / 12}
        columns.append(sum(w * at(s) for s, w in weights.items()) / _STEP)
    return np.stack(columns, axis=1)


def gradients(f, count):
    """Of each criterion; one compilation for all."""
    of_one = jax.jit(jax.grad(lambda x, w: f(x) @ w))
    return np.stack([of_one(jnp.zeros(count), w) for w in jnp.eye(3)])


def check(scene, sizes=None, one_sided=(), only=None):
    f, names, size = in_relative_coordinates(scene, sizes)
    count = len(names)
    chosen = [k for k in range(count) if size[k] != 0.0 and (only is None or any(o in names[k] for o in only))]
    edge = [k for k in chosen if any(o in names[k] for o in one_sided)]
    gradient = gradients(f, count)
    assert np.all(np.isfinite(gradient))
    wanted = differences(f, count, chosen, edge)
    norm = np.linalg.norm(gradient, axis=1, keepdims=True)
    error = np.abs(gradient[:, chosen] - wanted) / norm
    worst = np.unravel_index(np.argmax(error), error.shape)
    assert error[worst] < 1e-6, f"criterion {worst[0]}, {names[chosen[worst[1]]]}: {error[worst]:.2g}"
    return dict(zip(names, gradient.T, strict=True))


def scene_of_everything():
    everything = SCENES["everything"]
    return replace(everything, noises=tuple(n for n in everything.noises if n.kind in ("drift", "scale")))


@pytest.mark.long
def test_along_random_directions_of_all_continuous_quantities():
    f, names, size = in_relative_coordinates(scene_of_everything())
    gradient = gradients(f, len(names))
    assert np.all(np.isfinite(gradient))
    # Harmonics' phases, some thousand degrees, change by the sum of all turns' changes: smaller steps than one by one.
    for direction in np.random.default_rng(2).standard_normal((4, len(names))) * (size != 0.0):
        along = direction / np.linalg.norm(direction)
        at = lambda s, along=along: np.asarray(f(jnp.asarray(s * _STEP * along)))  # noqa: E731
        wanted = sum(w * at(s) for s, w in {-2: 1 / 12, -1: -2 / 3, 1: 2 / 3, 2: -1 / 12}.items()) / _STEP
        assert np.max(np.abs(gradient @ along - wanted) / np.linalg.norm(gradient, axis=1)) < 1e-6
    for part in ("duration", "peak_rate", "ramp", "slopes", "decay", "diffusion", "[2]"):
        assert any(part in name and np.any(g != 0.0) for name, g in zip(names, gradient.T, strict=True)), part


@pytest.mark.evidence
def test_every_continuous_quantity():
    gradient = check(scene_of_everything())
    for part in ("duration", "peak_rate", "ramp", "slopes", "decay", "diffusion", "[2]"):
        assert any(part in name and np.any(g != 0.0) for name, g in gradient.items()), part
    for part in ("angle_random_walk", "reading_noise", "offset", "timing", "amplitudes", "prior_std", "initial_std"):
        assert any(part in name and np.any(g != 0.0) for name, g in gradient.items()), part


def test_at_the_bounds():
    """Ramps that meet in the middle, an offset and a timing error of zero, a drift that never decays."""
    scene = SCENES["gap"]
    halves = tuple(replace(a, ramp=a.duration / 2) if a.ramp else a for a in scene.moves)
    _bound_check(replace(scene, moves=halves))


def _bound_check(scene):
    f, names, size = in_relative_coordinates(
        replace(scene, timing=0.0), {"timing_error": 1e-3, "standstill_offset": 0.01 * DEG, ".decay": 1e-3}
    )
    count = len(names)
    gradient = gradients(f, count)
    assert np.all(np.isfinite(gradient))
    chosen = [k for k, n in enumerate(names) if size[k] != 0.0 and any(p in n for p in ("decay", "timing", "offset"))]
    assert len(chosen) >= 3
    wanted = differences(f, count, chosen, [k for k in chosen if "decay" in names[k] or "timing" in names[k]])
    assert np.max(np.abs(gradient[:, chosen] - wanted) / np.linalg.norm(gradient, axis=1, keepdims=True)) < 1e-6
    # The ramps' own derivative: inward only, since two ramps cannot be longer than the move.
    ramps = [k for k, n in enumerate(names) if ".ramp[" in n and size[k] != 0.0]
    inward = jnp.zeros(count).at[jnp.asarray(ramps)].set(-1.0)
    at = lambda s: np.asarray(f(inward * s * _STEP))  # noqa: E731
    slope = (-25 / 12 * at(0) + 4 * at(1) - 3 * at(2) + 4 / 3 * at(3) - at(4) / 4) / _STEP
    result = gradient @ np.asarray(inward)
    assert np.max(np.abs(result - slope) / np.linalg.norm(gradient, axis=1)) < 1e-6


@pytest.mark.evidence
def test_an_offset_of_zero_that_has_its_state():
    """The state's covariance is then singular; the criteria depend on the offset's square, so their derivative is 0."""
    scene = SCENES["gap"]
    plan, model = jax.tree.map(jnp.asarray, core(scene))
    rule = rule_of(core(scene)[1], core(scene)[0].trajectory())
    zero = eqx.tree_at(lambda m: m.reference.standstill_offset, model, jnp.zeros(()))

    @jax.jit
    def f(offset):
        changed = eqx.tree_at(lambda m: m.reference.standstill_offset, zero, offset)
        return criteria(plan, changed, None, rule)

    value, slope = f(jnp.zeros(())), jax.jit(jax.jacfwd(f))(jnp.zeros(()))
    plain = jax.tree.map(jnp.asarray, core(replace(scene, offset=0.0)))
    alone = eqx.filter_jit(criteria)(*plain, None, rule)
    np.testing.assert_allclose(value, alone, rtol=1e-11)
    np.testing.assert_allclose(slope, 0.0, atol=1e-9)
    assert np.all(f(jnp.asarray(0.01 * DEG))[0] > value[0])


@pytest.mark.evidence
@pytest.mark.parametrize("name", SCENES)
def test_all_scenes(name):
    # A little warmer: at 12 °C, an edge of the bins, a reading's regressor has a kink, which no derivative describes.
    scene = SCENES[name]
    check(replace(scene, start=scene.start + 0.0137))


@pytest.mark.evidence
def test_a_break_at_the_end_of_a_piece_keeps_its_derivative():
    """12 °C, an edge of the bins, is reached as a piece ends: from above the derivative is that of either side."""
    scene = SCENES["bases"]
    rule = rule_of(core(scene)[1], core(scene)[0].trajectory())
    plan, model = jax.tree.map(jnp.asarray, core(scene))

    @jax.jit
    def last(start):
        moved = eqx.tree_at(lambda p: p.programme.start, plan, start)
        return at_readings(moved.trajectory(), model, rule)[-1]

    start = jnp.asarray(scene.start)
    result = jax.jit(jax.jacfwd(last))(start)
    wanted = (last(start + 1e-3) - last(start - 1e-3)) / 2e-3
    np.testing.assert_allclose(result, wanted, atol=1e-6 * np.max(np.abs(wanted)))
