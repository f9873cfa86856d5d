"""Short specs for logs: a gyro that turns and rests while the temperature ramps, small enough to be simulated often."""

from gradcal_jax.estimation.estimate import SensorEstimate, estimate_log
from gradcal_jax.estimation.log_rows import Options
from gradcal_jax.records.log import Log
from gradcal_jax.spec.spec import Spec, parse_spec

GRADIENT = """
format = "gradcal-spec/1"
title = "short ramp"
[sensor.gyro]
axes = ["x"]
angle_random_walk = "0.5 deg/sqrt(h)"
[[sensor.gyro.drift]]
standard_deviation = "5 deg/h"
correlation_time = "60 s"
[sensor.gyro.bias]
temperature = { degree = 1, centre = "20 degC", scale = "20 K" }
[sensor.gyro.scale_factor]
temperature = { degree = 1, centre = "20 degC", scale = "20 K" }
rate = { degree = 1, scale = "300 deg/s" }
[rig.table]
standing = "read"
mounting = { x = "+z", y = "+x", z = "+y" }
[[rig.table.axis]]
name = "x"
direction = [0.0, 0.0, 1.0]
max_rate = "300 deg/s"
max_acceleration = "600 deg/s^2"
[rig.table.axis.angle]
reading_noise = "1 arcsec"
read_every = "1 s"
[rig.chamber]
range = ["-40 degC", "85 degC"]
max_heating = "5 K/min"
max_cooling = "5 K/min"
[[requirement]]
name = "map"
quantity = "gyro_scale_factor"
axis = "x"
temperature = ["0 degC", "40 degC"]
rate = ["-300 deg/s", "300 deg/s"]
target = "2000 ppm"
[[requirement]]
name = "bias"
quantity = "gyro_bias"
axis = "x"
temperature = ["0 degC", "40 degC"]
[plan]
method = "gradient"
temperature = ["0 degC", "40 degC"]
gradient = "4 K/min"
[plan.cycle]
moves = [
  { rest = "10 s", read_every = "1 s" },
  { turn = "1440 deg", peak_rate = "300 deg/s", shape = "cosine ramps" },
  { rest = "5 s", read_every = "1 s" },
  { turn = "-720 deg", peak_rate = "120 deg/s", shape = "cosine ramps" },
  { turn = "720 deg", peak_rate = "120 deg/s", shape = "cosine ramps" },
  { rest = "5 s", read_every = "1 s" },
  { turn = "-1440 deg", peak_rate = "300 deg/s", shape = "cosine ramps" },
]
"""

STANDARD = (
    GRADIENT[: GRADIENT.index("[plan]")].replace('standing = "read"', 'standing = "read"\nrate_accuracy = "50 ppm"')
    + """[plan]
method = "standard"
temperatures = ["0 degC", "20 degC", "40 degC"]
soak = "10 min"
rates = ["-300 deg/s", "-100 deg/s", "0 deg/s", "100 deg/s", "300 deg/s"]
integration = "60 s"
"""
)


def spec_of(text: str = GRADIENT, **changes: str):
    """A spec with some texts in the place of others: `old=new`, underscores for spaces in `old`."""
    for old, new in changes.items():
        assert old in text
        text = text.replace(old, new)
    return parse_spec(text)


def estimated(
    spec: Spec, log: Log, *, axis: str | None = None, units: tuple[str, ...] = (), options: Options | None = None
) -> tuple[SensorEstimate, ...]:
    """The estimate of every unit of a log."""
    return estimate_log(spec, [log], axis=axis, units=units, options=options).sensors
