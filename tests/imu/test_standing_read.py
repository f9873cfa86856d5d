"""A table whose angle is read while it stands (`standing = "read"`): on one axis along a gyro it is the scalar plan."""

import copy

import pytest
from imu_helpers import shipped

import gradcal_jax as gj
from gradcal_jax.information.prediction import predict
from gradcal_jax.spec.spec import spec_of

_GYRO = {
    "angle_random_walk": "0.1 deg/sqrt(h)",
    "drift": [{"standard_deviation": "1 deg/h", "correlation_time": "120 s"}],
    "bias": {
        "temperature": {"degree": 2, "centre": "20 degC", "scale": "50 K"},
        "prior": "500 deg/h",
    },
    "scale_factor": {
        "temperature": {"degree": 2, "centre": "20 degC", "scale": "50 K"},
        "rate": {"degree": 1, "scale": "300 deg/s"},
        "prior": "5000 ppm",
    },
}
_TABLE = {"max_rate": "300 deg/s", "max_acceleration": "300 deg/s^2"}
_ANGLE = {"reading_noise": "0.05 deg", "standstill_offset": "0.02 deg"}
_CHAMBER = {"range": ["-40 degC", "85 degC"], "max_heating": "2 K/min", "max_cooling": "2 K/min"}
# Cycles of 40 s fill the ramp: what is left of one is read in a unit's plan alone.
_PLAN = {"method": "gradient", "temperature": ["10 degC", "30 degC"], "gradient": "1 K/min"}
_TURN = {"turn": "720 deg", "shape": "cosine ramps", "duration": "10 s", "peak_rate": "100 deg/s"}
_BACK = _TURN | {"turn": "-720 deg"}


def unit(standing: str):
    """The same gyro as the unit's z along a vertical axis, on the equator: the Earth's rate is not along it."""
    axis = _TABLE | {"name": "spin", "direction": [0.0, 0.0, 1.0], "angle": _ANGLE}
    table = {"standing": standing, "axis": [axis]}
    return {
        "format": "gradcal-spec/1",
        "sensor": {"gyro": _GYRO | {"axes": ["z"]}},
        "rig": {"site": {"latitude": "0 deg"}, "table": table, "chamber": _CHAMBER},
        "plan": _PLAN | {"cycle": {"moves": [{"rest": "10 s"}, _TURN, {"rest": "10 s"}, _BACK]}},
    }


def sigmas(prediction) -> dict[str, float]:
    return {row.name.split(".")[-1]: row.std for row in prediction.parameters}


def test_a_table_that_holds_knows_the_bias_better():
    """A rest of a held table has no encoder in it: 0.05 deg in 10 s would be 18 deg/h."""
    read, held = (sigmas(predict(spec_of(unit(standing)))) for standing in ("read", "held"))
    assert held["a0"] < 0.9 * read["a0"]
    assert all(held[name] <= read[name] * (1.0 + 1e-9) for name in read)


def test_axes_are_read_together():
    document = copy.deepcopy(shipped("hand"))
    document["rig"]["table"]["standing"] = "read"
    document["rig"]["table"]["axis"][1]["angle"]["read_every"] = "2 s"
    with pytest.raises(gj.SpecError, match="read together"):
        spec_of(document)
