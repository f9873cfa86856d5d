"""From a spec with [design] to a plan that is executed: what is written is feasible, whole, and worth what is said."""

import math
import re

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from nothing_omitted import with_nothing_omitted
from search_problem import SPEC, exact

import gradcal_jax as gj
from gradcal_jax.design.cycle_plan import CyclePlan
from gradcal_jax.design.optimise import Optimised, belief_of, run_search
from gradcal_jax.design.plan_limit import limit
from gradcal_jax.information.prediction import predict
from gradcal_jax.spec import spec as spec_file
from gradcal_jax.spec.changes import changed, tables_of
from gradcal_jax.spec.spec_sections import Spec


@pytest.fixture(scope="module")
def spec() -> Spec:
    return spec_file.parse_spec(SPEC)


@pytest.fixture(scope="module")
def best(spec) -> Optimised:
    *steps, found = run_search(spec, steps=3000)
    assert steps[-1].best <= steps[0].best
    assert isinstance(found, Optimised)
    return found


def residual(spec: Spec) -> float:
    value = predict(spec).requirements[0].mean_of_max
    assert value is not None
    return value


@pytest.mark.long
def test_the_optimum_is_better_is_what_predict_says_and_lies_above_the_limit(spec, best):
    assert best.now < best.before == pytest.approx(residual(spec))
    assert best.now == pytest.approx(residual(best.spec), rel=1e-12)
    assert best.converged, best.sentence
    before, after = limit(spec)[0], limit(best.spec)[0]
    # The recipe knows when the axis had the table, so that its limit is the spec's, but for rounded times: of the spec
    # that is read as often as the recipe, whose rests may end with a reading soon after the one before.
    closest = re.findall(r"the angle is read at most every (\S+ s)", "; ".join(after.relaxed))[0]
    (as_often,) = limit(changed(spec, {"plan.cycle.moves[0].read_every": closest}))
    assert as_often.certified <= before.certified * (1.0 + 1e-9)
    assert after.certified == pytest.approx(as_often.certified, rel=2e-3)
    assert before.certified < best.now
    assert after.efficiency == pytest.approx(after.certified / best.now)


def test_a_stopped_search_ends_with_the_best_plan_so_far_and_no_polish(spec):
    *steps, best = run_search(spec, stop=lambda: True)
    assert isinstance(best, Optimised)
    assert best.now == steps[-1].best <= steps[0].best


def test_steps_of_a_search_are_logged(spec, caplog):
    steps = []
    with caplog.at_level("INFO", "gradcal_jax"):
        found = gj.optimise(spec, steps=400, watch=steps.append)
    of_search = [record.getMessage() for record in caplog.records if record.name == "gradcal_jax.design.optimise"]
    assert len(of_search) == len(steps) + 1
    assert len(steps) > 1
    assert f"{steps[-1].best:.4g} {steps[-1].unit}, {100.0 * steps[-1].share:.0f} % done" in of_search[-2]
    assert of_search[-1] == f"optimise: {found.now:.4g} {found.unit}; {found.sentence}"


@pytest.mark.long
def test_an_optimum_that_rounds_to_nothing_observed_is_a_sentence(spec):
    """Steps of thousands of turns leave none: the plan as it was is kept."""
    coarse = changed(
        spec, {"rig.resolution": {"angle": "3000 turn"}, "design.starts": 1, "rig.table.axis[0].travel": "60 turn"}
    )
    *_, best = run_search(coarse, steps=20)
    assert isinstance(best, Optimised)
    assert best.kept


def paper(name: str) -> Spec:
    return spec_file.read_spec(f"experiments/paper/{name}.toml")


def static(**design) -> Spec:
    base = paper("static_gradient")
    return changed(base, {"design": {"minimise": "full range"} | design})


def test_the_objective_of_a_table_at_rest_is_that_of_its_plan():
    """But for the readings that stand for all others."""
    plan = CyclePlan(static())
    of = jax.tree.map(jnp.asarray, plan.coordinates.structure(plan.start.turns))
    value = float(jax.jit(plan.value)(plan.point(plan.start), (of, 1e5)))
    assert math.exp(value) == pytest.approx(exact(plan.spec), rel=0.005)


@pytest.mark.long
def test_the_recipe_of_limited_travel_is_better_and_stays_within_it(spec):
    turn = {"turn": "20 deg", "peak_rate": "1.68 deg/s", "shape": "linear ramps"}
    moves = [{"rest": "5 s"}, turn, {"rest": "5 s"}, turn | {"turn": "-20 deg"}]
    given = changed(spec, {"rig.table.axis[0].travel": "360 deg", "plan.cycle.moves": moves})
    *_, best = run_search(given, steps=600)
    assert isinstance(best, Optimised)
    assert best.now < 0.5 * best.before
    places = np.cumsum([s.move.angle for s in best.spec.gradient_schedule.steps])
    assert np.max(np.abs(places)) <= math.radians(360.0) * (1 + 1e-9)


@pytest.mark.evidence
@pytest.mark.parametrize(("time", "least"), [("160 min", 0.3449), ("540 min", 0.1590)])
def test_the_chambers_best_courses_for_a_table_at_rest(time, least):
    *_, best = run_search(static(max_total=time))
    assert isinstance(best, Optimised)
    assert best.now <= least
    segments = best.spec.gradient_schedule.segments
    temperatures = [t for s in segments for t in (s.temperature_start, s.temperature_end)]
    assert -40.0 <= min(temperatures) < max(temperatures) <= 85.0


def test_what_is_believed_is_said(spec):
    assert "exactly the structure" in belief_of(spec)
    hidden = {"standard_deviation": "20 ppm", "temperature_degree": 3, "rate_degree": 3}
    assert belief_of(changed(spec, {"sensor.gyro.scale_factor.discrepancy": hidden})) == ""


@pytest.mark.parametrize(
    ("changes", "says"),
    [
        ({"design.free": ["programme"]}, "an axis that has the table in a few visits follows the programme"),
        ({"design.max_motion": "50 s"}, "max_heating"),
        ({"design.max_motion": "40 min"}, "2.5 K/min"),
        ({"design.moves": 40, "design.shortest_rest": "4 s"}, "the moves need at least"),
    ],
)
def test_limits_that_exclude_each_other_are_named(spec, changes, says):
    with pytest.raises(ValueError, match=says):
        next(run_search(changed(spec, changes), steps=20))


def test_a_standing_axis_has_a_limit_of_its_bias_and_the_standard_method_neither_that_nor_a_search():
    (row,) = limit(paper("static_gradient"))
    assert 0.8 < row.efficiency < 1.0
    for refused in (limit, lambda spec: next(run_search(spec))):
        with pytest.raises(ValueError, match='only possible for a plan with method = "gradient"'):
            refused(paper("static_standard"))


def with_target(spec, own: str) -> Spec:
    """The spec with a target for what is minimised, as a file would have it."""
    (row,) = tables_of(spec)["requirement"]
    return changed(spec, {"requirement": [row | {"target": own}]})


def test_until_met_searches_nothing_where_the_plan_meets_its_targets_with_margin(spec):
    before, omits, spec = residual(spec), spec, with_nothing_omitted(spec)
    (found,) = run_search(with_target(spec, f"{before / 0.88} ppm"), until_met=True)
    assert isinstance(found, Optimised)
    assert "without a search" in found.sentence
    assert found.converged
    assert found.evaluations == 0
    # What the spec omits counts as in the verdict of `predict`, here 100 ppm of the table's angle alone.
    aimed = with_target(omits, f"{before / 0.88} ppm")
    *steps, found = run_search(aimed, steps=2, until_met=True)
    assert steps
    assert not found.converged
    assert "meets the target of full range with the typical figures of the terms that the spec omits" in found.sentence
    assert predict(found.spec).requirements[0].verdict == "missed"


def test_until_met_stops_at_a_plan_that_meets_every_target_with_margin(spec):
    """And far sooner than the search that goes on, to about 0.36 times the residual of the spec's own plan."""
    target = 0.6 * residual(spec)
    *steps, found = run_search(with_target(with_nothing_omitted(spec), f"{target} ppm"), steps=3000, until_met=True)
    assert isinstance(found, Optimised)
    assert "stopped early: every target is met with a margin of 10%" in found.sentence
    rows = {row.name: row for row in predict(found.spec).requirements}
    assert rows["full range"].mean_of_max <= 0.9 * target
    assert found.now == pytest.approx(rows["full range"].mean_of_max, rel=1e-12)
    assert steps[-1].share < 0.5


def test_until_met_needs_targets(spec):
    with pytest.raises(ValueError, match=r"target"):
        gj.optimise(spec, until_met=True)


@pytest.mark.parametrize(
    ("changes", "says"),
    [
        ({"design.longest_rest": "1 min"}, "has no effect if the search varies the turns of one axis"),
        ({"design.minimise": "worst"}, 'expected the name of a requirement \\("full range"\\) or'),
        ({"design.moves": 41}, "must be at most 40"),
        (
            {"rig.table.standing": "held", "plan.cycle.other_axes": None},
            "has no effect if the search varies a cycle",
        ),
    ],
)
def test_a_design_of_the_other_kind_of_search_is_refused(spec, changes, says):
    rests = {"plan.cycle.moves[0].read_every": None, "plan.cycle.moves[2].read_every": None}
    with pytest.raises(gj.SpecError, match=says):
        changed(spec, changes | rests)
