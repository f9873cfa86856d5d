"""The information of a plan as a Gram matrix, for searches."""

import numpy as np

from gradcal_jax.api.imu_build import BuiltImu
from gradcal_jax.information import Posterior, imu_system, whiten
from gradcal_jax.model import ImuModel


def prior_gram(model: ImuModel) -> np.ndarray:
    """The information (Gram matrix) of the priors."""
    prior = model.prior_rows()
    return prior.T @ prior


def gram_of(built: BuiltImu) -> np.ndarray:
    """The information (Gram matrix) of the whitened rows of a plan."""
    rows = whiten(*imu_system(built.motion, built.model, built.body_nodes()))
    return rows.T @ rows


def posterior_of_plan(built: BuiltImu) -> Posterior:
    """The posterior of a plan from its Gram matrix, whose scaled columns are far from parallel where everything is
    observable."""
    gram = prior_gram(built.model) + gram_of(built)
    scale = np.sqrt(np.maximum(np.diag(gram), np.finfo(float).tiny))
    values, vectors = np.linalg.eigh(gram / (scale[:, None] * scale[None, :]))
    seen = values > 1e-13 * values[-1]
    return Posterior(vectors[:, seen] / np.sqrt(values[seen]) / scale[:, None], vectors[:, ~seen] / scale[:, None])
