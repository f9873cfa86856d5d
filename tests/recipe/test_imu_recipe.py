"""Recipes of whole units: plans rounded to what the controllers of several axes accept, and read back."""

import math
import tomllib
from typing import Any

import jsonschema
import numpy as np
import pytest
from made_recipe import made_of

from gradcal_jax.recipe.bench_tables import block_heading, move_rows
from gradcal_jax.recipe.recipe import parse_recipe
from gradcal_jax.recipe.rounding import rounded
from gradcal_jax.recipe.tracks import ControllerSteps
from gradcal_jax.spec import presets
from gradcal_jax.spec.changes import changed
from gradcal_jax.spec.spec import parse_spec
from gradcal_jax.spec.spec_sections import Spec
from gradcal_jax.tables.quantity import Quantity
from gradcal_jax.tables.schemas import schema
from gradcal_jax.tables.writing import to_toml


def preset(name: str) -> Spec:
    return parse_spec(presets.text(name))


def ends(spec: Spec) -> list[float]:
    """Where a cycle leaves the axes, rad."""
    at = list(spec.schedule.start)
    for step in spec.schedule.steps:
        if step.axis >= 0:
            at[step.axis] += step.move.angle
    return at


@pytest.mark.parametrize("name", presets.names())
def test_every_preset_is_rounded_and_read_back(name: str) -> None:
    spec = preset(name)
    recipe = made_of(spec, optimisation={"objective": "full range", "starts": [1.5, 2.0], "limits": {"rate": 3}})
    again = parse_recipe(text := to_toml(recipe))
    assert again == recipe
    assert again.fingerprint == recipe.fingerprint
    assert recipe.duration_s == pytest.approx(spec.schedule.duration, rel=1e-9)
    jsonschema.validate(tomllib.loads(text), schema("recipe"))
    # What is on the grids stays as it is.
    twice = rounded(again.spec)
    assert twice.spec.plan == again.spec.plan
    if spec.plan.method == "standard":
        assert again.spec.schedule == spec.schedule
    else:
        np.testing.assert_allclose(ends(again.spec), ends(spec), atol=1e-6)
        before, after = (sum(stretch.cycles for stretch in s.schedule.stretches) for s in (spec, again.spec))
        assert after == before
    axes = {axis.name: axis for axis in spec.rig.table.axis}
    for block in again.motion:
        assert list(block.start) == ([] if spec.plan.method == "standard" else list(axes))
        for move in block.moves:
            if move.angle is not None:
                assert abs(move.rate) <= axes[move.axis].max_rate * (1.0 + 1e-9)
                assert move.acceleration <= axes[move.axis].max_acceleration * (1.0 + 1e-6)


@pytest.mark.parametrize("seed", range(2))
def test_poses_off_the_grid_do_not_wander(seed: int) -> None:
    random = np.random.default_rng(seed)
    poses: list[dict[str, Any]] = [
        {
            "pose": {axis: f"{random.uniform(-170.0, 170.0):.7f} deg" for axis in ("tilt", "spin")},
            "rest": f"{random.uniform(3.0, 9.0):.3f} s",
        }
        for _ in range(12)
    ]
    moves = [*poses, {"turn": "360 deg", "axis": "spin"}, {"pose": {"tilt": "0 deg", "spin": "0 deg"}, "rest": "3 s"}]
    spec = changed(preset("two-axis-table"), {"plan.cycle.moves": moves})
    made = rounded(spec).spec
    step = math.radians(0.001)
    at, exact = [0.0, 0.0], [0.0, 0.0]
    own = [s for s in made.schedule.steps if s.axis >= 0]
    for said, drawn in zip(own, [s for s in spec.schedule.steps if s.axis >= 0], strict=True):
        at[said.axis] += said.move.angle
        exact[drawn.axis] += drawn.move.angle
        assert said.axis == drawn.axis
        assert at[said.axis] == pytest.approx(exact[said.axis], abs=0.5001 * step)
        assert at[said.axis] / step == pytest.approx(round(at[said.axis] / step), abs=1e-4)
    assert rounded(made).spec.plan == made.plan


def test_coarse_controllers_keep_an_axis_that_hardly_turns() -> None:
    rest, there, back = ({"rest": "5 s"}, {"turn": "90 deg", "axis": "spin"}, {"turn": "-90 deg", "axis": "spin"})
    moves = [rest, {"turn": "0.0001 deg", "axis": "tilt"}, there, rest, back]
    made = rounded(changed(preset("two-axis-table"), {"plan.cycle.moves": moves})).spec
    assert [step.axis for step in made.schedule.steps] == [-1, -1, 1, -1, 1]
    rough = ControllerSteps(angle=Quantity.read("7 deg", "angle"))
    turns = [math.degrees(s.move.angle) for s in rounded(made, rough).spec.schedule.steps if s.axis >= 0]
    assert turns == pytest.approx([91.0, -91.0])


def test_a_technician_reads_where_each_axis_stands() -> None:
    recipe = made_of(preset("one-axis-table"))
    assert [block.mounting for block in recipe.motion] == [1, 2, 3]
    assert recipe.motion[2].hang == "mounting 3 (z along the axis): x along +y, y along +z, z along +x"
    rows = move_rows(recipe.motion[0])
    assert rows[0][1:3] == ("", "rest")
    assert rows[1][1:5] == ("turn", "turn", str(recipe.motion[0].moves[1].duration), "+1080 deg, to 1080 deg")
    assert rows[3][4] == "-1080 deg, to 0 deg"
    placed = changed(preset("one-axis-table"), {"plan.cycle.start": {"turn": "30 deg"}})
    assert "initial angles: turn 30 deg" in block_heading(made_of(placed).motion[0])
