"""What is left after calibration: the residual map and its named statistics.

    s(T, ω)² = ψ(T, ω)ᵀ C ψ(T, ω)

for the scale factor (dimensionless) and, without ω, for the bias (rad/s). With a model discrepancy `γ` (prior Γ) of
functions χ that the calibration does not carry, the error at a point is `ψᵀ(β − β̂) + χᵀγ`; since the estimation
error is uncorrelated with every function of the data, its variance is `ψᵀC_ββψ + 2ψᵀC_βγχ + χᵀΓχ`.
"""

from typing import Literal

import equinox as eqx
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from gradcal_jax.errormodel import GyroModel
from gradcal_jax.information.posterior import Posterior

Quantity = Literal["bias", "scale_factor"]
Statistic = Literal["mean of max", "max", "mean", "rms"]
STATISTICS: tuple[Statistic, ...] = ("mean of max", "max", "mean", "rms")


def contrasts(
    model: GyroModel, quantity: Quantity, temperature: Float[Array, " g"], rate: Float[Array, " g"]
) -> tuple[Float[Array, "g p"], Float[Array, " g"]]:
    """Rows `c` with `cᵀβ` the map's error at each point, and the variance there that no plan can touch, `χᵀ(Γ)χ`.

    The second is the discrepancy's prior variance; `c` has entries for it, whose own variance is not to be counted
    twice.
    Errors: `ValueError` when the model does not estimate the quantity.
    """
    of = model.bias if quantity == "bias" else model.scale
    if of is None:
        raise ValueError(f"the model holds the {quantity.replace('_', ' ')} known, so it leaves no residual to report")
    columns = model.columns
    where = columns.bias if quantity == "bias" else columns.scale
    beyond = columns.bias_discrepancy if quantity == "bias" else columns.scale_discrepancy
    outside = of.discrepancy_values(temperature, rate)
    rows = jnp.zeros((temperature.shape[0], columns.count)).at[:, where].set(of.values(temperature, rate))
    return rows.at[:, beyond].set(outside), jnp.square(of.discrepancy_std) * jnp.sum(outside**2, axis=1)


_contrasts = eqx.filter_jit(contrasts)


def residual(
    known: Posterior, model: GyroModel, quantity: Quantity, temperature: np.ndarray, rate: np.ndarray
) -> np.ndarray:
    """Standard deviation of the calibrated map's error on a grid: `(n_T,), (n_ω,) -> (n_T, n_ω)`.

    °C and rad/s in; dimensionless (scale factor) or rad/s (bias, whose one rate is ignored) out. `inf` where the plan
    cannot tell. Errors: `ValueError` for a map that the model does not have.
    """
    grid_t, grid_w = np.meshgrid(temperature, rate, indexing="ij")
    rows, beyond = _contrasts(model, quantity, jnp.asarray(grid_t.ravel()), jnp.asarray(grid_w.ravel()))
    c = np.asarray(rows)
    deviation = known.deviations(c)
    where = model.columns.bias_discrepancy if quantity == "bias" else model.columns.scale_discrepancy
    if where.stop > where.start:
        alone = np.zeros_like(c)
        alone[:, where] = c[:, where]
        deviation = np.sqrt(deviation**2 - known.deviations(alone) ** 2 + np.asarray(beyond))
    return deviation.reshape(grid_t.shape)


def statistic(name: Statistic, values: np.ndarray) -> float:
    """A named statistic of a residual map `(n_T, n_ω)`.

    "mean of max": mean over rate of the maximum over temperature (the paper's figure); the others are of all points.
    """
    if name == "mean of max":
        return float(np.mean(np.max(values, axis=0)))
    if name == "max":
        return float(np.max(values))
    if name == "mean":
        return float(np.mean(values))
    if name == "rms":
        return float(np.sqrt(np.mean(values**2)))
    raise ValueError(f"unknown statistic {name!r}; known: {', '.join(STATISTICS)}")
