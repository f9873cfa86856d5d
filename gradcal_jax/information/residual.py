"""The residual after calibration: its map and named statistics.

    s(T, ω)² = ψ(T, ω)ᵀ C ψ(T, ω)

for the scale factor (dimensionless) and, without ω, for the bias (rad/s). With a model discrepancy `γ` (prior Γ) of
functions χ that the calibration does not carry, the error at a point is `ψᵀ(β − β̂) + χᵀγ`; since the estimation
error is uncorrelated with every function of the data, its variance is `ψᵀC_ββψ + 2ψᵀC_βγχ + χᵀΓχ`.
"""

from typing import Literal, NamedTuple

import numpy as np
from jaxtyping import Float

from gradcal_jax.arrays import AnyArray, namespace, put
from gradcal_jax.information.posterior import Posterior
from gradcal_jax.model import Map, SensorModel

Quantity = Literal["bias", "scale_factor"]
Statistic = Literal["mean of max", "max", "mean", "rms"]
STATISTICS: tuple[Statistic, ...] = ("mean of max", "max", "mean", "rms")


def map_of(model: SensorModel, quantity: Quantity) -> Map:
    """The map of a quantity. Errors: `ValueError` when the model does not estimate it."""
    of = model.map(quantity)
    if of is None:
        raise ValueError(
            f"in this model, the {quantity.replace('_', ' ')} is known and not estimated, so there is no residual "
            "to report"
        )
    return of


class Contrasts(NamedTuple):
    """`rows` c with `cᵀβ` an error; `alone`: the discrepancy's part of them; `beyond`: its prior variance there."""

    rows: Float[AnyArray, "g p"]
    alone: Float[AnyArray, "g p"]
    beyond: Float[AnyArray, " g"]

    def times(self, factor: Float[AnyArray, " g"] | float) -> "Contrasts":
        """Contrasts of errors multiplied by a factor."""
        by = np.broadcast_to(factor, self.beyond.shape)
        return Contrasts(self.rows * by[:, None], self.alone * by[:, None], self.beyond * by**2)

    def left(self, known: Posterior) -> Float[np.ndarray, " g"]:
        """Standard deviation of each error after a calibration; `inf` where it is unobservable."""
        deviation = known.deviations(np.asarray(self.rows))
        if not np.any(self.alone):
            return deviation
        return np.sqrt(deviation**2 - known.deviations(np.asarray(self.alone)) ** 2 + self.beyond)


def contrasts(
    model: SensorModel, quantity: Quantity, temperature: Float[AnyArray, " g"], rate: Float[AnyArray, " g"]
) -> Contrasts:
    """Contrasts of the map's error at each point.

    The discrepancy is estimated with the other parameters, but a calibration does not carry it: its part of `cᵀCc` is
    replaced by `χᵀΓχ`, which no plan changes. Errors: `ValueError` when the model does not estimate
    the quantity.
    """
    of = map_of(model, quantity)
    xp = namespace(of, temperature, rate)
    rows = put(
        xp.zeros((len(temperature), model.size)), (slice(None), model.where(of.name)), of.values(temperature, rate)
    )
    alone = xp.zeros((len(temperature), model.size))
    if of.beyond is None:
        return Contrasts(rows, alone, xp.zeros(len(temperature)))
    outside = of.beyond.values(temperature, rate)
    alone = put(alone, (slice(None), model.where(of.beyond.name)), outside)
    return Contrasts(rows + alone, alone, of.beyond.std**2 * xp.sum(outside**2, axis=1))


def residual(
    known: Posterior, model: SensorModel, quantity: Quantity, temperature: np.ndarray, rate: np.ndarray
) -> np.ndarray:
    """Standard deviation of the calibrated map's error on a grid: `(n_T,), (n_ω,) -> (n_T, n_ω)`.

    °C and rad/s in; dimensionless (scale factor) or rad/s (bias, for which the rate is ignored) out. `inf` where it is
    unobservable. Errors: `ValueError` for a map that the model does not have.
    """
    of = map_of(model, quantity)
    if of.beyond is None and not known.hidden.shape[1]:
        return _by_factors(known.spread[model.where(of.name)], of, temperature, rate)
    grid_t, grid_w = np.meshgrid(temperature, rate, indexing="ij")
    return contrasts(model, quantity, grid_t.ravel(), grid_w.ravel()).left(known).reshape(grid_t.shape)


def _by_factors(spread: np.ndarray, of: Map, temperatures: np.ndarray, rates: np.ndarray) -> np.ndarray:
    """The residual by products of small tables: a map is a tensor product ψ(T)⊗χ(ω), so for each temperature
    `s²(ω) = χᵀ(A Aᵀ)χ` with A = ψ(T)·spread, twenty times fewer operations than the square of every row."""
    by_t = of.temperature(temperatures)
    if of.rate is None:
        return np.broadcast_to(np.linalg.norm(by_t @ spread, axis=1)[:, None], (len(by_t), len(rates))).copy()
    by_w = of.rate(rates)
    half = np.tensordot(by_t, spread.reshape(by_t.shape[1], by_w.shape[1], -1), axes=1)
    square = half @ np.swapaxes(half, 1, 2)
    pairs = (by_w[:, :, None] * by_w[:, None, :]).reshape(len(rates), -1)
    return np.sqrt(np.maximum(square.reshape(len(temperatures), -1) @ pairs.T, 0.0))


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
