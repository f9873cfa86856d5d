"""From readings to parameters with covariance: the prediction's own measurement model, fed with data."""

from gradcal_jax.estimate.bases import basis_values
from gradcal_jax.estimate.consistency import (
    Consistency,
    Split,
    Test,
    consistency,
    nees_band,
    normalised_errors,
    split,
    whiteness,
)
from gradcal_jax.estimate.executed import Executed, distinct_readings, executed, momentary_stops
from gradcal_jax.estimate.neighbours import Group, Move, closest_neighbours, moves_between_rests
from gradcal_jax.estimate.observations import Observations, on_timeline, steps_of
from gradcal_jax.estimate.plateaus import Plateaus, plateaus
from gradcal_jax.estimate.robust import HUBER, RobustEstimate, estimate_robustly
from gradcal_jax.estimate.samples import (
    columns_at_readings,
    increments_of_samples,
    integrated_error,
    since_gap,
    true_rate,
)
from gradcal_jax.estimate.smoothing import Smoothness, choose_smoothness, with_smoothness
from gradcal_jax.estimate.solve import Estimate, Whitened, estimate, solve, whitened
from gradcal_jax.estimate.standstill import find_standstills
from gradcal_jax.estimate.temperature import SMOOTHED_OVER_S, smoothed_temperature

__all__ = [
    "HUBER",
    "SMOOTHED_OVER_S",
    "Consistency",
    "Estimate",
    "Executed",
    "Group",
    "Move",
    "Observations",
    "Plateaus",
    "RobustEstimate",
    "Smoothness",
    "Split",
    "Test",
    "Whitened",
    "basis_values",
    "choose_smoothness",
    "closest_neighbours",
    "columns_at_readings",
    "consistency",
    "distinct_readings",
    "estimate",
    "estimate_robustly",
    "executed",
    "find_standstills",
    "increments_of_samples",
    "integrated_error",
    "momentary_stops",
    "moves_between_rests",
    "nees_band",
    "normalised_errors",
    "on_timeline",
    "plateaus",
    "since_gap",
    "smoothed_temperature",
    "solve",
    "split",
    "steps_of",
    "true_rate",
    "whitened",
    "whiteness",
    "with_smoothness",
]
