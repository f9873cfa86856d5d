"""A small problem for the search: two turns a visit, four coefficients, one ramp of 50 minutes."""

from functools import lru_cache
from pathlib import Path
from typing import Any

import gradcal_jax as gj
from gradcal_jax.design.plan_objective import ExactObjective
from gradcal_jax.spec.changes import tables_of
from gradcal_jax.spec.spec_sections import Spec


def exact(spec: Spec) -> float:
    """The objective of the spec's own plan."""
    of = ExactObjective(spec)
    return of.shown(of.left(spec))


IMU = Path(__file__).parents[1] / "experiments" / "imu"
LINE = {"degree": 1, "centre": "20 degC", "scale": "50 K"}


def coarse(spec: Spec, *names: str) -> list[dict[str, Any]]:
    """The requirements as tables, all or those of some names, on grids of 21 points at most."""
    rows = zip(tables_of(spec)["requirement"], spec.requirement, strict=True)
    return [row | {"grid": [min(g, 21) for g in of.grid]} for row, of in rows if of.name in (names or (of.name,))]


def turns_and_rests(rest: str, *turns: tuple[str, int]) -> list[dict[str, str]]:
    """The moves of a cycle: turns (axis, deg) with a rest after each."""
    moves = []
    for axis, angle in turns:
        moves += [{"turn": f"{angle} deg", "axis": axis, "peak_rate": "200 deg/s"}, {"rest": rest}]
    return moves


@lru_cache
def turning() -> Spec:
    """A gyro and its accelerometers on a ramp, small enough to compile quickly."""
    spec = gj.read_spec(IMU / "hand2.toml")
    turns = [("spin", 720), ("spin", -720), ("tilt", 50), ("spin", 40), ("tilt", 450), ("tilt", -380), ("spin", 55)]
    turns += [("tilt", -135), ("spin", 130), ("tilt", 180), ("spin", 135), ("tilt", -165)]
    maps = ("gyro.bias", "gyro.scale_factor", "accelerometer.bias", "accelerometer.scale_factor")
    changes = {f"sensor.{name}.temperature": LINE for name in maps} | {
        "sensor.gyro.axes": ["x", "z"],
        "sensor.gyro.scale_factor.rate": {"degree": 1, "scale": "300 deg/s"},
        "plan.cycle.moves": turns_and_rests("17 s", *turns),
        "requirement": coarse(spec, "gyro scale factor", "gyro bias", "accelerometer scale factor"),
    }
    return gj.changed(spec, changes)


@lru_cache
def one_gyro() -> Spec:
    """A gyro on a table of two axes, one of limited travel."""
    spec = gj.read_spec(IMU / "hand2.toml")
    turns = (("spin", 1000), ("tilt", 90), ("spin", -640), ("tilt", -90))
    changes = {
        "sensor.accelerometer": None,
        "sensor.gyro.axes": ["z"],
        "sensor.gyro.g_sensitivity": None,
        "sensor.gyro.misalignment": None,
        "sensor.gyro.bias.temperature": LINE,
        "sensor.gyro.scale_factor.temperature": LINE,
        "sensor.gyro.scale_factor.rate": {"degree": 1, "scale": "300 deg/s"},
        "rig.table.axis[0].travel": "200 deg",
        "plan.cycle.moves": turns_and_rests("8 s", *turns),
        "design": {"minimise": "gyro scale factor"},
        "requirement": coarse(spec, "gyro scale factor", "gyro bias"),
    }
    return gj.changed(spec, changes)


SPEC = """
format = "gradcal-spec/1"
[sensor.gyro]
axes = ["x"]
angle_random_walk = "0.1 deg/sqrt(h)"
[[sensor.gyro.drift]]
standard_deviation = "1 deg/h"
correlation_time   = "120 s"
[sensor.gyro.scale_factor]
temperature = { degree = 1, centre = "20 degC", scale = "50 K" }
rate        = { degree = 1, scale = "300 deg/s" }
[rig.table]
standing = "read"
mounting = { x = "+z", y = "+x", z = "+y" }
[[rig.table.axis]]
name = "x"
direction = [0.0, 0.0, 1.0]
max_rate         = "300 deg/s"
max_acceleration = "300 deg/s^2"
travel           = "unlimited"
[rig.table.axis.angle]
reading_noise = "0.05 deg"
read_every = "5 s"
[rig.chamber]
range       = ["-40 degC", "85 degC"]
max_heating = "2 K/min"
max_cooling = "1.5 K/min"
[[requirement]]
name        = "full range"
quantity    = "gyro_scale_factor"
axis = "x"
temperature = ["-30 degC", "70 degC"]
rate        = ["-300 deg/s", "300 deg/s"]
statistic   = "mean of max"
grid        = [21, 21]
[plan]
method      = "gradient"
temperature = ["-30 degC", "70 degC"]
gradient    = "2 K/min"
[plan.cycle]
other_axes = { duration = "780 s", read_every = "20 s" }
moves = [
  { rest = "10 s", read_every = "5 s" },
  { turn = "9790 deg", duration = "50 s", peak_rate = "200 deg/s", shape = "cosine ramps" },
  { rest = "10 s", read_every = "5 s" },
  { turn = "-7380 deg", duration = "50 s", peak_rate = "150 deg/s", shape = "cosine ramps" },
]
[design]
minimise = "full range"
starts = 2
moves = 2
"""
