"""Plans in a layout with room to spare are the plans themselves."""

import dataclasses

import jax
import numpy as np
import pytest
from gradcal_jax.jobs.batch import informations, timeline
from gradcal_jax.jobs.layout import filled, plans_of
from gradcal_jax.jobs.room import Counts, Layout, room_for, rounded_up, sizes
from jobs_small import SPEC

from gradcal_jax.api import assemble, knowledge
from gradcal_jax.api.posterior_of_plan import UNIT_OF
from gradcal_jax.files import changed, parse_spec, presets
from gradcal_jax.information import STATISTICS, posterior, residual, statistic
from gradcal_jax.jobs import results
from gradcal_jax.jobs.evaluate import model_of, residual_values, structure

GAP = {
    "plan.temperature": None,
    "plan.gradient": None,
    "plan.programme": [
        {"soak": "1 min", "at": "0 degC"},
        {"ramp_to": "10 degC", "rate": "2 K/min"},
        {"soak": "2 min"},
        {"ramp_to": "20 degC", "rate": "2 K/min"},
    ],
}


def roomy(counts):
    more = lambda values, by: tuple(v + by for v in values)  # noqa: E731
    return Counts(more(counts.own, 1), more(counts.after, 2), more(counts.whole, 3), more(counts.tail, 4))


@pytest.mark.parametrize(
    "changes",
    [{}, GAP, {"sensor.thermal_lag": "1 min", "plan.cycle.duration": "1 min", "plan.soak": {"duration": "5 min"}}],
    ids=["ramp", "two stretches", "lag and idle time"],
)
def test_room_to_spare_changes_nothing(changes):
    spec = changed(parse_spec(SPEC), changes)
    (plan,) = plans_of(spec)
    (found,) = informations(Layout(plan.kind, roomy(plan.counts)), [plan], [model_of(spec)[0]])
    expected = knowledge(assemble(spec))
    here, there = posterior(found), expected
    np.testing.assert_allclose(here.covariance(np.eye(6)), there.covariance(np.eye(6)), rtol=1e-9, atol=1e-24)


@pytest.mark.parametrize("preset", ["paper-dynamic-gradient", "paper-static-gradient", "rig-hand"])
def test_a_layout_of_its_own_size_is_the_plan_s_timeline(preset):
    spec = parse_spec(presets.text(preset))
    plans = plans_of(spec)
    built = assemble(spec)
    assert tuple(plan.kind.channel for plan in plans) == built.channels
    for plan in plans:
        layout = Layout(plan.kind, plan.counts)
        arrays = jax.tree.map(np.asarray, filled(plan, layout))
        found = timeline(layout, {name: jax.numpy.asarray(value) for name, value in arrays.items()})
        expected = built.plan.timeline(plan.kind.channel, built.thermal_lag)
        for field in dataclasses.fields(expected):
            one, other = getattr(found, field.name), getattr(expected, field.name)
            if field.name in ("segment", "segment_moves"):
                continue
            if isinstance(other, jax.Array):
                np.testing.assert_allclose(one, other, rtol=1e-9, atol=1e-9, err_msg=field.name)
            else:
                assert one == other, field.name


def test_a_plan_whose_slope_changes_between_readings_has_no_layout():
    spec = changed(parse_spec(SPEC), {"plan.soak": {"duration": "1 min", "used": True}})
    assert plans_of(spec) is None
    assert plans_of(parse_spec(presets.text("paper-static-standard"))) is None


def test_sizes_are_few_and_never_too_small():
    found = [rounded_up(n) for n in range(1000)]
    assert all(n <= r <= 1.5 * n for n, r in enumerate(found) if n)
    assert len(set(found)) < 22
    one, other = (Counts((n, 3), (8,), (n,), (n,)) for n in (9, 11))
    assert sizes(one) == sizes(other)
    assert room_for([one, other]) == other


def test_structure_is_what_numbers_do_not_change():
    spec = parse_spec(SPEC)
    same = changed(spec, {"sensor.drift[0].standard_deviation": "2 deg/h", "rig.table.angle.reading_noise": "1 arcmin"})
    assert structure(same) == structure(spec)
    for other in (
        {"rig.table.angle.standstill_offset": "0 deg"},
        {"sensor.scale_factor.rate.degree": 2},
        {"sensor.scale_factor.rate.scale": "90 deg/s"},
        {"sensor.bias.prior": "100 deg/h"},
    ):
        assert structure(changed(spec, other)) != structure(spec)


def test_the_residual_by_small_tables_is_the_residual():
    spec = parse_spec(SPEC)
    built = assemble(spec)
    known = knowledge(built)
    for requirement in spec.requirement:
        low, high = (float(t) for t in requirement.temperature)
        rates = np.linspace(-1, 1, 9) * np.deg2rad(100.0) if requirement.quantity == "scale_factor" else np.zeros(1)
        expected = residual(known, built.model, requirement.quantity, np.linspace(low, high, 11), rates)
        found = residual_values(known, built.model, requirement)
        np.testing.assert_allclose(found, expected, rtol=1e-10)
        assert statistic("max", found) == pytest.approx(statistic("max", expected), rel=1e-10)
    assert results.STATISTICS == STATISTICS
    assert {quantity: unit for quantity, (unit, _) in UNIT_OF.items()} == results.UNIT_OF
