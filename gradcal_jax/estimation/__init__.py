"""From readings to parameters with covariance: the prediction's own measurement model, fed with data."""

from gradcal_jax.estimation.consistency import (
    Consistency,
    Split,
    Test,
    chi_squared_test,
    consistency,
    nees_band,
    normalised_errors,
    split,
    whiteness,
)
from gradcal_jax.estimation.executed import Executed, distinct_readings, executed, momentary_stops
from gradcal_jax.estimation.neighbours import Group, Move, closest_neighbours, moves_between_rests
from gradcal_jax.estimation.observations import Observations, on_trajectory
from gradcal_jax.estimation.plateaus import Plateaus, plateaus
from gradcal_jax.estimation.robust import HUBER, RobustEstimate, estimate_robustly
from gradcal_jax.estimation.samples import integrated_error, sample_nodes, true_rate
from gradcal_jax.estimation.smoothing import Smoothness, choose_smoothness, with_smoothness
from gradcal_jax.estimation.solve import Estimate, Whitened, estimate, solve, whitened
from gradcal_jax.estimation.standstill import find_standstills
from gradcal_jax.estimation.structure import (
    Components,
    Size,
    StructureTest,
    chi_squared,
    components,
    size_of,
    structure_test,
)
from gradcal_jax.estimation.temperature import SMOOTHED_OVER_S, smoothed_temperature
from gradcal_jax.estimation.unit_executed import ExecutedUnit, UnitRows, executed_unit, nodes_of_rows
from gradcal_jax.estimation.unit_solve import (
    Installed,
    UnitEstimate,
    UnitReadings,
    estimate_unit,
    installed,
    readings_of,
)

__all__ = [
    "HUBER",
    "SMOOTHED_OVER_S",
    "Components",
    "Consistency",
    "Estimate",
    "Executed",
    "ExecutedUnit",
    "Group",
    "Installed",
    "Move",
    "Observations",
    "Plateaus",
    "RobustEstimate",
    "Size",
    "Smoothness",
    "Split",
    "StructureTest",
    "Test",
    "UnitEstimate",
    "UnitReadings",
    "UnitRows",
    "Whitened",
    "chi_squared",
    "chi_squared_test",
    "choose_smoothness",
    "closest_neighbours",
    "components",
    "consistency",
    "distinct_readings",
    "estimate",
    "estimate_robustly",
    "estimate_unit",
    "executed",
    "executed_unit",
    "find_standstills",
    "installed",
    "integrated_error",
    "momentary_stops",
    "moves_between_rests",
    "nees_band",
    "nodes_of_rows",
    "normalised_errors",
    "on_trajectory",
    "plateaus",
    "readings_of",
    "sample_nodes",
    "size_of",
    "smoothed_temperature",
    "solve",
    "split",
    "structure_test",
    "true_rate",
    "whitened",
    "whiteness",
    "with_smoothness",
]
