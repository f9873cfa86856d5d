"""What a run did before it was broken off, counted in the plan of its rest."""

import math

import pytest
from search_problem import SPEC

from gradcal_jax.design.optimise import known_so_far, replan, rest_of, with_done
from gradcal_jax.design.turn_plan import measure
from gradcal_jax.information.prediction import predict
from gradcal_jax.model.build import assemble
from gradcal_jax.spec import spec as spec_file
from gradcal_jax.spec.changes import changed, tables_of
from gradcal_jax.tables.problems import SpecError

SLOW = {
    "sensor.gyro.drift": [{"standard_deviation": "1 deg/h", "correlation_time": "40 min"}],
    "sensor.gyro.turn_on_bias": "5 deg/h",
    "sensor.gyro.rate_random_walk": "1 deg/h/sqrt(h)",
    "sensor.sample_clock_error": "20 ppm",
}


@pytest.fixture(scope="module")
def spec() -> spec_file.Spec:
    return spec_file.parse_spec(SPEC)


def left_by(spec: spec_file.Spec) -> float:
    value = predict(spec).requirements[0].mean_of_max
    assert value is not None
    return value


def test_two_halves_of_a_plan_are_worth_what_the_plan_is(spec):
    """A programme with a pause whose data are not used is one trajectory; its second half after its first is the same,
    whatever the noise remembers."""
    ramps = [{"ramp_to": "20 degC", "rate": "1 K/min"}, {"ramp_to": "70 degC", "rate": "1 K/min"}]
    soak = {"soak": "1 min", "at": "-30 degC", "used": False}
    programme = [soak, ramps[0], {"soak": "30 min", "used": False}, ramps[1]]
    keys = {"plan.temperature": None, "plan.gradient": None, "plan.programme": programme}
    whole = changed(spec, SLOW | keys)
    # Done: the first stretch, with one cycle of 900 s after another, to its end.
    done = {"plan": tables_of(whole)["plan"], "start": "60 s", "end": "3060 s", "pause": "30 min"}
    rest = changed(whole, {"done": [done], "plan.programme": [{**soak, "at": "20 degC"}, ramps[1]]})
    assert left_by(rest) == pytest.approx(left_by(whole), rel=1e-9)
    # And the memory counts: of noise that forgets, the pause may be of any length; of this it may not.
    longer = changed(rest, {"done": [{**done, "pause": "10 h"}]})
    assert left_by(longer) != pytest.approx(left_by(whole), rel=1e-6)
    # What the search minimises is the same number.
    of = measure(rest)
    assert of.exact(assemble(rest).schedule) == pytest.approx(left_by(rest), rel=1e-6)


def test_an_offset_of_the_standstill_is_drawn_anew_after_the_pause(spec):
    offset = changed(
        spec,
        {"rig.table.axis[0].angle.standstill_offset": "0.02 deg", "rig.table.axis[0].angle.reading_noise": "0.001 deg"},
    )
    half = with_done(offset, [(0.0, 1500.0)])
    without = changed(half, {"rig.table.axis[0].angle.standstill_offset": "0 deg"})
    assert left_by(half) > 2.0 * left_by(without)


def test_what_is_known_grows_from_nothing_to_what_was_predicted(spec):
    whole = left_by(spec)
    lasts_s = spec.schedule.duration
    found = [known_so_far(spec, [(0.0, end)], end)[0] for end in (60.0, 0.5 * lasts_s, lasts_s)]
    assert found[0].now is None
    assert found[1].now is not None
    assert found[1].now > 1.5 * whole
    assert [row.at_end for row in found] == pytest.approx([whole] * 3)
    assert found[2].now == pytest.approx(whole)
    (before,) = known_so_far(spec, [], 0.0)
    assert (before.now, before.at_end) == (None, pytest.approx(whole))
    # A step that is made again costs time, and tells more.
    (again,) = known_so_far(spec, [(0.0, 0.5 * lasts_s)], 0.0)
    assert again.at_end is not None
    assert again.at_end < 0.98 * whole


@pytest.mark.parametrize("end_s", [170.0, 1333.0, 2400.0])
def test_the_rest_fills_its_time_on_the_chambers_remaining_course(spec, end_s):
    rest = rest_of(spec, [(0.0, end_s)])
    schedule = rest.gradient_schedule
    assert schedule.segments[0].temperature_start == pytest.approx(-30.0 + end_s / 30.0, abs=0.05)
    assert schedule.segments[-1].temperature_end == pytest.approx(70.0, abs=0.11)
    assert schedule.duration == pytest.approx(3000.0 - end_s, abs=5.0)
    assert schedule.duration <= 3000.0 - end_s + 1.5
    assert schedule.stretches[0].leftover < 5.0
    assert rest.done[0].pause == 1800.0


def test_a_rest_that_is_too_short_for_the_chamber_goes_as_far_as_it_comes(spec):
    rest = rest_of(spec, [(0.0, 1500.0)], left_s=900.0)
    (ramp,) = rest.gradient_schedule.segments
    assert ramp.slope == pytest.approx(2.0 / 60.0)
    assert ramp.temperature_end == pytest.approx(20.0 + 30.0)
    assert ramp.duration == pytest.approx(900.0)


def test_what_cannot_be_planned_anew_is_refused(spec):
    with pytest.raises(ValueError, match="the ramp is complete"):
        rest_of(spec, [(0.0, 3000.0)])
    with pytest.raises(ValueError, match="there is no time for a ramp"):
        rest_of(spec, [(0.0, 1500.0)], left_s=1.0)
    programme = [
        {"soak": "1 min", "at": "-30 degC"},
        {"ramp_to": "20 degC", "rate": "2 K/min"},
        {"ramp_to": "-30 degC", "rate": "1.5 K/min"},
    ]
    there = changed(spec, {"plan.temperature": None, "plan.gradient": None, "plan.programme": programme})
    with pytest.raises(ValueError, match="not a single ramp"):
        rest_of(there, [(60.0, 600.0)])
    with pytest.raises(SpecError, match="expected a time after the start of this part"):
        with_done(spec, [(600.0, 500.0)])
    plan = tables_of(changed(spec, {"plan.cycle.moves[1].peak_rate": "300 deg/s"}))["plan"]
    done = {"plan": plan, "start": "0 s", "end": "900 s", "pause": "1 h"}
    slower = changed(spec, {"rig.table.axis[0].max_rate": "250 deg/s"})
    with pytest.raises(SpecError, match=r"done\[0\].plan"):
        changed(slower, {"done": [done]})


def test_the_rest_is_better_than_going_on_as_it_was(spec):
    """The first plan is far from the best: its rest, searched anew, makes up for much of it."""
    best = replan(spec, [(0.0, 1500.0)], quick=True)
    (as_it_was,) = known_so_far(spec, [(0.0, 1500.0)], 1500.0)
    assert as_it_was.at_end is not None
    assert best.now < 0.8 * as_it_was.at_end
    assert best.now == pytest.approx(left_by(best.spec), rel=1e-9)
    assert len(best.spec.done) == 1
    assert math.isfinite(best.optimum)
    # And once more: what was done of both counts.
    again = rest_of(best.spec, [(0.0, 600.0)])
    assert [float(part.end) for part in again.done] == [1500.0, 600.0]
    assert left_by(with_done(best.spec, [(0.0, best.spec.schedule.duration)])) < best.now
