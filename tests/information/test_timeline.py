"""The timeline contract: every reading that `check` counts, where the angle's origin is, what is used and turned."""

import copy
import tomllib

import numpy as np
import pytest

from gradcal_jax.hardware.track import track_of
from gradcal_jax.information.prediction import make_recipe, predict
from gradcal_jax.information.timeline import timeline
from gradcal_jax.spec import presets
from gradcal_jax.spec.motion_plan import row_count
from gradcal_jax.spec.spec import spec_of

TABLES = tomllib.loads(presets.text("paper-dynamic-gradient"))
TABLES["requirement"][0]["grid"] = [5, 5]
del TABLES["requirement"][1]
TABLES["sensor"]["gyro"]["scale_factor"]["prior"] = "10000 ppm"
TURN = {"turn": "360 deg", "duration": "10 s", "shape": "linear ramps"}


def spec_with(rests, turns=({},), **plan):
    """A small plan whose rests of 6 s and turns have the given keys; a rest without any is read at its end."""
    tables = copy.deepcopy(TABLES)
    every = next((rest["read_every"] for rest in rests if "read_every" in rest), "rest")
    tables["rig"]["table"]["axis"][0]["angle"]["read_every"] = every
    rests = [rest if {"read", "read_every"} & set(rest) else {**rest, "read": "end"} for rest in rests]
    moves = []
    for k, (rest, turn) in enumerate(zip(rests, [*turns] * len(rests), strict=False)):
        moves += [{"rest": "6 s", **rest}, {**TURN, "turn": f"{(-1) ** k * 360} deg", **turn}]
    tables["plan"] = {"method": "gradient", "temperature": ["-20 degC", "20 degC"], "gradient": "9 K/min"} | plan
    tables["plan"]["cycle"] = {"moves": moves}
    tables["rig"]["chamber"] |= {"max_heating": "10 K/min", "max_cooling": "10 K/min"}
    return spec_of(tables)


@pytest.mark.parametrize(
    ("rests", "turns"),
    [
        (({},), ({},)),
        (({"read": "end"}, {"read": "none"}), ({"read": "end"},)),
        (({"read_every": "2 s"}, {}), ({"read": "none"}, {"read_every": "3 s"})),
        (({"read": "end", "repeat": 2}, {"read_every": "7 s"}), ({},)),
    ],
)
def test_every_reading_that_is_counted_is_in_the_timeline(rests, turns):
    spec = spec_with(rests, turns)
    written, schedule = timeline(spec), spec.gradient_schedule
    count = row_count(schedule, spec.rig.table)
    assert len(written.readings) == count

    def readings(move, lasts):
        if move.get("read") == "none":
            return 0
        return int(lasts // float(move["read_every"].split()[0])) if "read_every" in move else 1

    pairs = [(rest, turns[k % len(turns)]) for k, rest in enumerate(rests)]
    own = sum(rest.get("repeat", 1) * readings(rest, 6.0) + readings(turn, 10.0) for rest, turn in pairs)
    # The rest that no cycle fills is read as the cycle's own rests are, or else once, at its end.
    every = next((float(rest["read_every"].split()[0]) for rest in rests if "read_every" in rest), None)
    (stretch,) = schedule.stretches
    left = stretch.leftover > 0.0 if every is None else stretch.leftover // every
    assert count == stretch.cycles * own + left
    # Every row begins where the one before it ends.
    assert [r.start for r in written.readings[1:]] == pytest.approx([r.time for r in written.readings[:-1]], abs=1e-9)


def test_a_rest_that_is_read_as_its_table_is_read_at_its_end_too():
    """6 s, every 4 s: at 4 and 6 s, in `check`'s count, in the prediction and in the run."""
    tables = copy.deepcopy(TABLES)
    tables["rig"]["table"]["axis"][0]["angle"]["read_every"] = "4 s"
    tables["plan"] = {"method": "gradient", "temperature": ["-20 degC", "20 degC"], "gradient": "9.375 K/min"}
    tables["plan"]["cycle"] = {"moves": [{"rest": "6 s"}, TURN, {"rest": "6 s"}, {**TURN, "turn": "-360 deg"}]}
    tables["rig"]["chamber"] |= {"max_heating": "10 K/min", "max_cooling": "10 K/min"}
    spec = spec_of(tables)
    count = row_count(spec.schedule, spec.rig.table)
    assert count == 8 * 6  # 8 cycles of two rests and two turns, without a rest beside
    assert len(timeline(spec).readings) == count
    steps = track_of(make_recipe(spec), [spec.rig.table.axis[0].name]).steps
    assert sum(len(step.read_at_s) for step in steps) == count + 1  # and the first


def test_a_rest_read_at_its_end_is_one_read_so_often_that_this_is_its_only_reading():
    at_end = [{"read": "end"}, {}]
    every = [{"read_every": "6 s"}, {"read_every": "6 s"}]
    filled = {"gradient": "9.375 K/min"}  # 8 cycles of 32 s, and no rest beside
    left = [predict(spec_with(rests, **filled)).requirements[0].mean for rests in (at_end, every)]
    unread = predict(spec_with([{"read": "none"}] * 2, **filled)).requirements[0].mean
    assert left[0] == pytest.approx(left[1], rel=1e-12)
    assert unread > 1.01 * left[0]


def test_unused_stretches_end_with_a_new_origin():
    programme = [
        {"soak": "50 s", "at": "-20 degC"},
        {"ramp_to": "0 degC", "rate": "9 K/min"},
        {"step_to": "10 degC"},
        {"soak": "40 s"},
        {"ramp_to": "30 degC", "rate": "9 K/min"},
    ]
    moves = spec_with([{"read_every": "2 s"}, {}], temperature=None, gradient=None, programme=programme)
    written = timeline(moves)
    unused = [s for s in written.segments if not s.used]
    rows = zip(written.readings, written.readings[1:], strict=False)
    origins = [written.readings[0].start, *(b.start for a, b in rows if b.start > a.time + 1e-6)]
    assert len(unused) == 2
    assert origins == pytest.approx([s.start + s.duration for s in unused])
    assert np.all(np.diff([s.start for s in written.segments]) > 0)
    assert written.estimator == "best linear"
    assert written.points is None


def test_standard_points_say_what_they_share_and_how_they_are_weighed():
    tables = tomllib.loads(presets.text("paper-dynamic-standard"))
    tables["plan"]["estimator"] = "least squares"
    written = timeline(spec_of(tables))
    assert written.points == "independent"
    assert written.estimator == "least squares"
    assert len(written.readings) == 36
    assert {r.rate for r in written.readings} == set(spec_of(tables).plan.rates)
    assert sum(s.used for s in written.segments) == 36


def test_processes_and_functions_of_priors_are_named():
    tables = copy.deepcopy(TABLES)
    tables["sensor"] |= {"sample_clock_error": "5 ppm", "clock": "sensor"}
    sensor = tables["sensor"]["gyro"]
    sensor |= {"rate_random_walk": "1 deg/h/sqrt(h)", "turn_on_bias": "1 deg/h"}
    sensor["temperature_error"] = {"standard_deviation": "0.1 K", "scale_factor_slope": "1 ppm/K"}
    sensor["scale_factor"] |= {
        "rate": {"basis": "bins", "edges": ["-300 deg/s", "0 deg/s", "300 deg/s"]},
        "smoothness": "10 ppm",
    }
    written = timeline(spec_of(tables))
    (channel,) = written.channels
    assert channel.rate_random_walk > 0.0
    assert channel.temperature_error.tau is None
    assert channel.sample_clock_error is None
    assert [row.kind for row in written.installation] == ["sample_clock"]
    (scale,) = channel.terms
    assert scale.name == "scale_factor"
    assert scale.rate.prior_functions == "bins"
    assert scale.temperature.prior_functions == "monomial"
    assert scale.temperature.smoothness_functions == "monomial"
    # Of independent points every one has an error of the clock.
    tables["plan"] = tomllib.loads(presets.text("paper-dynamic-standard"))["plan"]
    assert timeline(spec_of(tables)).channels[0].sample_clock_error == pytest.approx(5e-6)
