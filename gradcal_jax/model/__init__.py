"""Models of a sensor: bases, terms with priors, and the noise of sensor and reference."""

from gradcal_jax.model.bases import Basis, Bins, BSpline, HigherPolynomials, Polynomial
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
    SECOND,
    BodyGroup,
    BodyNodes,
    GaussNodes,
    Nodes,
    OtherTemperature,
)
from gradcal_jax.model.path import (
    GradientOfScale,
    Hysteresis,
    PathTerm,
    TemperatureDifference,
)
from gradcal_jax.model.sensor import (
    Processes,
    Reference,
    SensorModel,
    angle_reference,
    constant,
    gauss_markov,
    gyro_model,
    no_processes,
    rate_random_walk,
)
from gradcal_jax.model.terms import (
    BIAS,
    DISCREPANCY,
    HARMONICS,
    SCALE_FACTOR,
    TEMPERATURE_GRADIENT,
    Discrepancy,
    EncoderHarmonics,
    GradientOfBias,
    Map,
    OwnTerm,
    ProductTerm,
    RotationSensitivity,
    SignalMap,
    Term,
    constant_function,
    make_map,
    own_term,
)
