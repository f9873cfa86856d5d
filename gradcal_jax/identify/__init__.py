"""Instability from records at rest: Direct Bound, Allan deviation, and removal of the bias over temperature."""

from gradcal_jax.identify.allan import MISFIT, AllanDeviation, AllanFit, fit_allan, overlapping_allan
from gradcal_jax.identify.direct_bound import DirectBound, fit_direct_bound
from gradcal_jax.identify.largest_drift import integration_times, largest_drift, longest_integration_time
from gradcal_jax.identify.limiting_function import limiting_function
from gradcal_jax.identify.thermal import ThermalBias, fit_thermal_bias
