"""The Monte Carlo twin: simulate a plan's readings, estimate with the real estimator, compare with the prediction.

The noise is drawn step by step from the timeline's own linear system in NumPy; the estimator whitens the simulated
readings together with the regressors and solves the least squares, with the same code as for a real log.
"""

import numpy as np

from gradcal_jax.information.noise_steps import NoiseSteps
from gradcal_jax.information.posterior import LeastSquares
from gradcal_jax.information.whitening import whiten

# Runs that are simulated together.
_TILE = 256


def simulated_errors(
    steps: NoiseSteps,
    columns: np.ndarray,
    prior: np.ndarray,
    carried: np.ndarray,
    runs: int,
    seed: int = 0,
    plain: LeastSquares | None = None,
) -> np.ndarray:
    """Errors `(runs, p)` of simulated calibrations, estimate minus truth, in the engine's parameters, by a linear
    system with the rows `prior` `(m, p)` of its priors. Parameters with a prior are drawn from it; those without are
    zero, without loss of generality. All must be observable.

    `carried` `(p,)`: whether a calibration has a parameter. `plain`: an unweighted estimator, which leaves the last
    parameters, noise to it, at zero.
    """
    rng, p = np.random.default_rng(seed), columns.shape[1]
    drawn = np.linalg.pinv(prior) if len(prior) else np.zeros((p, 0))
    left: list[np.ndarray] = []
    for begin in range(0, runs, _TILE):
        size = min(_TILE, runs - begin)
        truth = drawn @ rng.standard_normal((len(prior), size))
        readings = simulate_noise(steps, size, rng) + columns @ truth
        if plain is not None:
            own = plain.back @ (plain.weights.T @ readings)
            estimate = np.concatenate([own, truth[len(own) :]])
        else:
            both = whiten(steps, np.concatenate([columns, readings], axis=1))
            design = np.concatenate([both[:, :p], prior])
            data = np.concatenate([both[:, p:], np.zeros((len(prior), size))])
            scale = np.linalg.norm(design, axis=0)
            estimate = np.linalg.lstsq(design / scale, data, rcond=None)[0] / scale[:, None]
        left.append((carried[:, None] * estimate - truth).T)
    return np.concatenate(left)


def simulate_noise(steps: NoiseSteps, runs: int, rng: np.random.Generator) -> np.ndarray:
    """Noise of the readings, `(N, runs)`, drawn from the linear system; rows of steps without a reading are unused."""
    transition, observation = np.asarray(steps.transition), np.asarray(steps.observation)
    noise_root = _roots(np.asarray(steps.covariance))
    reading_std = np.sqrt(np.asarray(steps.reading_variance))
    n = observation.shape[1]
    state = _roots(np.asarray(steps.initial)[None])[0] @ rng.standard_normal((n, runs))
    readings = np.empty((len(observation), runs))
    for k in range(len(observation)):
        state = transition[k] @ state + noise_root[k] @ rng.standard_normal((n, runs))
        readings[k] = observation[k] @ state + reading_std[k] * rng.standard_normal(runs)
    return readings


def _roots(covariances: np.ndarray) -> np.ndarray:
    """Square roots of positive semidefinite matrices, also singular ones; scaled first, since their units differ."""
    scale = np.sqrt(np.einsum("kii->ki", covariances))
    safe = np.where(scale > 0.0, scale, 1.0)
    values, vectors = np.linalg.eigh(covariances / (safe[:, :, None] * safe[:, None, :]))
    return scale[:, :, None] * vectors * np.sqrt(np.maximum(values, 0.0))[:, None, :]
