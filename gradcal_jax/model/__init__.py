"""Models of a sensor: bases, terms with priors, and the noise of sensor and reference."""

from gradcal_jax.model.bases import Basis, Bins, BSpline, HigherPolynomials, Polynomial
from gradcal_jax.model.nodes import GaussNodes, Nodes, SampleNodes
from gradcal_jax.model.noise import (
    Processes,
    Reference,
    angle_reference,
    constant,
    gauss_markov,
    no_processes,
    rate_random_walk,
)
from gradcal_jax.model.sensor import SensorModel, gyro_model
from gradcal_jax.model.terms import (
    BIAS,
    DISCREPANCY,
    HARMONICS,
    SCALE_FACTOR,
    TEMPERATURE_GRADIENT,
    BiasTemperatureGradient,
    Discrepancy,
    EncoderHarmonics,
    Map,
    Term,
    make_map,
)

__all__ = [
    "BIAS",
    "DISCREPANCY",
    "HARMONICS",
    "SCALE_FACTOR",
    "TEMPERATURE_GRADIENT",
    "BSpline",
    "Basis",
    "BiasTemperatureGradient",
    "Bins",
    "Discrepancy",
    "EncoderHarmonics",
    "GaussNodes",
    "HigherPolynomials",
    "Map",
    "Nodes",
    "Polynomial",
    "Processes",
    "Reference",
    "SampleNodes",
    "SensorModel",
    "Term",
    "angle_reference",
    "constant",
    "gauss_markov",
    "gyro_model",
    "make_map",
    "no_processes",
    "rate_random_walk",
]
