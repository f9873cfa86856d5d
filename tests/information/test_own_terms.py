"""A class from outside the package is a term as those within are: in predictions and in estimates."""

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
    """What `scale_factor_temperature_gradient` of a gyro along x is."""

    SI_UNIT = "s/K"

    def values(self, nodes):
        return nodes.slope[..., None], nodes.signal("rate x")[..., None]


class Tumble(OwnTerm):
    """What `g_sensitivity` is, all three at once."""

    @property
    def size(self):
        return 3

    def values(self, nodes):
        return constant_function(nodes.temperature), jnp.stack([nodes.signal(f"force {a}") for a in "xyz"], axis=-1)


class FallingOff(OwnTerm):
    """A bias that decays over the run."""

    def values(self, nodes):
        return jnp.exp(-nodes.time / 900.0)[..., None], constant_function(nodes.weight)


@pytest.fixture(scope="module")
def axis():
    return gj.changed(gj.parse_spec(gj.presets.text("paper-dynamic-gradient")), SMALL)


def test_a_term_of_one_s_own_predicts_as_the_same_within_the_package(axis):
    built_in = gj.predict(
        gj.changed(axis, {"sensor.gyro.scale_factor_temperature_gradient": {"prior": "50 ppm/(K/min)"}})
    )
    own = gj.predict(gj.changed(axis, {"sensor.gyro.own": [{"term": "SlopeTimesRate", "prior": 50e-6 * 60.0}]}))
    alone = gj.predict(axis)
    for known, ours, without in zip(built_in.requirements, own.requirements, alone.requirements, strict=True):
        assert ours.mean_of_max == pytest.approx(known.mean_of_max, rel=1e-6)
        assert abs(ours.mean_of_max / without.mean_of_max - 1.0) > 1e-3
    assert [p.name for p in own.parameters if "Slope" in p.name] == ["gyro_x.SlopeTimesRate"]


def test_signals_of_the_body_are_those_of_the_terms_within():
    whole = gj.parse_spec(gj.presets.text("ferraris"))
    spec = gj.changed(
        whole, {"requirement": [r for r in tables_of(whole)["requirement"] if r["quantity"] == "gyro_bias"]}
    )
    known = gj.changed(spec, {"sensor.gyro.g_sensitivity": {"prior": "50 deg/h/g"}})
    # One standard deviation of each coefficient, in rad/s for each m/s².
    prior = 50.0 * DEG_PER_H / 9.80665
    own = gj.changed(spec, {"sensor.gyro.g_sensitivity": None, "sensor.gyro.own": [{"term": "Tumble", "prior": prior}]})
    left, right = gj.predict(known), gj.predict(own)
    of = {row.name: row for row in left.requirements}
    both = [row for row in right.requirements if row.name in of]
    assert both
    for row in both:
        assert row.judged == pytest.approx(of[row.name].judged, rel=1e-6)


def test_an_estimate_finds_its_parameter(axis):
    spec = gj.changed(axis, {"sensor.gyro.own": [{"term": "FallingOff", "prior": 2.0, "name": "decay"}]})
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
    assert note.endswith("a term of your own, is lost")


def test_a_product_of_factors_is_a_term(axis):
    """As the class above."""
    by_class = gj.predict(gj.changed(axis, {"sensor.gyro.own": [{"term": "SlopeTimesRate", "prior": 50e-6 * 60.0}]}))
    product = {"factors": ["rate x", "dT/dt"], "prior": 50e-6 * 60.0}
    ours = gj.predict(gj.changed(axis, {"sensor.gyro.own": [product]}))
    assert ours.requirements[0].mean_of_max == pytest.approx(by_class.requirements[0].mean_of_max, rel=1e-12)
    with pytest.raises(gj.SpecError, match="factors"):
        gj.changed(axis, {"sensor.gyro.own": [{"factors": ["rate w"], "prior": 1.0}]})
    with pytest.raises(gj.SpecError, match="give either"):
        gj.changed(axis, {"sensor.gyro.own": [{"prior": 1.0}]})


def test_a_class_that_nobody_defined_is_a_sentence(axis):
    spec = gj.changed(axis, {"sensor.gyro.own": [{"term": "Nowhere", "prior": 1.0}]})
    with pytest.raises(ValueError, match=r'gradcal_jax\.model\.OwnTerm has no subclass "Nowhere"'):
        gj.predict(spec)
