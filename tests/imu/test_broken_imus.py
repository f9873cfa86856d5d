"""Broken specs of whole units: every fault is named by its key and said in words (cases: broken_imus.toml)."""

import tomllib
from pathlib import Path

import pytest
from imu_helpers import shipped

from gradcal_jax.spec.changes import changed
from gradcal_jax.spec.spec import spec_of
from gradcal_jax.tables.problems import SpecError

CASES = tomllib.loads(Path(__file__).with_name("broken_imus.toml").read_text(encoding="utf-8"))["case"]
PLAN = {"method": "gradient", "temperature": ["20 degC", "30 degC"], "gradient": "1 K/min"}
PLAN["cycle"] = {
    "moves": [
        {"pose": {"tilt": "0 deg"}, "rest": "8 s"},
        {"turn": "720 deg", "axis": "spin"},
        {"rest": "8 s"},
        {"turn": "-720 deg", "axis": "spin", "peak_rate": "150 deg/s"},
        {"pose": {"tilt": "90 deg", "spin": "90 deg"}, "rest": "8 s"},
        {"pose": {"tilt": "0 deg", "spin": "0 deg"}},
    ]
}


@pytest.fixture(scope="module")
def good():
    return spec_of(shipped("hand") | {"plan": PLAN})


@pytest.mark.parametrize("case", CASES, ids=lambda case: f"{case['key']}: {case['says']}"[:60])
def test_every_fault_is_named_by_its_key_and_said_in_words(good, case):
    with pytest.raises(SpecError) as caught:
        changed(good, dict.fromkeys(case.get("without", ())) | case.get("with", {}))
    assert any(p.dotted == case["key"] and case["says"] in str(p) for p in caught.value.problems), str(caught.value)


def test_a_cycle_that_starts_again_in_every_stretch_may_do_so_where_it_ends_as_it_begins(good):
    programme = [{"soak": "10 min", "at": "20 degC", "used": True}, {"soak": "1 min"}, {"soak": "10 min", "used": True}]
    moves = [{"rest": "5 s"}, *({"turn": f"{sign}90 deg", "axis": "spin"} for sign in ("", "-"))]
    spec = changed(good, {"plan": {"programme": programme, "cycle": {"moves": moves}}})
    assert len(spec.schedule.stretches) == 2
