"""Tiles against the whole, and against what a dense covariance says."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from gradcal_jax.information import NoiseSteps, whiten
from gradcal_jax.information.tiles import information_in_tiles

COUNT, ROWS, PARAMETERS = 190, 24, 5


def steps(count: int) -> NoiseSteps:
    """An angle driven by a slow and a quick process, irregular in everything, some readings unused."""
    rng = np.random.default_rng(3)
    spacing = rng.uniform(0.2, 3.0, count)
    kept = np.exp(-spacing[:, None] / np.array([4.0, 60.0]))
    transition = np.zeros((count, 3, 3))
    transition[:, 0, 0] = 1.0
    transition[:, 0, 1:] = (1.0 - kept) * np.array([4.0, 60.0])
    transition[:, [1, 2], [1, 2]] = kept
    covariance = np.zeros((count, 3, 3))
    covariance[:, [0, 1, 2], [0, 1, 2]] = np.stack([1e-3 * spacing, *(1e-4 * (1.0 - kept**2)).T], axis=1)
    observation = np.tile([1.0, 0.0, 0.0], (count, 1))
    initial = np.diag([1e-2, 1e-4, 1e-4])
    used = np.arange(count) % 7 != 3
    return NoiseSteps(
        *(jnp.asarray(x) for x in (transition, covariance, observation, np.full(count, 1e-2), used, initial))
    )


def padded(everything: NoiseSteps, columns: jax.Array, rows: int):
    """A tile maker over given arrays, the last tile filled up with steps that are not used."""
    count, tiles = columns.shape[0], -(-columns.shape[0] // rows)

    def tile(index):
        at = index * rows + jnp.arange(rows)
        inside = at < count
        at = jnp.minimum(at, count - 1)
        cut = NoiseSteps(*(x[at] for x in everything[:5]), everything.initial)
        return cut._replace(used=cut.used & inside), columns[at]

    return tile, tiles


@pytest.mark.parametrize("rows", [1, ROWS, COUNT, 500])
@pytest.mark.parametrize("keep", ["product", "triangle"])
def test_tiles_equal_the_whole(rows, keep):
    everything = steps(COUNT)
    columns = jnp.asarray(np.random.default_rng(4).standard_normal((COUNT, PARAMETERS)).cumsum(axis=0))
    whole = whiten(everything, columns)
    expected = np.asarray(whole.T @ whole)
    tile, tiles = padded(everything, columns, rows)
    result, _ = jax.jit(lambda: information_in_tiles(tile, tiles, PARAMETERS, everything.initial, keep=keep))()
    if keep == "triangle":
        assert np.allclose(result, np.triu(result))
        result = result.T @ result
    size = np.sqrt(np.diagonal(expected))
    assert np.max(np.abs((np.asarray(result) - expected) / np.outer(size, size))) < 1e-12


def test_the_state_carries_on():
    everything = steps(COUNT)
    columns = jnp.asarray(np.random.default_rng(5).standard_normal((COUNT, PARAMETERS)))
    tile, tiles = padded(everything, columns, 19)
    assert 19 * tiles == COUNT
    _, one = information_in_tiles(tile, tiles, PARAMETERS, everything.initial)
    _, other = information_in_tiles(lambda _: (everything, columns), 1, PARAMETERS, everything.initial)
    assert np.allclose(one.mean, other.mean, rtol=1e-11, atol=1e-13)
    assert np.allclose(one.covariance, other.covariance, rtol=1e-11, atol=1e-16)


def test_no_tiles_are_refused():
    with pytest.raises(ValueError, match="at least one"):
        information_in_tiles(lambda i: (steps(3), jnp.zeros((3, 2))), 0, 2, jnp.eye(3))
