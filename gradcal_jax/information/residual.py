"""The residual after calibration: errors on a grid, linear in the parameters, and named statistics of them.

    s(T, ω)² = ψ(T, ω)ᵀ C ψ(T, ω)

for the scale factor (dimensionless) and, without ω, for the bias (rad/s). With a model discrepancy `γ` (prior Γ) of
functions χ that the calibration does not carry, the error at a point is `ψᵀ(β − β̂) + χᵀγ`; since the estimation
error is uncorrelated with every function of the data, its variance is `ψᵀC_ββψ + 2ψᵀC_βγχ + χᵀΓχ`.
"""

from typing import Any, Literal, NamedTuple

import numpy as np
from jaxtyping import Float, Inexact, Int

from gradcal_jax.arrays import AnyArray, fixed, namespace
from gradcal_jax.information.posterior import Posterior
from gradcal_jax.model import Channel, ImuModel

Statistic = Literal["mean of max", "max", "mean", "rms"]
STATISTICS: tuple[Statistic, ...] = ("mean of max", "max", "mean", "rms")
EXACT = np.asarray(np.inf)
"""Value of `sharpness` for which a smooth statistic equals the statistic."""
# Imaginary step of a derivative, which is exact to rounding.
_STEP = 1e-30


class GridElement(NamedTuple):
    """Errors of the `g` points of a grid as linear functions `rows` of the parameters `where`; of several states `s` of
    the service the worst counts at every point. `alone`: the discrepancy's part of them, which the calibration does not
    carry, and `beyond` its prior variance there, which takes the place of its part of `cᵀCc`."""

    label: str
    where: Int[np.ndarray, " k"]
    rows: Float[np.ndarray, "s g k"]
    alone: Float[np.ndarray, "g k"]
    beyond: Float[np.ndarray, " g"]

    def variance(self, root: Float[AnyArray, "p r"]) -> Float[AnyArray, " g"]:
        """The variance on the points, by a root of the covariance of all parameters."""
        own, xp = root[self.where], namespace(root)
        left = xp.max(xp.sum((self.rows @ own) ** 2, axis=-1), axis=0) + self.beyond
        return left - xp.sum((self.alone @ own) ** 2, axis=1) if np.any(self.alone) else left

    def deviations(self, known: Posterior) -> Float[np.ndarray, " g"]:
        """Standard deviation on the points after a calibration; `inf` where it is unobservable."""
        deviations = np.sqrt(self.variance(known.spread))
        if known.hidden.shape[1]:
            own = Posterior(known.spread[self.where], known.hidden[self.where])
            unseen = np.isinf([own.deviations(rows) for rows in self.rows])
            deviations = np.where(np.any(unseen, axis=0), np.inf, deviations)
        return deviations

    def part(self, covariance: Float[np.ndarray, "p p"], root: Float[np.ndarray, "p r"]) -> Float[np.ndarray, " g"]:
        """What a part of the covariance adds to the variance, in the states that are the worst ones by `root`."""
        worst = np.argmax(np.sum((self.rows @ root[self.where]) ** 2, axis=-1), axis=0)
        rows, part = self.rows[worst, np.arange(len(worst))], covariance[np.ix_(self.where, self.where)]
        return np.sum((rows @ part) * rows, axis=1) - np.sum((self.alone @ part) * self.alone, axis=1)


def grid_element(
    model: ImuModel, label: str, rows: Float[np.ndarray, "g p"], states: Float[np.ndarray, "s 1 p"] | None = None
) -> GridElement:
    """An element from functions of all parameters; `states`: what each state of the service adds to them."""
    seen = np.any(rows, axis=0) if states is None else np.any(rows, axis=0) | np.any(states, axis=(0, 1))
    where = np.flatnonzero(seen)
    own, stds = rows[:, where], model.discrepancy_stds[where]
    every = own[None] if states is None else own + states[:, :, where]
    return GridElement(label, where, every, own * (stds > 0.0), own**2 @ stds**2)


def map_rows(
    model: ImuModel,
    channel: Channel,
    name: str,
    temperature: Float[np.ndarray, " g"],
    rate: Float[np.ndarray, " g"] | None = None,
) -> Float[np.ndarray, "g p"]:
    """The error of a channel's map at points (°C, rad/s; without rates at rest), with its discrepancy, as a function of
    all parameters; zero for a term that the channel does not have."""
    rows, of = np.zeros((len(temperature), model.size)), channel.map(name)
    if of is None:
        return rows
    at = temperature, np.zeros(len(temperature)) if rate is None else rate
    rows[:, model.where(channel.kind, channel.axis, name)] = of.values(*at)
    if of.beyond is not None:
        rows[:, model.where(channel.kind, channel.axis, of.beyond.name)] = of.beyond.values(*at)
    return rows


class Residual(NamedTuple):
    """A requirement's statistic as a function of a root of the covariance of all parameters, in SI: of its elements on
    a grid of `shape`, with the variance `added` to each. `unseen` `(p, k)`: further columns of the root.
    `together`: of the elements the root mean square counts, not the worst."""

    elements: tuple[GridElement, ...]
    added: float
    shape: tuple[int, int]
    kind: Statistic
    together: bool
    unseen: tuple[Float[AnyArray, "p k"], ...]

    def __call__(
        self, root: Float[AnyArray, "p r"], sharpness: Float[AnyArray, ""] | float = EXACT
    ) -> Float[AnyArray, ""] | float:
        """The statistic: exact for an infinite sharpness, from above otherwise."""
        root = namespace(root, self.unseen).concatenate([root, *self.unseen], axis=1)
        return self.of([element.variance(root) + self.added for element in self.elements], sharpness)

    def of(self, variances: list[AnyArray], sharpness: Float[AnyArray, ""] | float = EXACT) -> Any:
        """The statistic by the variances on each element's points."""
        xp = namespace(*variances)
        each = [statistic(self.kind, xp.reshape(xp.sqrt(of), self.shape), sharpness) for of in variances]
        every = xp.stack(each)
        return xp.sqrt(xp.mean(every**2)) if self.together else largest(every[:, None], sharpness)[0]

    def slope(self, variances: list[np.ndarray], changes: list[np.ndarray]) -> float:
        """The derivative of the statistic's logarithm along changes of the variances (Squire and Trapp, 1998)."""
        moved = [of + 1j * _STEP * by for of, by in zip(variances, changes, strict=True)]
        value = self.of(moved)
        return float(value.imag / value.real) / _STEP


def statistic(
    name: Statistic, values: Inexact[AnyArray, "n_T n_w"], sharpness: Float[AnyArray, ""] | float = EXACT
) -> Inexact[AnyArray, ""] | float | complex:
    """A named statistic of a residual map: exact for an infinite sharpness, from above otherwise.

    "mean of max": mean over rate of the maximum over temperature (the paper's figure); the others are of all points.
    """
    xp = namespace(values)
    if name == "mean of max":
        return xp.mean(largest(values, sharpness))
    if name == "max":
        return largest(xp.reshape(values, (-1, 1)), sharpness)[0]
    if name == "mean":
        return xp.mean(values)
    return xp.sqrt(xp.mean(values**2))


def largest(values: Inexact[AnyArray, "n m"], sharpness: Float[AnyArray, ""] | float) -> Inexact[AnyArray, " m"]:
    """Maximum along the first axis, exact for an infinite sharpness k, otherwise `(Σ values^k)^(1/k)`, from above."""
    xp = namespace(values, sharpness)
    peak = xp.max(values, axis=0)
    if isinstance(sharpness, float | np.ndarray) and np.isinf(sharpness):
        return peak
    soft = xp.isfinite(sharpness)
    k = xp.where(soft, sharpness, 1.0)
    scale = fixed(peak)
    norm = scale * xp.sum((values / scale[None]) ** k, axis=0) ** (1.0 / k)
    return xp.where(soft, norm, peak)
