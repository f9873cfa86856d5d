"""What a spec leaves out is listed with what is typical of its class, and no term twice, none that is named."""

import numpy as np
import pytest

import gradcal_jax as gj
from gradcal_jax.spec.absent import absent_terms, class_terms, with_typical
from gradcal_jax.spec.begin import PRESETS, files_of
from gradcal_jax.spec.changes import tables_of
from gradcal_jax.spec.spec import spec_of
from gradcal_jax.spec.typical import EARTH, sensor_grade, table_grade, terms_of


def preset(name):
    return gj.parse_spec(gj.presets.text(name))


BARE = preset("consumer-mems")


def spec_without(*keys):
    return gj.changed(BARE, dict.fromkeys(keys))


def keys(spec):
    return [term.key for term in absent_terms(spec)]


def test_every_term_that_is_taken_out_is_listed_and_every_one_that_is_named_is_not():
    whole = keys(BARE)
    for key in (
        "sensor.sample_clock_error", "sensor.thermal_lag", "sensor.gyro.drift",
        "rig.table.axis[0].angle.standstill_offset",
    ):  # fmt: skip
        assert key not in whole
        assert set(keys(spec_without(key))) == {*whole, key}


def test_zero_and_an_empty_list_are_named_terms():
    spec = gj.changed(BARE, {"sensor.sample_clock_error": "0 ppm", "sensor.gyro.drift": []})
    assert not {"sensor.sample_clock_error", "sensor.gyro.drift"} & set(keys(spec))


def within(named, full):
    """Whether every value of a table is in another, as it is."""
    if not isinstance(named, dict):
        return named == full
    return all(name in full and within(value, full[name]) for name, value in named.items())


def paper_without_zeros(name):
    """A preset of the paper as if it did not say that what it leaves out is zero."""
    tables = tables_of(preset(name))
    sensor, rig = tables["sensor"], tables["rig"]
    for key in [
        t.key for kind in ("sensor", "table") for t in terms_of(kind, "tactical" if kind == "sensor" else "fine")
    ]:
        table, (axis,) = rig["table"], rig["table"]["axis"]
        for part in (sensor, sensor["gyro"], table, axis, axis.get("angle", {}), *table["mounting"]):
            name = "accuracy" if key == "mounting_accuracy" else key.removeprefix("angle.")
            value = part.get(name)
            if value in ([], {"standard_deviation": "0 K"}) or str(value).startswith("0 "):
                del part[name]
    del rig["site"]
    return spec_of(tables)


def test_terms_that_the_plan_cannot_feel_are_not_listed():
    named = set(keys(paper_without_zeros("paper-static-standard"))) - {EARTH}
    assert not any("scale" in key or "clock" in key or "lag" in key or "rig" in key for key in named)
    assert {"sensor.gyro.turn_on_bias", "sensor.temperature_offset"} <= named
    dynamic = paper_without_zeros("paper-dynamic-gradient")
    turning = keys(dynamic)
    of_table = {"rig.table.axis[0].angle.standstill_offset", "rig.table.mounting[0].accuracy"}
    assert {*of_table, "sensor.temperature_lag"} <= set(turning)
    assert "rig.table.rate_accuracy" not in turning
    # Without B(T) a thermometer's error acts through the slope of M alone.
    (error,) = (t for t in absent_terms(dynamic) if "ture_e" in t.key)
    assert set(error.value) == {"standard_deviation", "correlation_time", "scale_factor_slope"}


@pytest.mark.parametrize("name", [n for n in gj.presets.names() if n.startswith("paper")])
def test_the_paper_s_presets_have_exactly_the_paper_s_terms(name):
    assert keys(preset(name)) == []


@pytest.mark.parametrize(
    "name", [n for n in gj.presets.names() if n.startswith(("rig", "tactical", "consumer", "two", "one"))]
)
def test_presets_of_a_class_are_counted_not_zeroed(name):
    left_out = keys(preset(name))
    assert any(key.endswith(("mounting[0].accuracy", "scale_error")) for key in left_out)
    assert "sensor.temperature_offset" in left_out


@pytest.mark.parametrize("name", gj.presets.names())
def test_with_typical_figures_nothing_is_absent_and_nothing_that_was_named_changes(name):
    full = with_typical(preset(name))
    assert absent_terms(full) == []
    assert within(tables_of(preset(name))["sensor"], tables_of(full)["sensor"])


def test_the_grade_is_said_or_follows_the_drift_then_the_random_walk():
    assert sensor_grade(BARE.sensor)[::2] == ("consumer", "its drift")
    assert sensor_grade(spec_without("sensor.gyro.drift").sensor)[::2] == ("consumer", "its angle random walk")
    fine = gj.changed(BARE, {"sensor.gyro.drift": None, "sensor.gyro.angle_random_walk": "0.001 deg/sqrt(h)"})
    assert sensor_grade(fine.sensor).name == "navigation"
    assert sensor_grade(gj.changed(fine, {"sensor.grade": "tactical"}).sensor)[::2] == ("tactical", "sensor.grade")
    arcsec = {
        "rig.table.axis[0].angle.reading_noise": "1 arcsec",
        "rig.table.axis[0].angle.standstill_offset": "20 arcsec",
    }
    assert (table_grade(BARE).name, table_grade(gj.changed(BARE, arcsec)).name) == ("coarse", "middle")


def test_no_verdict_rests_on_what_a_spec_leaves_out():
    """The specs of the repro folder in small: within the target as written, missed with what its class has."""
    bare = spec_without(
        "sensor.sample_clock_error",
        "sensor.gyro.scale_factor_instability",
        "sensor.gyro.temperature_error",
        "sensor.thermal_lag",
    )
    bare = gj.changed(bare, {"requirement[0].target": "200 ppm"})
    row = gj.predict(bare).requirements[0]
    assert row.verdict == "missed"
    assert row.with_typical > 200.0 > row.mean_of_max
    assert row.with_typical == gj.predict(with_typical(bare)).requirements[0].mean_of_max
    assert {t.key for t in gj.predict(bare).omitted} == set(keys(bare))


def written_out(spec):
    """The spec with every figure of its classes in the file, and without the classes (but for accelerometers, whose
    slopes over temperature are those of the class)."""
    tables = tables_of(spec)
    for name in ("sensor", "rig"):
        tables[name] = getattr(spec, name).model_dump(mode="json", exclude_none=True)
    del tables["rig"]["table"]["grade"]
    if spec.sensor.accelerometer is None:
        del tables["sensor"]["grade"]
    return spec_of(tables)


@pytest.mark.parametrize("preset", ["drone-gyro", "bmi088", "tactical-imu"])
def test_a_spec_of_stated_classes_predicts_as_one_with_every_figure_written_out(preset):
    spec = gj.parse_spec(files_of(PRESETS[preset])["spec.toml"])
    assert absent_terms(spec) == []
    whole = written_out(spec)
    assert class_terms(whole) == []
    assert {term.key for term in class_terms(spec)} & {"sensor.gyro.drift", "rig.table.axis[0].angle.reading_noise"}
    short, long = gj.predict(spec), gj.predict(whole)
    assert len(short.covariance) == len(long.covariance)
    np.testing.assert_allclose(np.array(short.covariance, float), np.array(long.covariance, float), rtol=1e-12)
    for row, other in zip(short.requirements, long.requirements, strict=True):
        assert (row.verdict, row.with_typical) == (other.verdict, other.with_typical)
        assert (row.mean, row.max) == pytest.approx((other.mean, other.max), rel=1e-12)


def test_a_class_supplies_what_the_file_does_not_name_and_is_not_written_into_it():
    spec = gj.parse_spec(files_of(PRESETS["drone-gyro"])["spec.toml"])
    assert str(spec.sensor.gyro.turn_on_bias) == "0.1 deg/s"
    assert "turn_on_bias" not in tables_of(spec)["sensor"]["gyro"]
    own = gj.changed(spec, {"sensor.gyro.turn_on_bias": "0 deg/s", "rig.table.axis[0].angle.scale_error": "5 ppm"})
    assert own.sensor.gyro.turn_on_bias == 0.0
    assert str(own.rig.table.axis[0].angle.scale_error) == "5 ppm"
    assert "sensor.gyro.turn_on_bias" not in {term.key for term in class_terms(own)}
    assert str(gj.changed(spec, {"sensor.grade": "tactical"}).sensor.gyro.turn_on_bias) == "10 deg/h"
    bare = gj.changed(spec, {"sensor.grade": None})
    assert bare.sensor.gyro.turn_on_bias is None
    assert "sensor.gyro.turn_on_bias" in keys(bare)
