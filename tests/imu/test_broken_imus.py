"""Broken specs of whole units: every fault is named by its key and said in words, and no slip is a traceback."""

import copy
from typing import Any

import pytest
from imu_helpers import shipped

from gradcal_jax.spec.spec import spec_of
from gradcal_jax.tables.problems import SpecError

GOOD = shipped("hand")
GOOD["plan"]["temperature"] = ["20 degC", "30 degC"]
GOOD["plan"]["cycle"]["moves"] = [
    {"pose": {"tilt": "0 deg"}, "rest": "8 s"},
    {"turn": "720 deg", "axis": "spin"},
    {"rest": "8 s"},
    {"turn": "-720 deg", "axis": "spin", "peak_rate": "150 deg/s"},
    {"pose": {"tilt": "90 deg", "spin": "90 deg"}, "rest": "8 s"},
    {"pose": {"tilt": "0 deg", "spin": "0 deg"}},
]


class _Gone:
    def __repr__(self) -> str:
        return "absent"


GONE = _Gone()
_MOVES = "plan.cycle.moves"

# What is set where (GONE: deleted), the key that must be named, words that must be said.
BROKEN: list[tuple[str, Any, str, str]] = [
    # the unit
    ("sensor.gyro.axes", ["x", "x"], "sensor.gyro.axes", "twice"),
    ("sensor.gyro.bias", GONE, "requirement[1].quantity", "gyro.bias"),
    ("sensor.gyro.misalignment.prior", "0 mrad", "sensor.gyro.misalignment.prior", "above"),
    ("sensor.gyro.g_sensitivity", {"lever_arm": "3 mm"}, "sensor.gyro.g_sensitivity.lever_arm", "give the prior"),
    ("sensor.frame", "the wall", "sensor.frame", "table axes"),
    ("sensor.frame", "case", "rig.table.mounting[0].accuracy", "above zero"),
    # the rig
    ("rig.site.latitude", "91 deg", "rig.site.latitude", "from -90 deg to 90 deg"),
    ("rig.site.latitude", GONE, "rig.site.latitude", "missing"),
    ("rig.site.gravity", "0 m/s^2", "rig.site.gravity", "above"),
    ("rig.table.drive", "hand", "plan.cycle.moves[1].shape", "by hand"),
    ("rig.table.axis.0.direction", [0.0, 0.0, 0.0], "rig.table.axis[0].direction", "not a direction"),
    ("rig.table.axis.1.name", "tilt", "rig.table.axis[1].name", "two axes have this name"),
    ("rig.table.axis.1.orthogonality", "100 urad", "rig.table.axis[1].orthogonality", "innermost"),
    ("rig.table.mounting", {"x": "+x", "y": "+x", "z": "+z"}, "rig.table.mounting[0]", "right-handed"),
    ("rig.table.mounting", [{}, {}], "sensor.frame", "several mountings"),
    # requirements
    ("requirement.0.quantity", "gyro_scale", "requirement[0].quantity", "gyro_scale_factor"),
    ("requirement.2.relative_to", "moon", "requirement[2].relative_to", "internal"),
    ("sensor.accelerometer.second_order", GONE, "requirement[7].quantity", "accelerometer.second_order"),
    # the plan
    ("plan.cycle.other_axes", {"duration": "1 min"}, "plan.cycle.other_axes", "standing"),
    (f"{_MOVES}.1.axis", GONE, f"{_MOVES}[1].axis", "which axis turns"),
    (f"{_MOVES}.0.pose", {"tlit": "0 deg"}, f"{_MOVES}[0].pose.tlit", 'nearest: "tilt"'),
    (f"{_MOVES}.5", {"rest": "2 s"}, _MOVES, "must return"),
    (f"{_MOVES}.2.axis", "spin", f"{_MOVES}[2].axis", "this key is unknown"),
    ("plan.cycle.start", {"roll": "90 deg"}, "plan.cycle.start.roll", "no axis of this name"),
]  # fmt: skip
# ruff: noqa: E501


def place(document, dotted: str, value) -> None:
    *path, last = [int(part) if part.isdigit() else part for part in dotted.split(".")]
    for part in path:
        document = document[part]
    if value is GONE:
        del document[last]
    else:
        document[last] = value


@pytest.mark.parametrize(("where", "value", "key", "words"), BROKEN, ids=lambda v: str(v)[:40])
def test_every_fault_is_named_by_its_key_and_said_in_words(where, value, key, words):
    document = copy.deepcopy(GOOD)
    place(document, where, value)
    with pytest.raises(SpecError) as caught:
        spec_of(document)
    named = [problem for problem in caught.value.problems if problem.dotted == key]
    assert named, [str(problem) for problem in caught.value.problems]
    assert any(words in str(problem) for problem in named), [str(problem) for problem in named]


@pytest.mark.parametrize(
    ("edits", "words"),
    [
        ({"sensor.gyro": GONE, "sensor.accelerometer": GONE}, "nothing to calibrate"),
        ({"sensor.gyro.axes": ["x", "y"], "requirement": [{"name": "h", "quantity": "gyro_bias", "axis": "z"}]}, "no such axis"),
        ({"plan.cycle.moves": [{"turn": "360 deg", "axis": "spin"}]}, "has no rest"),
        ({"plan.cycle.moves": [{"turn": "9 deg", "axis": "spin", "peek_rate": "1 deg/s"}]}, "moves[0].peek_rate"),
    ],
    ids=lambda v: str(v)[:40],
)  # fmt: skip
def test_faults_of_several_keys_together(edits, words):
    document = copy.deepcopy(GOOD)
    document["requirement"] = []
    for where, value in edits.items():
        place(document, where, value)
    for requirement in document["requirement"]:
        requirement["temperature"] = ["20 degC", "30 degC"]
    with pytest.raises(SpecError) as caught:
        spec_of(document)
    assert words in str(caught.value)


@pytest.mark.parametrize(
    ("requirement", "kind", "axes", "words"),
    [
        ({"quantity": "gyro_misalignment", "relative_to": "internal"}, "gyro", ["x", "y"], "gyro z"),
    ],
    ids=lambda v: str(v)[:30],
)
def test_a_sensor_that_is_not_there_is_no_perfect_one(requirement, kind, axes, words):
    """A quantity that several sensors make needs them all: one that is absent would count as known exactly."""
    document = copy.deepcopy(GOOD)
    document["requirement"] = [requirement | {"name": "r", "temperature": ["20 degC", "30 degC"]}]
    assert spec_of(document).requirement
    document["sensor"][kind]["axes"] = axes
    with pytest.raises(SpecError) as caught:
        spec_of(document)
    (problem,) = caught.value.problems
    assert problem.dotted == "requirement[0].quantity"
    assert f"needs {words}, but the sensor has no such axis" in problem.message


# --- slips ------------------------------------------------------------------------------------------------------------


def test_a_cycle_of_several_stretches_returns():
    document = copy.deepcopy(GOOD)
    plan = {"method": "gradient", "programme": [{"soak": "10 min", "at": "20 degC", "used": True}]}
    plan["programme"] += [{"soak": "1 min"}, {"soak": "10 min", "used": True}]
    document["plan"] = plan | {"cycle": {"moves": [{"rest": "5 s"}, {"turn": "90 deg", "axis": "spin"}]}}
    with pytest.raises(SpecError, match="starts again in every part"):
        spec_of(document)
    document["plan"]["cycle"]["moves"].append({"turn": "-90 deg", "axis": "spin"})
    assert len(spec_of(document).schedule.stretches) == 2
