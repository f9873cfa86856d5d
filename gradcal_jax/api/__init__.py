"""Files to core objects and back: the one room that knows both.

`assemble(spec)` builds the sensor model and the schedules; `predict` and `timeline` fill the contracts that other
programs read.
"""

from gradcal_jax.api.build import Assembled, assemble, basis, bias_map, scale_factor_map
from gradcal_jax.api.error_budget import error_budget
from gradcal_jax.api.monte_carlo import TwinRow, monte_carlo
from gradcal_jax.api.posterior_of_plan import (
    DEG_PER_H,
    DEG_PER_S,
    PPM,
    UNIT_OF,
    posterior_of_plan,
    residual_map,
    target_of,
)
from gradcal_jax.api.prediction import predict
from gradcal_jax.api.recipe import recipe
from gradcal_jax.api.timeline import timeline
from gradcal_jax.api.unit_build import AssembledUnit, assemble_unit
from gradcal_jax.api.warnings import unobservable

__all__ = [
    "DEG_PER_H",
    "DEG_PER_S",
    "PPM",
    "UNIT_OF",
    "Assembled",
    "AssembledUnit",
    "TwinRow",
    "assemble",
    "assemble_unit",
    "basis",
    "bias_map",
    "error_budget",
    "monte_carlo",
    "posterior_of_plan",
    "predict",
    "recipe",
    "residual_map",
    "scale_factor_map",
    "target_of",
    "timeline",
    "unobservable",
]
