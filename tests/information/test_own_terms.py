"""A general error term, by its factors or by a class from outside the package: in predictions and in estimates."""

import jax.numpy as jnp
import numpy as np
import pytest
from simulated_log import simulate_log

import gradcal_jax as gj
from gradcal_jax.model import OwnTerm, constant_function
from gradcal_jax.spec.changes import tables_of

DEG_PER_H = np.radians(1.0) / 3600.0
SMALL = {
    "plan.temperature": ["20 degC", "40 degC"],
    "sensor.gyro.scale_factor.temperature.degree": 1,
    "sensor.gyro.scale_factor.prior": "1000 ppm",
}


class SlopeTimesRate(OwnTerm):
    """A scale factor by dT/dt, of a gyro along x."""

    def values(self, nodes):
        return nodes.slope[..., None], nodes.signal("rate x")[..., None]


class FallingOff(OwnTerm):
    """A bias that decays over the run."""

    def values(self, nodes):
        return jnp.exp(-nodes.time / 900.0)[..., None], constant_function(nodes.weight)


@pytest.fixture(scope="module")
def axis():
    return gj.changed(gj.parse_spec(gj.presets.text("paper-dynamic-gradient")), SMALL)


def with_term(spec, **term):
    return gj.changed(spec, {"sensor.gyro.term": [term]})


def test_factors_are_the_class_that_multiplies_them(axis):
    """The unit of a prior is that of the target over those of the factors."""
    left = {
        name: gj.predict(with_term(axis, name=name, **of)).requirements[0].mean_of_max
        for name, of in {
            "k": {"target": "scale_factor", "factors": ["dT/dt"], "prior": "50 ppm/(K/min)"},
            "kr": {"factors": ["rate x", "dT/dt"], "prior": "0.003 deg/s/(deg/s)/(K/s)"},
            "class": {"class_name": "SlopeTimesRate", "prior": "0.003 rad/s"},
        }.items()
    }
    assert left["kr"] == pytest.approx(left["k"], rel=1e-9)
    assert left["class"] == pytest.approx(left["k"], rel=1e-9)
    assert abs(left["k"] / gj.predict(axis).requirements[0].mean_of_max - 1.0) > 1e-3


def test_force_as_a_factor_is_the_sensitivity_to_it():
    whole = gj.parse_spec(gj.presets.text("ferraris"))
    of_bias = [r for r in tables_of(whole)["requirement"] if r["quantity"] == "gyro_bias"]
    spec = gj.changed(whole, {"requirement": of_bias, "sensor.gyro.g_sensitivity": None})
    terms = [{"name": f"g_{a}", "factors": [f"force {a}"], "prior": "50 deg/h/g"} for a in "xyz"]
    left = gj.predict(gj.changed(spec, {"sensor.gyro.g_sensitivity": {"prior": "50 deg/h/g"}}))
    right = gj.predict(gj.changed(spec, {"sensor.gyro.term": terms}))
    for row, same in zip(left.requirements, right.requirements, strict=True):
        assert same.judged == pytest.approx(row.judged, rel=1e-6)


def test_an_estimate_finds_its_parameter(axis):
    spec = with_term(axis, name="decay", class_name="FallingOff", prior="400000 deg/h")
    made = simulate_log(axis, sample_rate_hz=10.0).log
    hidden = 30.0 * DEG_PER_H
    wrong = made.rate_rad_per_s + hidden * np.exp(-(made.time_s - made.time_s[0]) / 900.0)[None, :, None]
    log = gj.log_from(
        made.time_s, wrong[0, :, 0], temperature=made.temperature_c[0], angle={"x": made.table_angle_rad[:, 0]},
        standstill=made.standstill, simulated=True,
    )  # fmt: skip
    (calibration,) = gj.estimate(spec, log).calibrations
    (found,) = calibration.path
    assert (found.name, found.unit, found.own) == ("decay", "rad/s", True)
    assert found.standard_deviation < 0.2 * hidden
    assert found.value == pytest.approx(hidden, abs=4.0 * found.standard_deviation)
    # Of the unit of a sensitivity to dT/dt, or any other: nobody but the class knows its function.
    like_slope = found.model_copy(update={"unit": "rad/K", "value": 1.0})
    corrected = [gj.apply(calibration.model_copy(update={"path": path}), log) for path in ((), (found,), (like_slope,))]
    assert [one.left_in for one in corrected] == [(), ("gyro_x.decay",), ("gyro_x.decay",)]
    for one in corrected[1:]:
        np.testing.assert_array_equal(one.log.rate_rad_per_s, corrected[0].log.rate_rad_per_s)
    (note,) = (note for note in gj.export(calibration, "csv").notes if "decay" in note)
    assert note.endswith(": the target has no place for it")


@pytest.mark.parametrize(
    ("term", "says"),
    [
        ({"factors": ["rate w"], "prior": "1 deg/h"}, "factors"),
        ({"prior": "1 deg/h"}, "give either"),
        ({"factors": ["dT/dt"], "prior": "5 ppm/(K/min)"}, "its SI unit must be rad/K"),
        ({"factors": ["dT/dt"], "prior": "0 deg/h/(K/min)"}, "must be positive"),
        ({"factors": ["T2 - T"], "prior": "1 deg/h/K"}, "factors"),
    ],
)
def test_a_term_without_meaning_is_refused(axis, term, says):
    with pytest.raises(gj.SpecError, match=says):
        with_term(axis, name="term", **term)


@pytest.mark.parametrize("name", ["Nowhere", "Hysteresis", "ProductTerm"])
def test_a_class_that_nobody_defined_is_a_sentence(axis, name):
    spec = with_term(axis, name="term", class_name=name, prior="1 deg/h")
    with pytest.raises(ValueError, match=rf'gradcal_jax\.model\.OwnTerm has no subclass "{name}"'):
        gj.predict(spec)
