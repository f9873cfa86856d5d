"""Plans by gradient descent: free coordinates, criteria, the search, and a proven limit."""

from gradcal_jax.design.coordinates import (
    STEEPNESS,
    Coordinates,
    CycleNumbers,
    Element,
    Frame,
    Limits,
    make_coordinates,
)
from gradcal_jax.design.criteria import Criterion, Optimality, criterion, polynomial_grid
from gradcal_jax.design.limit import Limit, limit
from gradcal_jax.design.noise_floor import (
    PRIOR_OF_WALK,
    bias_floor,
    bias_floor_anywhere,
    bias_seen_continuously,
    least_noise_density,
    longest_step,
    scale_factor_floor,
)
from gradcal_jax.design.objective import AnyCoordinates, Case, Objective
from gradcal_jax.design.other_plans import ProgrammeCoordinates, StandardCoordinates
from gradcal_jax.design.search import (
    KEPT,
    Compiled,
    Optimum,
    SearchState,
    exactly,
    multipliers,
    polish,
    search,
)
