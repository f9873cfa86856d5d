"""Designs for a wrong model: a hidden map that must be noticed, and noise figures that are uncertain."""

import tomllib
from typing import Any

import numpy as np
import pytest
from search_problem import SPEC, keeps_limits, targets_met

from gradcal_jax.design.optimise import run_search
from gradcal_jax.design.plan_objective import extremes, scenario_specs
from gradcal_jax.design.searching import Optimised
from gradcal_jax.design.turn_plan import measure, structures
from gradcal_jax.design.turn_search import belief_of
from gradcal_jax.information.prediction import predict
from gradcal_jax.model.build import assemble
from gradcal_jax.spec.changes import changed
from gradcal_jax.spec.spec import parse_spec, spec_of
from gradcal_jax.spec.spec_sections import Spec
from gradcal_jax.tables.problems import SpecError
from gradcal_jax.tables.writing import to_toml
from gradcal_jax.units import format_quantity, unit_of

UNCERTAIN = {
    "sensor.gyro.drift[0].uncertain": {"standard_deviation": "factor 2", "correlation_time": ["1 min", "20 min"]},
    "sensor.gyro.uncertain": {"angle_random_walk": "factor 1.5"},
}


@pytest.fixture(scope="module")
def spec() -> Spec:
    return parse_spec(SPEC)


def value(spec: Spec) -> float:
    return predict(spec).requirements[0].judged


def test_uncertain_figures_make_a_range_that_holds_every_draw(spec):
    loose = changed(spec, UNCERTAIN)
    assert parse_spec(to_toml(loose)) == loose
    low, high = predict(loose, limits=True).requirements[0].uncertain
    assert low < value(spec) < high
    rng = np.random.default_rng(0)
    figures = loose.sensor.uncertain_figures()
    assert len(figures) == 3
    for _ in range(12):
        drawn = {
            k: format_quantity(float(np.exp(rng.uniform(*np.log(ends)))), unit_of(ends[0].text))
            for k, ends in figures.items()
        }
        assert low * (1 - 1e-9) <= value(changed(loose, drawn)) <= high * (1 + 1e-9)


def test_the_worst_of_a_design_is_the_worst_of_the_range(spec):
    loose = changed(spec, UNCERTAIN | {"design.robust": "worst"})
    cases = scenario_specs(loose)
    assert len(cases) == 3  # standard deviations at their largest, the correlation time at both ends and as written
    assert max(value(one) for one, _ in cases) == pytest.approx(max(value(one) for one in extremes(loose)))
    mean = scenario_specs(changed(loose, {"design.robust": "mean"}))
    assert len(mean) == 7
    assert {weight for _, weight in mean} == {1.0}


def test_cases_in_a_loop_are_the_cases_one_by_one(spec):
    """One program loops over scenarios; NumPy takes them in turn. And the gradient is the difference: 1e-6."""
    loose = changed(spec, UNCERTAIN | {"design.robust": "worst", "sensor.gyro.scale_factor.discrepancy": HIDDEN})
    of = measure(loose)
    coordinates = structures(loose, [s for s, _ in scenario_specs(loose)])[0].coordinates
    at = of.compiled(coordinates)
    point = np.random.default_rng(2).standard_normal(at.size)
    assert np.exp(at(point).logs[0]) == pytest.approx(of.exact(coordinates.decode(point)), rel=1e-9)
    gradient, step = at(point, 20.0).of_z[0], 1e-5
    for k in np.argsort(-np.abs(gradient))[:4]:
        e = step * np.eye(at.size)[k]
        difference = (at(point + e, 20.0).logs[0] - at(point - e, 20.0).logs[0]) / (2 * step)
        assert abs(gradient[k] - difference) < 1e-6 * np.linalg.norm(gradient)


HIDDEN = {"standard_deviation": "20 ppm", "temperature_degree": 3, "rate_degree": 3}


@pytest.mark.long
def test_a_search_finds_a_plan_that_notices_what_its_file_s_own_does_not(spec):
    (row,) = predict(changed(spec, {"design.notice": HIDDEN}), notices=True).notices
    notice = HIDDEN | {"standard_deviation": f"{0.5 * row.sure_from:.4g} ppm", "power": "90 %"}
    must = changed(spec, {"design.notice": notice, "design.starts": 1})
    assert not keeps_limits(must)
    *_, best = run_search(must, steps=40)
    assert isinstance(best, Optimised)
    assert predict(best.spec, notices=True).notices[0].power > 0.89
    assert best.now == pytest.approx(predict(best.spec).requirements[0].decisive)


@pytest.mark.evidence
def test_a_design_notices_what_it_must_and_pays_for_it(spec):
    *_, free = run_search(spec, steps=40)
    (row,) = predict(changed(free.spec, {"design.notice": HIDDEN}), notices=True).notices
    assert row.standard_deviation == pytest.approx(20.0)
    # Twice as small as what the plan is sure to notice.
    notice = HIDDEN | {"standard_deviation": f"{0.5 * row.sure_from:.4g} ppm", "power": "90 %"}
    must = changed(spec, {"design.notice": notice})
    *_, best = run_search(must, steps=40)
    assert isinstance(best, Optimised)
    (seen,) = predict(best.spec, notices=True).notices
    assert seen.power > 0.89 > predict(changed(free.spec, {"design.notice": notice}), notices=True).notices[0].power
    # Both are local optima of a few steps: to a per cent.
    assert best.now >= 0.99 * free.now
    assert best.now == pytest.approx(predict(best.spec).requirements[0].decisive)


def test_the_plan_as_it_was_counts_only_where_it_notices(spec):
    (row,) = predict(changed(spec, {"design.notice": HIDDEN}), notices=True).notices
    for share, keeps in ((2.0, True), (0.5, False)):
        notice = HIDDEN | {"standard_deviation": f"{share * row.sure_from:.6g} ppm"}
        must = changed(spec, {"design.notice": notice})
        assert keeps_limits(must) == keeps
        assert targets_met(changed(must, {"requirement[0].target": "1000000 ppm"})) == keeps
        # Where a time is minimised, a plan that misses it is none.
        target = {"requirement[0].target": "1000000 ppm", "design.minimise": "motion time"}
        of = measure(changed(must, target))
        (own,) = predict(must, notices=True).notices
        assert of.limits == ()
        assert (of.exact(assemble(must).schedule) <= 1.0) == keeps
        # The test that is reported leaves out what the plan does not show.
        assert of.exact(assemble(must).schedule) >= (1.0 - own.power) / 0.1


def test_the_probability_to_miss_has_a_gradient_in_the_plan(spec):
    must = changed(spec, {"design.notice": HIDDEN})
    of = measure(must)
    coordinates = structures(must, [])[0].coordinates
    at = of.compiled(coordinates)
    point, step = np.random.default_rng(5).standard_normal(at.size), 1e-5
    slopes = at(point).of_z
    assert slopes.shape[0] == 2
    direction = slopes[1] / np.linalg.norm(slopes[1])
    difference = (at(point + step * direction).logs[1] - at(point - step * direction).logs[1]) / (2 * step)
    assert slopes[1] @ direction == pytest.approx(difference, rel=1e-6)
    # What is believed has no discrepancy: the objective is the plan's without one.
    assert np.exp(at(point).logs[0]) == pytest.approx(measure(spec).exact(coordinates.decode(point)), rel=1e-9)


def test_what_is_believed_is_said(spec):
    assert "exactly the structure" in belief_of(spec)
    assert belief_of(changed(spec, {"sensor.gyro.scale_factor.discrepancy": HIDDEN})) == ""


@pytest.mark.parametrize(
    ("changes", "says"),
    [
        ({"design.min_distinct_rates": 6}, "no longer exists"),
        ({"sensor.gyro.drift[0].uncertain": "factor 0.5"}, "above 1"),
        ({"sensor.gyro.drift[0].uncertain": "about 2"}, "factor 2"),
        ({"sensor.gyro.drift[0].uncertain": 3}, "a table that gives"),
        ({"sensor.gyro.drift[0].uncertain": {"tau": "factor 2"}}, "not a figure of this table"),
        (
            {"sensor.sample_clock_error": None, "sensor.uncertain": {"sample_clock_error": "factor 2"}},
            "the table has no such figure",
        ),
        (
            {"sensor.gyro.drift[0].uncertain": {"correlation_time": ["3 min", "20 min"]}},
            "the stated value",
        ),
        ({"sensor.gyro.drift[0].uncertain": {"correlation_time": ["3 parsec", "20 min"]}}, "not understood"),
        ({"design.notice": {"standard_deviation": "10 ppm", "power": "100 %"}}, "below 100 %"),
        ({"design.notice": {"standard_deviation": "10 ppm", "rate_degree": 1}}, "exceed"),
        (
            {
                "design.notice": {"standard_deviation": "10 ppm", "rate_degree": 5},
                "sensor.gyro.scale_factor.discrepancy": HIDDEN,
            },
            "discrepancy",
        ),
    ],
)
def test_what_cannot_be_is_refused_in_a_sentence(spec, changes, says):
    with pytest.raises(SpecError, match=says):
        changed(spec, changes)


SCENARIOS = [
    {"weight": 2.0, "rig": {"table": {"angle": {"standstill_offset": "0.01 deg"}, "max_rate": "250 deg/s"}}},
    {"rig": {"table": {"mounting_accuracy": "0.1 deg", "rate_accuracy": "100 ppm"}}},
    {"rig": {"chamber": {"max_heating": "3 K/min"}}},
    {"name": "north", "rig": {"earth_rate": "7.5 deg/h"}},
    {"sensor": {"angle_random_walk": "0.2 deg/sqrt(h)", "thermal_lag": "90 s", "sample_clock_error": "20 ppm"}},
    {"sensor": {"scale_factor": {"prior": "1000 ppm"}}},
]


def test_scenarios_change_the_same_figures_in_the_general_form():
    """Changed and then converted, or converted and then changed."""
    base = tomllib.loads(SPEC)
    several = scenario_specs(spec_of(base | {"design": base["design"] | {"scenario": SCENARIOS}}))
    assert [weight for _, weight in several] == [2.0, 1.0, 1.0, 1.0, 1.0, 1.0]
    for (imu, _), scenario in zip(several, SCENARIOS, strict=True):
        one = spec_of({key: _merged(value, scenario.get(key)) for key, value in base.items() if key != "design"})
        assert changed(imu, {"design": None}) == one
        assert one != spec_of({key: value for key, value in base.items() if key != "design"})


def _merged(table: Any, changes: dict[str, Any] | None) -> Any:
    if changes is None or not isinstance(table, dict):
        return table
    new = {key: _merged(table.get(key, {}), of) if isinstance(of, dict) else of for key, of in changes.items()}
    return table | new


@pytest.mark.parametrize(
    ("changes", "says"),
    [
        ({"design.angle_step": "15 deg"}, "has no effect if the search varies the turns of one axis"),
        ({"design.minimise": "worst ratio"}, 'expected the name of a requirement \\("full range"\\) or "motion time"'),
        ({"design": {"minimise": "full range"}}, "which parts of the plan may change"),
        ({"design.moves": 41}, "must be at most 40"),
        (
            {"rig.table.standing": "held", "plan.cycle.other_axes": None},
            "has no effect if the search varies a cycle",
        ),
    ],
)
def test_a_design_of_the_other_kind_of_search_is_refused(spec, changes, says):
    rests = {"plan.cycle.moves[0].read_every": None, "plan.cycle.moves[2].read_every": None}
    with pytest.raises(SpecError, match=says):
        changed(spec, changes | rests)
