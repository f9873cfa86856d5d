"""The filter in blocks is the filter reading by reading, and its derivatives are differences."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from gradcal_jax.information import NoiseSteps, gram, whiten
from gradcal_jax.information.by_reading import adjoint_parts, filter_readings


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


def quick(steps: NoiseSteps, columns: np.ndarray, *, traced: bool) -> np.ndarray:
    """Whitened rows in blocks, by NumPy or JAX."""
    if traced:
        steps, columns = jax.tree.map(jnp.asarray, (steps, columns))
    return np.asarray(whiten(steps, columns))


@pytest.mark.parametrize("traced", [False, True])
@pytest.mark.parametrize("sizes", [(1, 1, 3), (2, 16, 61), (4, 3, 40), (9, 11, 30)])
def test_rows_in_blocks_have_the_product_of_rows_by_reading(sizes, traced):
    n, p, count = sizes
    steps, columns = random_system(*sizes)
    expected = filter_readings(np.zeros((n, p)), steps.initial, steps, columns).rows
    rows = quick(steps, columns, traced=traced)
    assert_close(rows.T @ rows, expected.T @ expected)
    assert not rows[~steps.used].any()
    assert not rows[count // 2].any()


@pytest.mark.parametrize("sizes", [(1, 1, 3), (2, 16, 61), (4, 3, 40)])
def test_adjoint_states_give_the_derivative_of_the_product(sizes):
    n, p, _ = sizes
    steps, columns = random_system(*sizes)
    weights = np.random.default_rng(2).standard_normal((p, p))
    known = jax.tree.map(jnp.asarray, steps)

    def weighed(covariance, variance, initial):
        now = known._replace(covariance=covariance, reading_variance=variance, initial=initial)
        return jnp.sum(weights * gram(now, jnp.asarray(columns)))

    wanted = jax.jit(jax.grad(weighed, (0, 1, 2)))(known.covariance, known.reading_variance, known.initial)
    # ∂(weights · rowsᵀrows) by the adjoint states: −ρ W ρᵀ, −uᵀ W u. No step precedes a reading that stays.
    inner = (weights + weights.T) / 2
    found = filter_readings(np.zeros((n, p)), steps.initial, steps, columns)
    parts = sorted(adjoint_parts(steps, found), key=lambda part: part[0].start)
    us, rhos = (np.concatenate([part[k] for part in parts]) for k in (1, 2))
    first = steps.transition[0].T @ rhos[0]
    of_covariance = -rhos @ inner @ rhos.swapaxes(1, 2)
    of_covariance[steps.stays] = 0.0
    # Only the symmetric part of a covariance's derivative has a meaning.
    assert_close(of_covariance, (wanted[0] + wanted[0].swapaxes(1, 2)) / 2)
    assert_close(-np.sum((us @ inner) * us, axis=1), wanted[1])
    assert_close(-first @ inner @ first.T, wanted[2])


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
