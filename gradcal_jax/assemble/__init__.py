"""Files to core objects and back: the one room that knows both.

`assemble(spec)` builds the error model and the plan; `predict` and `timeline` fill the contracts that other programs
read.
"""

from gradcal_jax.assemble.build import Assembled, assemble, basis, bias_map, scale_factor_map
from gradcal_jax.assemble.knowledge import DEG_PER_H, DEG_PER_S, PPM, UNIT_OF, knowledge, residual_map, target_of
from gradcal_jax.assemble.prediction import predict
from gradcal_jax.assemble.recipe import recipe
from gradcal_jax.assemble.shares import error_shares
from gradcal_jax.assemble.timeline import timeline
from gradcal_jax.assemble.twin import TwinRow, monte_carlo
from gradcal_jax.assemble.warnings import unobservable

__all__ = [
    "DEG_PER_H",
    "DEG_PER_S",
    "PPM",
    "UNIT_OF",
    "Assembled",
    "TwinRow",
    "assemble",
    "basis",
    "bias_map",
    "error_shares",
    "knowledge",
    "monte_carlo",
    "predict",
    "recipe",
    "residual_map",
    "scale_factor_map",
    "target_of",
    "timeline",
    "unobservable",
]
