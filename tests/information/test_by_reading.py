"""The filter in blocks is dense least squares, and its derivatives are differences."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from helpers import dense_of

from gradcal_jax.information import NoiseSteps, by_reading, gram, weights, whiten


def random_system(n: int, p: int, count: int) -> tuple[NoiseSteps, np.ndarray]:
    """Unused readings, readings without a step before them, and one that is known beforehand."""
    rng = np.random.default_rng([n, p, count])
    stays = (np.arange(count) > 0) & (rng.uniform(size=count) < 0.3)
    transition = np.eye(n) + 0.2 * rng.standard_normal((count, n, n)) / n
    root = 0.3 * rng.standard_normal((count, n, n))
    noise = root @ root.swapaxes(1, 2)
    transition[stays], noise[stays] = np.eye(n), 0.0
    observation, variance = rng.standard_normal((count, n)), rng.uniform(0.1, 1.0, count)
    used = rng.uniform(size=count) > 0.2
    observation[count // 2], variance[count // 2], used[count // 2] = 0.0, 0.0, True
    first = rng.standard_normal((n, n))
    steps = NoiseSteps(transition, noise, observation, variance, used, first @ first.T, stays)
    return steps, rng.standard_normal((count, p))


def assert_close(found, wanted, tolerance=1e-10):
    np.testing.assert_allclose(found, wanted, rtol=0.0, atol=tolerance * float(np.max(np.abs(wanted))))


@pytest.mark.parametrize("traced", [False, True])
@pytest.mark.parametrize("sizes", [(1, 1, 3), (2, 16, 61), (4, 3, 40), (9, 11, 30)])
def test_the_filter_is_dense_least_squares_on_all_readings(sizes, traced):
    """Rows, weights `V⁻¹Φ`, and states by the readings up to each, against the covariance written out."""
    steps, columns = random_system(*sizes)
    seen = steps.used & (np.arange(sizes[2]) != sizes[2] // 2)
    known = np.flatnonzero(seen)
    wanted = np.zeros(columns.shape)
    wanted[known] = np.linalg.solve(dense_of(steps._replace(used=seen)), columns[known])
    rows = np.asarray(whiten(*jax.tree.map(jnp.asarray, (steps, columns))) if traced else whiten(steps, columns))
    assert_close(rows.T @ rows, columns.T @ wanted)
    assert not rows[~seen].any()
    if traced:
        return
    assert_close(weights(steps, columns), wanted)
    states, per_std = by_reading(steps, columns)
    last = known[-1]
    smoothed = columns[last] - steps.reading_variance[last] * wanted[last]
    assert_close(steps.observation[last] @ states[last], smoothed)
    assert_close((per_std > 0.0).astype(float), seen.astype(float))


def moved(steps: NoiseSteps, columns: np.ndarray, size) -> tuple[NoiseSteps, jax.Array]:
    """A system along one direction, in everything that can be differentiated."""
    rng = np.random.default_rng(5)
    count, n = steps.observation.shape
    alive = np.where(steps.stays, 0.0, 1.0)[:, None, None]
    root = rng.standard_normal((count, n, n))
    first = rng.standard_normal((n, n))
    at = NoiseSteps(
        steps.transition + size * alive * rng.standard_normal((count, n, n)),
        steps.covariance + size * alive * (root @ root.swapaxes(1, 2)),
        steps.observation + size * np.sign(steps.reading_variance)[:, None] * rng.standard_normal((count, n)),
        steps.reading_variance * (1.0 + size * rng.uniform(size=count)),
        jnp.asarray(steps.used),
        steps.initial + size * (first @ first.T),
        steps.stays,
    )
    return at, columns + size * rng.standard_normal(columns.shape)


@pytest.mark.long
def test_forward_and_reverse_mode_and_second_derivatives_are_differences():
    steps, columns = random_system(3, 4, 37)
    weights = np.random.default_rng(3).standard_normal((4, 4))

    def along(size):
        return jnp.sum(weights * gram(*moved(steps, columns, size)))

    value = jax.jit(along)
    step = 2e-4
    points = {k: float(value(k * step)) for k in (-2, -1, 0, 1, 2)}
    slope = (8.0 * (points[1] - points[-1]) - (points[2] - points[-2])) / (12.0 * step)
    curvature = (16.0 * (points[1] + points[-1]) - points[2] - points[-2] - 30.0 * points[0]) / (12.0 * step**2)
    scale = sum(abs(of) for of in points.values())
    for mode in (jax.jacfwd, jax.grad):
        assert jax.jit(mode(along))(0.0) == pytest.approx(slope, rel=1e-7, abs=1e-9 * scale)
    for outer in (jax.jacfwd, jax.grad):
        for inner in (jax.jacfwd, jax.grad):
            assert jax.jit(outer(inner(along)))(0.0) == pytest.approx(curvature, rel=1e-5, abs=1e-6 * scale)
