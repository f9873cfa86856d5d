"""For the error budget: the derivatives of a residual with respect to the size of each source of noise.

A statistic r of the residual depends on the noise through `G = ΦᵀV⁻¹Φ` alone, and V is a sum over sources, each
proportional to its variance σ². Since `∂G/∂ln σ = −2 ΦᵀV⁻¹V_σV⁻¹Φ`, one matrix for each source gives `∂ln r/∂ln σ` of
every residual, with `∂r/∂G` of that residual. With those of the priors these shares add up to one, since r is
homogeneous in all standard deviations together. No finite differences are used.
"""

from collections.abc import Mapping
from typing import NamedTuple

import numpy as np
from jaxtyping import Float

from gradcal_jax.information.by_reading import adjoint_parts, filter_readings
from gradcal_jax.information.noise_steps import NoiseSteps
from gradcal_jax.information.posterior import Posterior
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


class Sensitivity(NamedTuple):
    """Derivative of one statistic of residuals with respect to `G`, to the parameters' covariance, and to the variance
    that no plan changes."""

    of_gram: Float[np.ndarray, "p p"]
    of_covariance: Float[np.ndarray, "p p"]
    of_beyond: float

    def plus(self, other: "Sensitivity") -> "Sensitivity":
        """The derivative of a sum."""
        of_gram, of_covariance = self.of_gram + other.of_gram, self.of_covariance + other.of_covariance
        return Sensitivity(of_gram, of_covariance, self.of_beyond + other.of_beyond)


def sensitivity_of(known: Posterior, places: Contrasts, of_variance: Float[np.ndarray, " g"]) -> Sensitivity:
    """`of_variance`: derivative of the statistic with respect to the variance at each place."""
    rows, alone, beyond = places
    of_rows, of_alone = (c @ known.spread @ known.spread.T for c in (rows, alone))
    return Sensitivity(
        -(of_rows.T * of_variance) @ of_rows + (of_alone.T * of_variance) @ of_alone,
        (rows.T * of_variance) @ rows - (alone.T * of_variance) @ alone,
        float(of_variance @ beyond),
    )


def information_lost(
    steps: NoiseSteps, columns: Float[np.ndarray, "N p"], sources: Mapping[str, NoiseSteps]
) -> dict[str, Float[np.ndarray, "p p"]]:
    """`ΦᵀV⁻¹V_σV⁻¹Φ` of each of `sources`, given by its part of the noise."""
    start = np.zeros((steps.observation.shape[1], columns.shape[1]))
    readings = filter_readings(start, steps.initial, steps, columns)
    lost = {name: np.zeros((columns.shape[1],) * 2) for name in sources}
    for at, us, rhos in adjoint_parts(steps, readings):
        for name, part in sources.items():
            # A source acts on few of the states.
            driven = np.flatnonzero(np.any(part.covariance[at], axis=(0, 1)))
            if len(driven):
                own = np.ascontiguousarray(rhos[:, driven])
                flat, covariance = own.reshape(-1, own.shape[-1]), part.covariance[at][:, driven[:, None], driven]
                lost[name] += flat.T @ (covariance @ own).reshape(flat.shape)
            if np.any(variance := part.reading_variance[at]):
                lost[name] += (us.T * variance) @ us
            if at.start == 0:
                first = steps.transition[0].T @ rhos[0]
                lost[name] += first.T @ part.initial @ first
    return lost
