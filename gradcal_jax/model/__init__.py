"""What a sensor gets wrong, linear in parameters with priors: `Spec` in, `ImuModel` out (`build.build_imu`).

* `bases`: functions of temperature or rate. `nodes`: where the terms are evaluated, in plans and in logs.
* `terms`: maps, discrepancies, sensitivities to dT/dt, and one general error term; `path`: hysteresis.
* `noise`: slow noise processes. `imu`: channels of terms and noise. `installation`: errors of table, site and clock.
* `build`: all of these from a spec, with the motion of its plan.
"""

from gradcal_jax.model.bases import Basis, BSpline, Polynomial
from gradcal_jax.model.imu import KINDS, Channel, ChannelKind, EncoderNoise, ImuModel
from gradcal_jax.model.installation import (
    AxisHarmonics,
    BaseTilt,
    CommonScale,
    InstallationTerm,
    MountingError,
    NonOrthogonality,
)
from gradcal_jax.model.nodes import (
    AXIS_NAMES,
    BodyNodes,
    NodeGroup,
)
from gradcal_jax.model.noise import Processes, constant, gauss_markov, no_processes, rate_random_walk
from gradcal_jax.model.path import Hysteresis
from gradcal_jax.model.terms import (
    BIAS,
    DISCREPANCY,
    SCALE_FACTOR,
    SLOPE,
    TEMPERATURE_GRADIENT,
    Discrepancy,
    GradientOfBias,
    Map,
    OwnTerm,
    ProductTerm,
    Term,
    constant_function,
    make_map,
    term_of_class,
)
