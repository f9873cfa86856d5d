"""The residual after calibration: its map and named statistics.

    s(T, ω)² = ψ(T, ω)ᵀ C ψ(T, ω)

for the scale factor (dimensionless) and, without ω, for the bias (rad/s). With a model discrepancy `γ` (prior Γ) of
functions χ that the calibration does not carry, the error at a point is `ψᵀ(β − β̂) + χᵀγ`; since the estimation
error is uncorrelated with every function of the data, its variance is `ψᵀC_ββψ + 2ψᵀC_βγχ + χᵀΓχ`.
"""

from typing import Literal, NamedTuple

import numpy as np
from jaxtyping import Float

from gradcal_jax.arrays import AnyArray, fixed, namespace
from gradcal_jax.information.posterior import Posterior
from gradcal_jax.model import Channel

Statistic = Literal["mean of max", "max", "mean", "rms"]
STATISTICS: tuple[Statistic, ...] = ("mean of max", "max", "mean", "rms")
EXACT = np.asarray(np.inf)
"""Value of `sharpness` for which a smooth statistic equals the statistic."""


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
    channel: Channel, name: str, temperature: Float[np.ndarray, " g"], rate: Float[np.ndarray, " g"]
) -> Contrasts:
    """Contrasts of the error of a channel's map at each point (°C, rad/s), of a term that it does not have zero.

    The discrepancy is estimated with the other parameters, but a calibration does not carry it: its part of `cᵀCc` is
    replaced by `χᵀΓχ`, which no plan changes.
    """
    of, shape = channel.map(name), (len(temperature), channel.size)
    rows, alone, beyond = np.zeros(shape), np.zeros(shape), np.zeros(len(temperature))
    if of is not None:
        rows[:, channel.where(name)] = of.values(temperature, rate)
    if of is not None and of.beyond is not None:
        outside = of.beyond.values(temperature, rate)
        alone[:, channel.where(of.beyond.name)] = outside
        beyond = of.beyond.std**2 * np.sum(outside**2, axis=1)
    return Contrasts(rows + alone, alone, beyond)


class GridElement(NamedTuple):
    """Errors of the points of a grid as linear functions `of` the parameters `where`. `path` `(s, g, k)`: what is added
    to the rows in each state of the service, of which the worst counts at every point."""

    label: str
    where: slice
    of: Contrasts
    path: Float[np.ndarray, "s g k"] | None = None

    def states(self) -> list[Contrasts]:
        """The errors in each state of the service."""
        if self.path is None:
            return [self.of]
        return [self.of._replace(rows=np.asarray(self.of.rows) + state) for state in self.path]

    def deviations(self, known: Posterior, *, whole: bool = False) -> Float[np.ndarray, " g"]:
        """Standard deviation on the points. `whole`: of errors that include what a calibration does not carry."""
        part = Posterior(known.spread[self.where], known.hidden[self.where])
        if whole:
            return np.max([part.deviations(np.asarray(state.rows)) for state in self.states()], axis=0)
        return np.max([state.left(part) for state in self.states()], axis=0)

    def variance(self, root: Float[AnyArray, "p r"]) -> Float[AnyArray, " g"]:
        """The variance on the points, by a root of the covariance of all parameters."""
        own, xp, alone = root[self.where], namespace(root), self.of.alone
        left = [xp.sum((state.rows @ own) ** 2, axis=1) for state in self.states()]
        whole = (left[0] if len(left) == 1 else xp.max(xp.stack(left), axis=0)) + self.of.beyond
        return whole - xp.sum((alone @ own) ** 2, axis=1) if np.any(alone) else whole

    def slope(self, root: Float[np.ndarray, "p r"], of_variance: Float[np.ndarray, " g"]) -> Float[np.ndarray, "p p"]:
        """Derivative in the covariance, by that in the variance on the points."""
        own, states = root[self.where], np.stack([state.rows for state in self.states()])
        worst = np.argmax([np.sum((rows @ own) ** 2, axis=1) for rows in states], axis=0)
        rows, alone, slope = states[worst, np.arange(len(worst))], self.of.alone, np.zeros((len(root), len(root)))
        slope[self.where, self.where] = (rows.T * of_variance) @ rows - (alone.T * of_variance) @ alone
        return slope


class Residual(NamedTuple):
    """A requirement's statistic as a function of a root of the covariance of all parameters, in SI: of its elements on
    a grid of `shape`, with the variances `added` to each. `together`: of the elements the root
    mean square counts, not the worst."""

    elements: tuple[GridElement, ...]
    added: tuple[Float[np.ndarray, " g"], ...]
    shape: tuple[int, int]
    kind: Statistic
    together: bool

    def __call__(
        self, root: Float[AnyArray, "p r"], sharpness: Float[AnyArray, ""] | float = EXACT
    ) -> Float[AnyArray, ""] | float:
        """The statistic: exact for an infinite sharpness, from above otherwise."""
        xp, each = namespace(root), []
        for element, added in zip(self.elements, self.added, strict=True):
            values = xp.reshape(xp.sqrt(element.variance(root) + added), self.shape)
            each.append(statistic(self.kind, values, sharpness))
        every = xp.stack(each)
        return xp.sqrt(xp.mean(every**2)) if self.together else largest(every[:, None], sharpness)[0]

    def slope(
        self, root: Float[np.ndarray, "p r"]
    ) -> tuple[float, Float[np.ndarray, "p p"], list[Float[np.ndarray, " g"]]]:
        """The statistic, and its derivatives in the covariance and in the variance that is added to each element."""
        values = [
            np.sqrt(element.variance(root) + added).reshape(self.shape)
            for element, added in zip(self.elements, self.added, strict=True)
        ]
        each = np.array([statistic(self.kind, of) for of in values])
        total = float(np.sqrt(np.mean(each**2)) if self.together else np.max(each))
        outer = each / (total * len(each)) if self.together else np.arange(len(each)) == np.argmax(each)
        of_covariance, of_added = np.zeros((len(root), len(root))), list[np.ndarray]()
        for element, own, of in zip(self.elements, outer, values, strict=True):
            # d value = d variance / (2 value)
            of_value = own * _slope_of_statistic(self.kind, of)
            safe = np.where(of_value > 0.0, of, 1.0)
            of_added.append((0.5 * of_value / safe).ravel())
            of_covariance = of_covariance + element.slope(root, of_added[-1])
        return total, of_covariance, of_added


def _slope_of_statistic(name: Statistic, values: Float[np.ndarray, "n_T n_w"]) -> Float[np.ndarray, "n_T n_w"]:
    """Derivative of a statistic with respect to each of its values."""
    slopes = np.zeros_like(values)
    if name == "mean of max":
        slopes[np.argmax(values, axis=0), np.arange(values.shape[1])] = 1.0 / values.shape[1]
    elif name == "max":
        slopes.flat[np.argmax(values)] = 1.0
    elif name == "mean":
        slopes += 1.0 / values.size
    else:
        slopes += values / (values.size * np.sqrt(np.mean(values**2)))
    return slopes


def statistic(
    name: Statistic, values: Float[AnyArray, "n_T n_w"], sharpness: Float[AnyArray, ""] | float = EXACT
) -> Float[AnyArray, ""] | float:
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
    if name == "rms":
        return xp.sqrt(xp.mean(values**2))
    raise ValueError(f"unknown statistic {name!r}; known: {', '.join(STATISTICS)}")


def largest(values: Float[AnyArray, "n m"], sharpness: Float[AnyArray, ""] | float) -> Float[AnyArray, " m"]:
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
