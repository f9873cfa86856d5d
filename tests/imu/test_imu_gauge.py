"""What no plan can tell of a whole unit: the gauge freedoms, and what a plan that lacks something is told."""

from itertools import product

import numpy as np
import pytest
from helpers import NoEarth
from imu_helpers import (
    accelerometer,
    back_and_forth,
    gyro,
    known,
    motion_of,
    rest,
    shipped,
    turn,
    two_axes,
    unit,
)

from gradcal_jax import model
from gradcal_jax.information.prediction import predict
from gradcal_jax.spec.changes import changed
from gradcal_jax.spec.spec import spec_of

_AXES = "xyz"
# Poses of all kinds, turns of both axes at many, reversals.
_DIRECTIONS = [v for v in product((-1, 0, 1), repeat=3) if any(v)]
_FREE = np.full(3, np.inf)


def rich_plan() -> list:
    steps = [rest(5.0)]
    for spin in (30.0, 45.0, 90.0, 90.0, 45.0):
        steps += [*back_and_forth(0, 5.0), turn(1, spin), *back_and_forth(1, 5.0), turn(0, 65.0), rest(5.0)]
        steps += [turn(0, 110.0), rest(5.0)]
    return steps


def free_unit():
    """45 numbers, nothing known beforehand: b, M, G of gyros, b, M, K2 of accelerometers, and the installation."""
    channels = [gyro(k) for k in range(3)] + [accelerometer(k, "b s m k2") for k in range(3)]
    installation = [
        model.BaseTilt(_FREE),
        model.NonOrthogonality(np.array([np.inf]), ("tilt", "spin")),
        model.MountingError(_FREE),
        model.CommonScale(np.array([np.inf]), "gravity"),
        model.CommonScale(np.array([np.inf]), "sample_clock"),
    ]
    return unit(channels, installation)


def gauge(of) -> dict[str, np.ndarray]:
    """The null vectors that the measurement model has, in the parameters of `free_unit`."""
    names, found = of.names(), {}

    def vector(**parts) -> np.ndarray:
        v = np.zeros(len(names))
        for name, value in parts.items():
            v[names.index(name.replace("__", "."))] = value
        return v

    scale = {"gyro": "b00", "accelerometer": "s"}
    clock = {f"{kind}_{a}__{symbol}": -1.0 for kind, symbol in scale.items() for a in _AXES}
    found["clock"] = vector(sample_clock=1.0, **clock)
    found["gravity"] = vector(gravity=9.80665, **{f"accelerometer_{a}__s": -1.0 for a in _AXES})
    for j, a in enumerate(_AXES):
        # p = e_a: δω = ω × p, which the antisymmetric part of either triad takes back.
        i, k = _AXES[(j + 1) % 3], _AXES[(j + 2) % 3]
        parts = {f"{kind}_{x}__m_{y}": s for kind in scale for x, y, s in ((i, k, -1.0), (k, i, 1.0))}
        found[f"rotation about {a}"] = vector(**{f"mounting1_{a}": 1.0}, **parts)
    found["azimuth"] = vector(azimuth=1.0)
    return found


def hidden(steps, of, geometry) -> np.ndarray:
    """What the plan leaves wholly unobserved: orthonormal directions, of parameters in units of like effect."""
    return known(motion_of(geometry, steps), of).hidden


def test_with_everything_free_the_null_space_is_the_gauge_and_nothing_else():
    """39 of 45 without the Earth's rate: clock, gravity, three rotations of the unit, and the azimuth."""
    of = free_unit()
    assert of.size == 45
    freedoms = gauge(of)
    found = hidden(rich_plan(), of, two_axes(kind=NoEarth))
    assert found.shape == (45, 6)
    assert len(freedoms) == 6
    basis, _ = np.linalg.qr(found)
    for name, direction in freedoms.items():
        left = direction - basis @ (basis.T @ direction)
        assert np.linalg.norm(left) < 1e-8 * np.linalg.norm(direction), name


# --- sentences --------------------------------------------------------------------------------------------------------


def sentences(moves, changes=None) -> tuple[str, ...]:
    """Warnings of `hand` with another cycle, over ten kelvin."""
    flat = {"degree": 0, "centre": "20 degC", "scale": "50 K"}
    triads, maps = ("gyro", "accelerometer"), ("bias", "scale_factor", "misalignment")
    keys = dict.fromkeys(f"sensor.{triad}.{of}.temperature" for triad in triads for of in maps)
    keys |= {"requirement": [], "plan.temperature": ["20 degC", "30 degC"], "plan.cycle": {"moves": moves}}
    keys |= {f"sensor.gyro.{of}.temperature": flat for of in maps[:2]}
    keys["sensor.gyro.scale_factor.rate"] = {"degree": 0, "scale": "300 deg/s"}
    return predict(changed(spec_of(shipped("hand")), keys | (changes or {}))).warnings


def go(tilt, spin, seconds="8 s") -> dict:
    return {"pose": {"tilt": f"{tilt} deg", "spin": f"{spin} deg"}, "rest": seconds}


def turns(axis) -> list[dict]:
    both = [{"turn": "1080 deg", "axis": axis}, {"rest": "8 s"}, {"turn": "-1080 deg", "axis": axis}, {"rest": "8 s"}]
    return both * 2


_ALL_FACES = [go(0, 0), go(180, 0), go(90, 0), go(270, 0), go(270, 90), go(90, 90)]
_HOME = [go(0, 0)]
_EVERYTHING = [*_ALL_FACES, go(90, 0), *turns("tilt"), go(90, 90), *turns("tilt"), go(90, 180), *turns("tilt")]
_EVERYTHING += [*turns("spin"), *_HOME, *turns("spin"), go(45, 45), go(135, 225), *_HOME]


def test_a_plan_that_lacks_nothing_is_told_nothing():
    assert sentences(_EVERYTHING) == ()


@pytest.mark.parametrize(
    ("moves", "name", "remedy"),
    [
        ([go(0, 0), go(90, 0), go(270, 0), go(90, 90), *turns("tilt"), *_HOME], "accelerometer_z.", "up, down"),
        ([go(0, 0), go(180, 0), go(90, 90), go(270, 90), *_HOME], "accelerometer_y.", "up, down"),
        ([go(0, 0), go(90, 0), go(180, 0), go(270, 0), *turns("tilt"), *_HOME], "gyro_z.b00", "turn about the gyro"),
        ([*turns("spin"), go(0, 90), go(0, 180), *_HOME], "gyro_x.g_", "not in one plane"),
        ([*turns("spin"), {"rest": "8 s"}], "gyro_x.m_", "rotated by 180 deg"),
    ],
    ids=["z down", "y up", "no turn", "one plane", "outer axis stands"],
)
def test_a_plan_that_lacks_something_is_told_what(moves, name, remedy):
    found = sentences(moves)
    about = [s for s in found if name in s and s.startswith("the plan cannot observe")]
    assert any(remedy in sentence for sentence in about), found


# --- freedoms that a prior alone limits -------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("changes", "said", "limits"),
    [
        (
            {"sensor.sample_clock_error": "200 ppm", "sensor.clock": "sensor"},
            "the plan does not reduce the uncertainty of sample_clock (200 ppm)",
            "gyro_x.b00",
        ),
        (
            {"rig.site.gravity_accuracy": "500 ug"},
            "the plan does not reduce the uncertainty of gravity (500 ug)",
            "accelerometer_x.s",
        ),
        (
            {"sensor.frame": "case", "rig.table.mounting": {"accuracy": "1 mrad"}},
            "the plan does not reduce the uncertainty of mounting1_x, mounting1_y, mounting1_z (1e+03 urad)",
            "accelerometer_y.m_x",
        ),
    ],
    ids=["clock", "gravity", "mounting"],
)
def test_a_freedom_that_its_prior_alone_limits_is_said_with_what_it_limits(changes, said, limits):
    found = sentences(_EVERYTHING, changes)
    assert len(found) == 1
    assert found[0].startswith(said), found
    assert limits in found[0]
