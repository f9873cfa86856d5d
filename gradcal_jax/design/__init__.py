"""Plans by gradient descent: free coordinates, criteria, the search, and a proven limit."""

from gradcal_jax.design.coordinates import (
    EASED,
    STEEPNESS,
    Coordinates,
    Cycle,
    Element,
    Frame,
    Limits,
    make_coordinates,
)
from gradcal_jax.design.criteria import EXACT, Criterion, Missed, Optimality, criterion, polynomial_grid
from gradcal_jax.design.limit import Limit, limit
from gradcal_jax.design.noise_floor import (
    PRIOR_OF_WALK,
    bias_floor,
    bias_floor_anywhere,
    gated_noise_density,
    least_noise_density,
    scale_factor_floor,
)
from gradcal_jax.design.objective import AnyCoordinates, Case, Objective
from gradcal_jax.design.other_plans import ProgrammeCoordinates, ProgrammeKnots, StandardCoordinates
from gradcal_jax.design.search import (
    KEPT,
    Compiled,
    Linear,
    Optimum,
    Progress,
    State,
    exactly,
    missed_limit,
    multipliers,
    polish,
    search,
)

__all__ = [
    "EASED",
    "EXACT",
    "KEPT",
    "PRIOR_OF_WALK",
    "STEEPNESS",
    "AnyCoordinates",
    "Case",
    "Compiled",
    "Coordinates",
    "Criterion",
    "Cycle",
    "Element",
    "Frame",
    "Limit",
    "Limits",
    "Linear",
    "Missed",
    "Objective",
    "Optimality",
    "Optimum",
    "ProgrammeCoordinates",
    "ProgrammeKnots",
    "Progress",
    "StandardCoordinates",
    "State",
    "bias_floor",
    "bias_floor_anywhere",
    "criterion",
    "exactly",
    "gated_noise_density",
    "least_noise_density",
    "limit",
    "make_coordinates",
    "missed_limit",
    "multipliers",
    "polish",
    "polynomial_grid",
    "scale_factor_floor",
    "search",
]
