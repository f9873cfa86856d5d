"""Information of long logs and of plans with many readings by tiles, with the memory of one tile instead of all of Φ.

`whiten_from` carries the noise's state from one tile to the next, so the result is that of the whole, to rounding.
"""

from collections.abc import Callable
from typing import Literal

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float, Int

from gradcal_jax.information.noise_steps import NoiseSteps
from gradcal_jax.information.whitening import FilterState, whiten_from
from gradcal_jax.linalg import triangular_factor

Tile = Callable[[Int[Array, ""]], tuple[NoiseSteps, Float[Array, "N p"]]]


def information_in_tiles(
    tile: Tile,
    count: int,
    parameters: int,
    initial: Float[Array, "n n"],
    *,
    keep: Literal["product", "triangle"] = "product",
) -> tuple[Float[Array, "p p"], FilterState]:
    """`Φᵀ V⁻¹ Φ` ("product") or the upper triangular R with `RᵀR` equal to it ("triangle") over `count` tiles.

    `tile(i)` makes the steps and the regressors of tile i, of one size: pad the last with steps that are not `used`.
    `initial`: covariance of the noise before the first step. The product is faster and squares the condition number;
    the triangle, one QR update for each tile, does not. Also returns the state after the last reading. Errors:
    `ValueError` for fewer than one tile.
    """
    if count < 1:
        raise ValueError(f"{count} tiles hold no readings: give at least one")
    dtype = initial.dtype
    start = FilterState(jnp.zeros((initial.shape[0], parameters), dtype), initial)

    def one(carry, index):
        state, total = carry
        rows, state = whiten_from(state, *tile(index))
        total = total + rows.T @ rows if keep == "product" else triangular_factor(jnp.concatenate([total, rows]))
        return (state, total), None

    (state, total), _ = jax.lax.scan(one, (start, jnp.zeros((parameters, parameters), dtype)), jnp.arange(count))
    return total, state
