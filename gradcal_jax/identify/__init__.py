"""Instability from records at rest: Direct Bound, Allan deviation, and the bias over temperature taken off before."""

from gradcal_jax.identify.allan import (
    MISFIT,
    AllanDeviation,
    AllanFit,
    averaging_times,
    fit_allan,
    model_variance,
    overlapping_allan,
    overlapping_allan_of_angle,
)
from gradcal_jax.identify.direct_bound import (
    DirectBound,
    fit_direct_bound,
    scatter_of_bound,
    share_beyond,
    smallest_bounding_variance,
)
from gradcal_jax.identify.largest_drift import (
    LargestDrift,
    drifts,
    integration_times,
    largest_drift,
    longest_integration_time,
)
from gradcal_jax.identify.limiting_function import (
    kalman_alignment_variance,
    limiting_function,
    limiting_function_of_mean,
)
from gradcal_jax.identify.slow_noise import SlowNoise, slow_noise
from gradcal_jax.identify.thermal import ThermalBias, fit_thermal_bias, lagged

__all__ = [
    "MISFIT",
    "AllanDeviation",
    "AllanFit",
    "DirectBound",
    "LargestDrift",
    "SlowNoise",
    "ThermalBias",
    "averaging_times",
    "drifts",
    "fit_allan",
    "fit_direct_bound",
    "fit_thermal_bias",
    "integration_times",
    "kalman_alignment_variance",
    "lagged",
    "largest_drift",
    "limiting_function",
    "limiting_function_of_mean",
    "longest_integration_time",
    "model_variance",
    "overlapping_allan",
    "overlapping_allan_of_angle",
    "scatter_of_bound",
    "share_beyond",
    "slow_noise",
    "smallest_bounding_variance",
]
