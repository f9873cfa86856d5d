"""Broken specs of whole units: every fault is named by its key and said in words, and no slip is a traceback."""

import copy
import math
from typing import Any

import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st
from imu_helpers import shipped

from gradcal_jax.spec.spec import spec_of
from gradcal_jax.spec.spec_sections import Spec
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
    ("sensor.gyro.angle_random_walk", GONE, "sensor.gyro.angle_random_walk", "missing"),
    ("sensor.gyro.angle_random_walk", "0.15 deg/h", "sensor.gyro.angle_random_walk", "angle random walk"),
    ("sensor.gyro.angle_random_walk", 0.15, "sensor.gyro.angle_random_walk", "text with a unit"),
    ("sensor.gyro.angle_random_walk", "-1 deg/sqrt(h)", "sensor.gyro.angle_random_walk", "above"),
    ("sensor.gyro.axes", ["x", "x"], "sensor.gyro.axes", "twice"),
    ("sensor.gyro.axes", ["x", "u"], "sensor.gyro.axes[1]", "expected"),
    ("sensor.gyro.axes", [], "sensor.gyro.axes", "at least 1"),
    ("sensor.gyro.drfit", [], "sensor.gyro.drfit", 'nearest: "drift"'),
    ("sensor.gyro.drift.0.standard_deviation", "1 ug", "sensor.gyro.drift[0].standard_deviation", "angular rate"),
    ("sensor.gyro.drift.0.correlation_time", "0 s", "sensor.gyro.drift[0].correlation_time", "above"),
    ("sensor.gyro.bias", GONE, "requirement[1].quantity", "gyro.bias"),
    ("sensor.gyro.bias_temperature_gradient", "5 deg/h", "sensor.gyro.bias_temperature_gradient", "gradient"),
    ("sensor.gyro.bias_temperature_gradient", {"std": "1"}, "sensor.gyro.bias_temperature_gradient.std", "unknown"),
    ("sensor.gyro.temperature_error", {"standard_deviation": "1 K"}, "sensor.gyro.temperature_error", "bias_slope"),
    ("sensor.gyro.bias.prior", "5 mg", "sensor.gyro.bias.prior", "angular rate"),
    ("sensor.gyro.misalignment.prior", "10 ppm/K", "sensor.gyro.misalignment.prior", "angle"),
    ("sensor.gyro.misalignment.prior", "0 mrad", "sensor.gyro.misalignment.prior", "above"),
    ("sensor.gyro.misalignment.temperature.degree", 1.5, "sensor.gyro.misalignment.temperature.degree", "whole"),
    ("sensor.gyro.misalignment.std", "1 mrad", "sensor.gyro.misalignment.std", "unknown"),
    ("sensor.gyro.g_sensitivity.prior", "50 deg/h", "sensor.gyro.g_sensitivity.prior", "acceleration"),
    ("sensor.gyro.g_sensitivity", {"lever_arm": "3 mm"}, "sensor.gyro.g_sensitivity.lever_arm", "give the prior"),
    ("sensor.gyro.g_sensitivity.lever_arm", "3 mrad", "sensor.gyro.g_sensitivity.lever_arm", "length"),
    ("sensor.accelerometer.velocity_random_walk", GONE, "sensor.accelerometer.velocity_random_walk", "missing"),
    ("sensor.accelerometer.velocity_random_walk", "1 ug", "sensor.accelerometer.velocity_random_walk", "velocity"),
    ("sensor.accelerometer.drift.0.standard_deviation", "1 deg/h", "sensor.accelerometer.drift[0].standard_deviation", "acceleration"),
    ("sensor.accelerometer.bias.prior", "-20 mg", "sensor.accelerometer.bias.prior", "above"),
    ("sensor.accelerometer.second_order.prior", "1000 ug", "sensor.accelerometer.second_order.prior", "ug/g^2"),
    ("sensor.accelerometer.scale_factor.rate", {}, "sensor.accelerometer.scale_factor.rate", "unknown"),
    ("sensor.frame", "the wall", "sensor.frame", "table axes"),
    ("sensor.frame", "case", "rig.table.mounting[0].accuracy", "above zero"),
    ("sensor.thermal_lag", "-5 s", "sensor.thermal_lag", "at least"),
    ("sensor.sample_clock_error", "5 s", "sensor.sample_clock_error", "scale factor"),
    # the rig
    ("rig.site", GONE, "rig.site.latitude", "missing"),
    ("rig.site.latitude", "unknown", "rig.site.latitude", "missing"),
    ("rig.site.latitude", "91 deg", "rig.site.latitude", "from -90 deg to 90 deg"),
    ("rig.site.latitude", GONE, "rig.site.latitude", "missing"),
    ("rig.site.gravity", "0 m/s^2", "rig.site.gravity", "above"),
    ("rig.site.gravity", "9.8 m/s", "rig.site.gravity", "acceleration"),
    ("rig.table", GONE, "rig.table", "missing"),
    ("rig.table.standing", "read often", "rig.table.standing", "held"),
    ("rig.table.drive", "hand", "plan.cycle.moves[1].shape", "by hand"),
    ("rig.table.drive", "horse", "rig.table.drive", "motor"),
    ("rig.table.tilt", "-100 urad", "rig.table.tilt", "at least"),
    ("rig.table.azimuth", 5, "rig.table.azimuth", "text with a unit"),
    ("rig.table.axis", [], "rig.table.axis", "at least 1"),
    ("rig.table.axis.0.direction", [0.0, 0.0, 0.0], "rig.table.axis[0].direction", "not a direction"),
    ("rig.table.axis.0.direction", [1.0, 0.0], "rig.table.axis[0].direction[2]", "missing"),
    ("rig.table.axis.0.direction", ["1", 0.0, 0.0], "rig.table.axis[0].direction[0]", "number"),
    ("rig.table.axis.1.name", "tilt", "rig.table.axis[1].name", "two axes have this name"),
    ("rig.table.axis.1.orthogonality", "100 urad", "rig.table.axis[1].orthogonality", "innermost"),
    ("rig.table.axis.0.max_rate", GONE, "rig.table.axis[0].max_rate", "missing"),
    ("rig.table.axis.0.max_rat", "1 deg/s", "rig.table.axis[0].max_rat", 'nearest: "max_rate"'),
    ("rig.table.axis.0.angle.harmonics", [{"order": 0, "amplitude": "5 arcsec"}], "rig.table.axis[0].angle.harmonics[0].order", "1"),
    ("rig.table.axis.0.angle.read_every", "0 s", "rig.table.axis[0].angle.read_every", "above"),
    ("rig.table.axis.0.travel", "60 deg", f"{_MOVES}[4]", "travel"),
    ("rig.table.mounting", {"x": "+x", "y": "+x", "z": "+z"}, "rig.table.mounting[0]", "right-handed"),
    ("rig.table.mounting", {"x": "+x", "y": "+z", "z": "+y"}, "rig.table.mounting[0]", "right-handed"),
    ("rig.table.mounting", {"x": "up"}, "rig.table.mounting[0].x", "+x"),
    ("rig.table.mounting", [{}, {}], "sensor.frame", "several mountings"),
    ("rig.table.mounting", [], "rig.table.mounting", "at least 1"),
    ("rig.chamber", GONE, "rig.chamber", "missing"),
    # requirements
    ("requirement.0.quantity", "gyro_scale", "requirement[0].quantity", "gyro_scale_factor"),
    ("requirement.0.quantity", GONE, "requirement[0].quantity", "missing"),
    ("requirement.0.rate", GONE, "requirement[0].rate", "missing"),
    ("requirement.0.rate", ["300 deg/s", "-300 deg/s"], "requirement[0].rate[1]", "larger than the entry"),
    ("requirement.1.temperature", ["70 degC", "-30 degC"], "requirement[1].temperature[1]", "larger than the entry"),
    ("requirement.1.axis", "w", "requirement[1].axis", "worst"),
    ("requirement.1.name", "gyro scale factor", "requirement[1].name", "two requirements"),
    ("requirement.2.relative_to", "moon", "requirement[2].relative_to", "internal"),
    ("requirement.2.target", "5 ppm", "requirement[2].target", "angle"),
    ("requirement.7.statistic", "mean of max", "requirement[7].statistic", "mean"),
    ("sensor.accelerometer.second_order", GONE, "requirement[7].quantity", "accelerometer.second_order"),
    ("sensor.gyro.g_sensitivity", GONE, "requirement[3].quantity", "gyro.g_sensitivity"),
    # the plan
    ("plan.method", "standard", "plan.integration", "missing"),
    ("plan.cycle.other_axes", {"duration": "1 min"}, "plan.cycle.other_axes", "standing"),
    ("plan.cycle.moves", [], _MOVES, "at least 1"),
    (f"{_MOVES}.1.axis", GONE, f"{_MOVES}[1].axis", "which axis turns"),
    (f"{_MOVES}.1.axis", "spni", f"{_MOVES}[1].axis", 'nearest: "spin"'),
    (f"{_MOVES}.0.pose", {"tlit": "0 deg"}, f"{_MOVES}[0].pose.tlit", 'nearest: "tilt"'),
    (f"{_MOVES}.0.pose", {"tilt": "0 s"}, f"{_MOVES}[0].pose.tilt", "angle"),
    (f"{_MOVES}.5", {"rest": "2 s"}, _MOVES, "must return"),
    (f"{_MOVES}.2.axis", "spin", f"{_MOVES}[2].axis", "this key is unknown"),
    (f"{_MOVES}.3.peak_rate", "400 deg/s", f"{_MOVES}[3].peak_rate", "exceeds max_rate"),
    (f"{_MOVES}.3", {"trun": "90 deg", "axis": "spin"}, f"{_MOVES}[3].trun", 'nearest: "turn"'),
    (f"{_MOVES}.3", {}, f"{_MOVES}[3]", "expected a rest"),
    (f"{_MOVES}.0.rest", "2 h", "plan.cycle", "longer than every part with used data"),
    ("plan.cycle.start", {"roll": "90 deg"}, "plan.cycle.start.roll", "no axis of this name"),
    ("plan.gradient", "9 K/min", "plan.gradient", "rig.chamber.max_heating"),
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


def test_the_unbroken_spec_is_sound_and_the_corpus_is_there():
    assert isinstance(spec_of(GOOD), Spec)
    assert len(BROKEN) >= 60


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


def leaves(value, key=()):
    """Every key of a document, tables and lists included."""
    found = [key] if key else []
    entries = value.items() if isinstance(value, dict) else enumerate(value) if isinstance(value, list) else ()
    for name, entry in entries:
        found += leaves(entry, (*key, name))
    return found


KEYS = leaves(GOOD)
JUNK = st.one_of(
    st.text(max_size=8),
    st.integers(-(10**30), 10**30),
    st.floats(),
    st.booleans(),
    st.just([]),
    st.just({}),
    st.lists(st.text(max_size=4), max_size=3),
    st.dictionaries(st.text(min_size=1, max_size=4), st.integers(-9, 9), max_size=2),
    st.sampled_from(["nan deg", "-1 deg", "0 s", "1e300 s", "1e-300 deg", "1 K", "1e9 s", "-5 degC", "1 deg/s", "∞"]),
    st.sampled_from(["1 ug", "1e15 m/s^2", "90 deg", "1e9 deg", "unlimited", "1 urad", "x", "all", "case", "read"]),
)


@settings(max_examples=150, deadline=None, suppress_health_check=[HealthCheck.too_slow])
@given(
    st.lists(
        st.tuples(st.integers(0, len(KEYS) - 1), st.sampled_from(["set", "delete", "swap", "double", "negate"]), JUNK),
        min_size=1,
        max_size=3,
    ),
    st.integers(0, len(KEYS) - 1),
)
def test_slips_give_a_spec_or_a_spec_error_and_nothing_else(slips, other):
    document = copy.deepcopy(GOOD)
    for index, kind, junk in slips:
        *path, last = KEYS[index]
        try:
            part = document
            for name in path:
                part = part[name]
            value = part[last]
        except (KeyError, IndexError, TypeError):
            continue
        if not isinstance(part, dict | list):
            continue
        if kind == "delete":
            del part[last]
        elif kind == "set":
            part[last] = copy.deepcopy(junk)
        elif kind == "double" and isinstance(part, list):
            part.append(copy.deepcopy(value))
        elif kind == "negate" and isinstance(value, str):
            part[last] = value[1:] if value.startswith("-") else "-" + value
        elif kind == "swap":
            try:
                chosen = document
                for name in KEYS[other]:
                    chosen = chosen[name]
                part[last] = copy.deepcopy(chosen)
            except (KeyError, IndexError, TypeError):
                continue
    try:
        spec = spec_of(document)
    except SpecError as error:
        said = [str(problem) for problem in error.problems]
    else:
        moves = spec.schedule.steps or spec.plan.cycle is None
        said = ["it is a spec"] if math.isfinite(spec.schedule.duration) and moves else []
    assert said
    assert all(len(sentence) > 10 for sentence in said)


def test_what_would_be_without_effect_is_refused():
    """A rest is one reading of every channel."""
    for keys in ({"read_every": "1 s"}, {"read_every": "none"}, {"other_axes": True}):
        document = copy.deepcopy(GOOD)
        document["plan"]["cycle"]["moves"].append({"rest": "5 s"} | keys)
        with pytest.raises(SpecError, match="leave this key out"):
            spec_of(document)


def test_a_cycle_of_several_stretches_returns():
    document = copy.deepcopy(GOOD)
    plan = {"method": "gradient", "programme": [{"soak": "10 min", "at": "20 degC", "used": True}]}
    plan["programme"] += [{"soak": "1 min"}, {"soak": "10 min", "used": True}]
    document["plan"] = plan | {"cycle": {"moves": [{"rest": "5 s"}, {"turn": "90 deg", "axis": "spin"}]}}
    with pytest.raises(SpecError, match="starts again in every part"):
        spec_of(document)
    document["plan"]["cycle"]["moves"].append({"turn": "-90 deg", "axis": "spin"})
    assert len(spec_of(document).schedule.stretches) == 2
