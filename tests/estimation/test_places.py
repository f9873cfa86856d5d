"""Places of a fixture: the spec of the IMU at one, predictions of all, and one motion for all."""

import tomllib

import numpy as np
import pytest
from scipy.linalg import expm

import gradcal_jax as gj
from gradcal_jax.design.cycle_plan import CyclePlan
from gradcal_jax.information.plan_information import imu_posterior
from gradcal_jax.information.residual import residual_map
from gradcal_jax.model.build import build_imu
from gradcal_jax.motion.plan_motion import geometry
from gradcal_jax.spec import presets
from gradcal_jax.spec.bench import Place
from gradcal_jax.spec.changes import tables_of
from gradcal_jax.spec.places import places_of, rotation_of, specs_at_places
from gradcal_jax.spec.requirement import QUANTITIES
from gradcal_jax.spec.spec import spec_of


def fixture(places, preset="ferraris", **table):
    tables = tomllib.loads(presets.text(preset))
    tables["rig"]["table"] |= {"place": places, **table}
    return spec_of(tables)


def turned(held):
    """The rotation that a table of a mounting or a place says, by the series of the exponential: a body axis named x
    points along the word of x, after the further rotation."""
    words = {"x": "+x", "y": "+y", "z": "+z"} | held
    units = {f"{sign}{a}": s * np.eye(3)[k] for k, a in enumerate("xyz") for sign, s in (("+", 1.0), ("-", -1.0))}
    named = np.stack([units[words[a]] for a in "xyz"], axis=1)
    x, y, z = np.radians([float(angle.split()[0]) for angle in held.get("rotation", ["0 deg"] * 3)])
    return named @ expm(np.array([[0.0, -z, y], [z, 0.0, -x], [-y, x, 0.0]]))


def test_body_to_fixture_to_axis():
    """A vector of the body is turned by the place and then by the fixture's mounting."""
    place = {"x": "-z", "z": "+x", "rotation": ["3 deg", "-20 deg", "100 deg"]}
    hung = {"x": "+z", "y": "+x", "z": "+y", "rotation": ["0 deg", "30 deg", "5 deg"]}
    spec = fixture([{"name": "a", **place}], mounting=[hung])
    (at,) = specs_at_places(spec).values()
    vector = np.array([0.3, -0.5, 0.8])
    expected = turned(hung) @ (turned(place) @ vector)
    assert rotation_of(Place(name="a", **place)) @ vector == pytest.approx(turned(place) @ vector, abs=1e-12)
    assert geometry(at.rig).mountings[0] @ vector == pytest.approx(expected, abs=1e-9)
    assert at.rig.table.place == ()


def test_the_prediction_is_of_every_place_and_of_the_worst():
    """A place that hangs as a spec without places has that spec's values."""
    up = {"x": "+x", "y": "+z", "z": "-y"}
    found = gj.predict(
        fixture(
            [{"name": "flat"}, {"name": "up", **up}, {"name": "slant", "rotation": ["53.13 deg", "0 deg", "0 deg"]}]
        )
    )
    values = {place.name: place.values for place in found.places}
    for name, mounting in (("flat", {}), ("up", up)):
        alone = gj.predict(hung(mounting))
        assert values[name] == pytest.approx({row.name: row.judged for row in alone.requirements}, rel=1e-9)
    assert len({round(v["accelerometer scale factor"], 6) for v in values.values()}) > 1
    targets = {row.name: row.target for row in found.requirements}
    assert values[found.place] == pytest.approx({row.name: row.judged for row in found.requirements})
    excess = {n: max(v[r] / targets[r] for r in v) for n, v in values.items()}
    assert excess[found.place] == pytest.approx(max(excess.values()))


def hung(mounting):
    tables = tomllib.loads(presets.text("ferraris"))
    tables["rig"]["table"]["mounting"] = mounting
    return spec_of(tables)


def test_imus_sit_at_the_places_of_their_names_or_in_order():
    spec = fixture([{"name": "a"}, {"name": "b"}])
    assert places_of(spec, ["b", "a"]) == {"b": "b", "a": "a"}
    assert places_of(spec, ["17", "18"]) == {"17": "a", "18": "b"}
    with pytest.raises(ValueError, match="a is the name of a place, but 17 is not"):
        places_of(spec, ["a", "17"])
    with pytest.raises(ValueError, match=r"the log has 3 IMUs, and the spec has 2 places"):
        places_of(spec, ["1", "2", "3"])


def test_what_is_no_place_is_refused():
    for places, words in (
        ([{"name": "a", "x": "+x", "y": "+x"}], "three different ones"),
        ([{"name": "a"}, {"name": "a"}], "two places have this name"),
    ):
        with pytest.raises(gj.SpecError, match=words):
            fixture(places)


def test_what_is_of_one_imu_refuses_a_fixture():
    with pytest.raises(ValueError, match="the spec has a fixture of several IMUs"):
        build_imu(fixture([{"name": "a"}]))


PLACES = [
    {"name": "one"},
    {"name": "another"},
    {"name": "slant", "rotation": ["53.13010235415598 deg", "0 deg", "0 deg"]},
]


def test_a_search_serves_all_places():
    """The value of a plan is the mean over places, each for an IMU alone."""
    spec = fixture(PLACES, "accelerometer-six-positions-toured")
    spec = spec_of(tables_of(spec) | {"design": {"minimise": "all requirements"}})
    logs = []
    for at in specs_at_places(spec).values():
        built = build_imu(at)
        known = imu_posterior(built)
        left = [
            residual_map(built, known, r).statistic() / float(r.target) / QUANTITIES[r.quantity].factor
            for r in spec.requirement
        ]
        logs.append(np.mean(np.log(left)))
    plan = CyclePlan(spec)
    assert plan.exact.value_of(plan.exact.left(spec)) == pytest.approx(np.mean(logs), abs=1e-7)


def test_a_place_that_the_table_does_not_have_is_refused():
    spec = fixture([{"name": "a"}, {"name": "b", "x": "+y", "y": "-x"}])
    assert gj.predict(spec, place="b").place == "b"
    with pytest.raises(ValueError, match="no place 'c'; known: a, b"):
        gj.predict(spec, place="c")
