"""From a timeline and an error model to square-root information, the residual map and its Monte Carlo twin."""

from gradcal_jax.information.by_reading import filter_readings, filtered_states
from gradcal_jax.information.imu_rows import (
    encoder_rows,
    estimator_of_means,
    imu_information,
    imu_system,
    imu_unweighted,
    noise_parts,
    readings_of_standstills,
    row_of_steps,
    rows_of_angles,
    segments_of,
)
from gradcal_jax.information.montecarlo import (
    simulate_noise,
    simulated_errors,
)
from gradcal_jax.information.noise_steps import NoiseSteps
from gradcal_jax.information.posterior import (
    Posterior,
    SquareRootInformation,
    posterior,
    square_root,
    unobservable_combinations,
)
from gradcal_jax.information.residual import STATISTICS, contrasts, statistic
from gradcal_jax.information.whitening import gram, whiten, whitened_factor
