"""Bases with priors, the maps B(T) and M(T, ω), and the noise of sensor and reference."""

from gradcal_jax.errormodel.bases import Basis, Bins, BSpline, HigherPolynomials, Polynomial
from gradcal_jax.errormodel.model import Columns, GyroModel, Map, make_map
from gradcal_jax.errormodel.noise import (
    Processes,
    Reference,
    angle_reference,
    constant,
    gauss_markov,
    no_processes,
    rate_random_walk,
)

__all__ = [
    "BSpline",
    "Basis",
    "Bins",
    "Columns",
    "GyroModel",
    "HigherPolynomials",
    "Map",
    "Polynomial",
    "Processes",
    "Reference",
    "angle_reference",
    "constant",
    "gauss_markov",
    "make_map",
    "no_processes",
    "rate_random_walk",
]
