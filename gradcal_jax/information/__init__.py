"""What the readings of a motion tell: `ImuModel` and `TableMotion` in, `Posterior`, residuals and predictions out.

* `noise_steps`, `imu_rows`: rows, columns and the noise system; `gears`: errors of a drive in them;
  `plan_information`: those of a plan.
* `whitening`: generalised least squares; `posterior`: square-root information.
* `residual`, `missions`: what a requirement asks for, as a function of the covariance; `verdicts`.
* `unseen`: what no residual shows; `figures`, `error_budget`: shares of errors; `plan_sentences`: what a plan lacks.
* `prediction`, `differentiable`, `sensitivity`: the functions that people call.
"""

from gradcal_jax.information.imu_rows import (
    encoder_rows,
    imu_system,
    noise_parts,
    readings_of_standstills,
    row_of_steps,
    rows_of_angles,
    segments_of,
)
from gradcal_jax.information.noise_steps import NoiseSteps
from gradcal_jax.information.plan_information import estimator_of_means, imu_information, imu_unweighted
from gradcal_jax.information.posterior import (
    Posterior,
    SquareRootInformation,
    posterior,
    square_root,
)
from gradcal_jax.information.residual import STATISTICS, grid_element, map_rows, statistic
from gradcal_jax.information.whitening import by_reading, gram, weights, whiten, whitened_factor
