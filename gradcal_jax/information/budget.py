"""The error budget: the share of each source of error in a residual.

A statistic r of the residual depends on the noise through `G = ΦᵀV⁻¹Φ` alone, and V is a sum over sources, each
proportional to its variance σ². With `Ḡ = ∂r/∂G` the filter's own derivative (`by_reading`) gives `∂r/∂V`, and so
`∂ln r/∂ln σ` of each source. With that of the priors these shares add up to one, since r is homogeneous in all standard
deviations together. No finite differences are used.
"""

from collections.abc import Mapping

import numpy as np
from jaxtyping import Float

from gradcal_jax.information.by_reading import Readings, noise_cotangents
from gradcal_jax.information.noise_steps import NoiseSteps
from gradcal_jax.information.posterior import LeastSquares, Posterior, noise_of_sums
from gradcal_jax.information.residual import Contrasts, Statistic


def weights_of(name: Statistic, values: Float[np.ndarray, "n_T n_w"]) -> Float[np.ndarray, "n_T n_w"]:
    """Derivative of a statistic of a residual map with respect to each of its values."""
    weights = np.zeros_like(values)
    if name == "mean of max":
        weights[np.argmax(values, axis=0), np.arange(values.shape[1])] = 1.0 / values.shape[1]
    elif name == "max":
        weights.flat[np.argmax(values)] = 1.0
    elif name == "mean":
        weights += 1.0 / values.size
    else:
        weights += values / (values.size * np.sqrt(np.mean(values**2)))
    return weights


class Sensitivity:
    """Derivative of one statistic of a residual map with respect to `G` and to the variance that no plan changes."""

    def __init__(
        self, known: Posterior, places: Contrasts, statistic: Statistic, values: Float[np.ndarray, "n_T n_w"]
    ) -> None:
        weights = weights_of(statistic, values).ravel()
        counts = weights > 0.0
        rows, alone, beyond = (of[counts] for of in places)
        half = 0.5 * weights[counts] / values.ravel()[counts]
        of_rows, of_alone = (c @ known.spread @ known.spread.T for c in (rows, alone))
        self.of_gram = -(of_rows.T * half) @ of_rows + (of_alone.T * half) @ of_alone
        self.of_covariance = (rows.T * half) @ rows - (alone.T * half) @ alone
        self.of_beyond = float(half @ beyond)


def noise_shares(
    steps: NoiseSteps, readings: Readings, of_gram: np.ndarray, sources: Mapping[str, NoiseSteps]
) -> dict[str, float]:
    """`∂r/∂ln σ` of each of `sources`, given by its part of the noise. `readings`: of all columns."""
    covariance, variance, initial = noise_cotangents(steps, readings, of_gram)

    def of(part: NoiseSteps) -> float:
        pairs = (covariance, part.covariance), (variance, part.reading_variance), (initial, part.initial)
        return 2.0 * float(sum(np.sum(a * b) for a, b in pairs))

    return {name: of(part) for name, part in sources.items()}


def unweighted_shares(
    estimator: LeastSquares, of_covariance: np.ndarray, sources: Mapping[str, NoiseSteps]
) -> dict[str, float]:
    """As `noise_shares`, for an estimator that does not depend on the noise."""
    inner = estimator.back.T @ of_covariance @ estimator.back
    return {name: 2.0 * float(np.sum(inner * noise_of_sums(part, estimator.weights))) for name, part in sources.items()}
