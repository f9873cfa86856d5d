"""The recipes of optima of IMUs, run on the simulated rig, leave what is predicted: of the one that is committed, and
of a brief search of the skew IMU with limited travel."""

from pathlib import Path

import pytest
from chain import AIR_LAG_S, chain, predicted_of, say

import gradcal_jax as gj

IMU = Path(__file__).parents[2] / "experiments" / "imu"


@pytest.mark.evidence
@pytest.mark.parametrize(("name", "evaluations"), [("descended", 0), ("skew", 400)])
def test_every_requirement_is_achieved_as_predicted(name: str, evaluations: int, tmp_path: Path) -> None:
    recipe = tmp_path / "recipe.toml"
    status, printed = say("optimise", IMU / f"{name}.toml", "--steps", evaluations, "-o", recipe)
    assert status == 0, printed
    found = chain(recipe, predicted_of(recipe, AIR_LAG_S), tmp_path, 1)
    print(name, found.ratios, f"NEES {found.nees:.1f} of {found.degrees}, chi2 {found.fit}, wider {found.wider:.3f}")
    assert set(found.ratios) == {r.name for r in gj.read_recipe(recipe).spec.requirement}
    assert {n: r for n, r in found.ratios.items() if abs(r / found.wider - 1.0) > 0.05} == {}
