"""Sweeps that take seconds, and their pieces: a quarter of an hour's ramp, a gyro with five coefficients."""

from pathlib import Path

SPEC = """
format = "gradcal-spec/1"
[sensor.gyro]
axes = ["x"]
angle_random_walk = "0.1 deg/sqrt(h)"
[[sensor.gyro.drift]]
standard_deviation = "1 deg/h"
correlation_time   = "120 s"
[sensor.gyro.bias]
temperature = { degree = 1, centre = "10 degC", scale = "10 K" }
[sensor.gyro.scale_factor]
temperature = { degree = 1, centre = "10 degC", scale = "10 K" }
rate        = { degree = 1, scale = "100 deg/s" }
[rig.table]
standing = "read"
rate_accuracy    = "100 ppm"
mounting = { x = "+z", y = "+x", z = "+y" }
[[rig.table.axis]]
name = "x"
direction = [0.0, 0.0, 1.0]
max_rate         = "100 deg/s"
max_acceleration = "200 deg/s^2"
travel           = "unlimited"
[rig.table.axis.angle]
reading_noise     = "0.02 deg"
standstill_offset = "0.01 deg"
read_every = "1 s"
[rig.chamber]
range       = ["-40 degC", "85 degC"]
max_heating = "3 K/min"
max_cooling = "3 K/min"
[[requirement]]
name        = "scale"
quantity    = "gyro_scale_factor"
axis = "x"
temperature = ["0 degC", "20 degC"]
rate        = ["-100 deg/s", "100 deg/s"]
target      = "250 ppm"
grid        = [11, 9]
[[requirement]]
name        = "bias"
quantity    = "gyro_bias"
axis = "x"
temperature = ["0 degC", "20 degC"]
grid        = [11]
[plan]
method      = "gradient"
temperature = ["0 degC", "20 degC"]
gradient    = "2 K/min"
[plan.cycle]
other_axes = { duration = "20 s", read_every = "1 s" }
moves = [
  { rest = "5 s", read_every = "1 s" },
  { turn = "360 deg", peak_rate = "80 deg/s", shape = "cosine ramps" },
  { rest = "5 s", read_every = "1 s" },
  { turn = "-360 deg", peak_rate = "50 deg/s", shape = "linear ramps" },
]
"""
GRID = """
format = "gradcal-sweep/1"
title  = "rest and noise"
base   = "small.toml"
[[axis]]
name   = "rest"
key    = "plan.cycle.moves[2].rest"
start  = "3 s"
stop   = "6 s"
count  = 4
[[axis]]
name   = "peak rate"
key    = "plan.cycle.moves[1].peak_rate"
values = ["60 deg/s", "80 deg/s", "110 deg/s"]
"""


def written(folder: Path, sweep: str = GRID) -> Path:
    """The sweep and its base in a folder; the sweep's path."""
    (folder / "small.toml").write_text(SPEC, encoding="utf-8")
    path = folder / "sweep.toml"
    path.write_text(sweep, encoding="utf-8")
    return path
