"""Designs for several scenarios."""

import tomllib
from typing import Any

import pytest
from search_problem import SPEC

from gradcal_jax.design.plan_objective import scenario_specs
from gradcal_jax.spec.changes import changed
from gradcal_jax.spec.spec import parse_spec, spec_of
from gradcal_jax.spec.spec_sections import Spec
from gradcal_jax.tables.problems import SpecError


@pytest.fixture(scope="module")
def spec() -> Spec:
    return parse_spec(SPEC)


SCENARIOS = [
    {
        "weight": 2.0,
        "rig": {"table": {"axis[0]": {"angle": {"standstill_offset": "0.01 deg"}, "max_rate": "250 deg/s"}}},
    },
    {"rig": {"table": {"mounting[0]": {"accuracy": "0.1 deg"}, "rate_accuracy": "100 ppm"}}},
    {"rig": {"chamber": {"max_heating": "3 K/min"}}},
    {"rig": {"site": {"latitude": "29.91 deg"}}},
    {
        "sensor": {
            "gyro": {"angle_random_walk": "0.2 deg/sqrt(h)"},
            "thermal_lag": "90 s",
            "sample_clock_error": "20 ppm",
        }
    },
    {"sensor": {"gyro": {"scale_factor": {"prior": "1000 ppm"}}}},
]


def test_a_scenario_is_the_spec_with_its_figures():
    """As if they were written in the file."""
    base = tomllib.loads(SPEC)
    several = scenario_specs(spec_of(base | {"design": base["design"] | {"scenario": SCENARIOS}}))
    assert [weight for _, weight in several] == [2.0, 1.0, 1.0, 1.0, 1.0, 1.0]
    for (found, _), scenario in zip(several, SCENARIOS, strict=True):
        one = spec_of({key: _merged(value, scenario.get(key)) for key, value in base.items() if key != "design"})
        assert changed(found, {"design": None}) == one
        assert one != spec_of({key: value for key, value in base.items() if key != "design"})


def _merged(table: Any, changes: dict[str, Any] | None) -> Any:
    if changes is None or not isinstance(table, dict):
        return table
    new = dict(table)
    for key, of in changes.items():
        name, _, number = key.rstrip("]").partition("[")
        if number:
            several = [new[name]] if isinstance(new[name], dict) else list(new[name])
            several[int(number)] = _merged(several[int(number)], of)
            new[name] = several
        else:
            new[name] = _merged(new.get(name, {}), of) if isinstance(of, dict) else of
    return new


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
    with pytest.raises(SpecError, match=says):
        changed(spec, changes | rests)
