"""From a timeline and an error model to square-root information, the residual map and its Monte Carlo twin."""

from gradcal_jax.information.adjoint import gram, whitened_factor
from gradcal_jax.information.montecarlo import Twin, WishartTest, simulate_noise, twin, wishart_test
from gradcal_jax.information.noise_steps import NoiseSteps, noise_steps
from gradcal_jax.information.observability import parameter_names, to_reported, unobservable_combinations
from gradcal_jax.information.posterior import (
    Posterior,
    SquareRootInformation,
    information,
    posterior,
    square_root,
    unweighted,
    whitened_rows,
)
from gradcal_jax.information.regressors import at_readings, increments
from gradcal_jax.information.residual import STATISTICS, contrasts, residual, statistic
from gradcal_jax.information.whitening import FilterState, whiten, whiten_from

__all__ = [
    "STATISTICS",
    "FilterState",
    "NoiseSteps",
    "Posterior",
    "SquareRootInformation",
    "Twin",
    "WishartTest",
    "at_readings",
    "contrasts",
    "gram",
    "increments",
    "information",
    "noise_steps",
    "parameter_names",
    "posterior",
    "residual",
    "simulate_noise",
    "square_root",
    "statistic",
    "to_reported",
    "twin",
    "unobservable_combinations",
    "unweighted",
    "whiten",
    "whiten_from",
    "whitened_factor",
    "whitened_rows",
    "wishart_test",
]
