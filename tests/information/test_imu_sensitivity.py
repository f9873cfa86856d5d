"""Sensitivities of a unit's plan: homogeneous in all sizes together, known limits, and the prediction itself."""

import functools
import math

import pytest

import gradcal_jax as gj
from gradcal_jax.information.sensitivity import RATES, TIME
from gradcal_jax.spec import presets
from gradcal_jax.spec.changes import tables_of

SIX = gj.parse_spec(presets.text("accelerometer-six-positions"))
BARE = {
    "sensor.accelerometer.drift": None, "sensor.accelerometer.second_order": None, "rig.table.tilt": None,
    "rig.table.azimuth": None, "rig.table.axis[0].orthogonality": None, "rig.table.axis[0].angle": None,
    "rig.table.axis[1].angle": None, "rig.site.gravity_accuracy": None,
    "requirement": tables_of(SIX)["requirement"][:3],
} | {f"sensor.accelerometer.{name}.prior": None for name in ("bias", "scale_factor", "misalignment")}  # fmt: skip


def by_figure(found, requirement):
    return {row.figure: row.percent for row in found.rows if row.requirement == requirement}


# Ferraris' gyros alone.
TURNS = gj.changed(
    gj.parse_spec(presets.text("ferraris")),
    {
        "sensor.accelerometer": None,
        "rig.site.gravity_accuracy": None,
        "requirement": tables_of(gj.parse_spec(presets.text("ferraris")))["requirement"][:3],
    },
)


@pytest.mark.parametrize("spec", [SIX, TURNS], ids=["accelerometers", "gyros"])
def test_all_sizes_one_per_cent_larger_leave_one_per_cent_more(spec):
    """Without priors, whose sizes would count, too."""
    sensor = tables_of(spec)["sensor"]
    flat = {f"sensor.{t}.{m}.prior": None for t, maps in sensor.items() for m, of in maps.items() if "prior" in of}
    found = gj.sensitivity(gj.changed(spec, flat))
    assert len(found.residuals) == len({row.requirement for row in found.rows})
    for requirement in found.residuals:
        figures = by_figure(found, requirement)
        sizes = [v for k, v in figures.items() if k not in (TIME, RATES) and "correlation time" not in k]
        assert math.fsum(sizes) == pytest.approx(1.0, abs=1e-5)
        assert all(value > -1e-6 for value in sizes)


def test_white_noise_falls_with_the_root_of_time_and_turns_do_not_matter_to_it():
    bare = gj.changed(SIX, BARE)
    found = gj.sensitivity(bare)
    for requirement in ("accelerometer bias", "accelerometer scale factor"):
        figures = by_figure(found, requirement)
        assert set(figures) == {"velocity random walk", TIME, RATES}
        assert figures["velocity random walk"] == pytest.approx(1.0, abs=1e-5)
        assert figures[TIME] == pytest.approx(-0.5, abs=1e-5)
        # The last face is held for what the turns leave.
        assert abs(figures[RATES]) < 0.01


@pytest.mark.parametrize(
    ("figure", "key"),
    [
        ("accelerometer bias instability", "sensor.accelerometer.drift[0].standard_deviation"),
        ("velocity random walk", "sensor.accelerometer.velocity_random_walk"),
        ("gravity", "rig.site.gravity_accuracy"),
        ("tilt of the base", "rig.table.tilt"),
        ("correlation time: accelerometer bias instability", "sensor.accelerometer.drift[0].correlation_time"),
    ],
)
def test_the_share_of_an_error_is_the_slope_of_the_prediction_in_its_size(figure, key):
    found = gj.sensitivity(SIX)
    names = key.replace("[", ".").replace("]", "").split(".")
    value, unit = str(functools.reduce(_member, names, SIX)).split(" ", 1)
    low, high = (gj.predict(gj.changed(SIX, {key: f"{float(value) * f:.12g} {unit}"})) for f in (0.999, 1.001))
    for a, b in zip(low.requirements, high.requirements, strict=True):
        slope = math.log(b.decisive / a.decisive) / math.log(1.001 / 0.999)
        assert by_figure(found, a.name).get(figure, 0.0) == pytest.approx(slope, abs=1e-5)
        assert found.residuals[a.name][0] == pytest.approx(math.sqrt(a.decisive * b.decisive), rel=1e-3)


def _member(of, name):
    return of[int(name)] if name.isdigit() else getattr(of, name)


def test_what_cannot_be_observed_or_is_not_required_is_said():
    flat = {f"sensor.accelerometer.{name}.prior": None for name in ("bias", "scale_factor", "misalignment")}
    blind = gj.changed(SIX, flat | {"plan.cycle.moves": [{"rest": "60 s"}]})
    with pytest.raises(ValueError, match="cannot observe accelerometer bias, accelerometer scale factor"):
        gj.sensitivity(blind)
    with pytest.raises(ValueError, match=r"no \[\[requirement\]\]"):
        gj.sensitivity(gj.changed(SIX, {"requirement": None}))
