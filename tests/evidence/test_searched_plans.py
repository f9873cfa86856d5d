"""The recipes of optima of IMUs, run on the simulated rig, leave what is predicted: every plan that
`experiments/designs/engine.py` keeps, the one that is committed as `descended`, and a brief search of the skew IMU with
limited travel."""

import time
from pathlib import Path

import pytest
from chain import AIR_LAG_S, Chain, chain, predicted_of, say

import gradcal_jax as gj

EXPERIMENTS = Path(__file__).parents[2] / "experiments"
REPORT = EXPERIMENTS / "evidence" / "searched_plans.md"
KEPT = sorted(path.stem for path in (EXPERIMENTS / "designs" / "engine").glob("*.toml"))
CASES = {
    **{f"designs/engine/{name}": 0 for name in KEPT},
    "imu/descended": 0,
    "imu/skew": 400,
}
_HEAD = """# Recipes of optima on the simulated rig

Made by `pytest -m evidence tests/evidence/test_searched_plans.py`: of each plan that `experiments/designs/engine.py`
keeps (`designs/engine`) the recipe, a run on simulated devices, its log, the estimate. Reached over predicted: of its
requirements, without what the estimate widens for its fit; χ² of the hidden truth by the data.

| plan | gradients | reached over predicted | requirements | χ² of the truth | of | χ² of the fit | of |
|---|---|---|---|---|---|---|---|
"""


def report(name: str, evaluations: int, found: Chain) -> None:
    """Write or replace the row of a plan."""
    rows: dict[str, str] = {}
    if REPORT.exists():
        lines = [line for line in REPORT.read_text(encoding="utf-8").splitlines() if line.startswith("| `")]
        rows = {line.split("`")[1]: line for line in lines}
    ratios = [ratio / found.wider for ratio in found.ratios.values()]
    cells = (
        f"{evaluations or '–'}", f"{min(ratios):.3f} … {max(ratios):.3f}", f"{len(ratios)}", f"{found.nees:.1f}",
        f"{found.degrees}", f"{found.fit[0]:.1f}", f"{found.fit[1]}",
    )  # fmt: skip
    rows[name] = f"| `{name}` | {' | '.join(cells)} |"
    body = "\n".join(rows[name] for name in sorted(rows))
    REPORT.write_text(f"{_HEAD}{body}\n\n{time.strftime('%Y-%m-%d')}.\n", encoding="utf-8")


@pytest.mark.evidence
@pytest.mark.parametrize("name", CASES)
def test_every_requirement_is_achieved_as_predicted(name: str, tmp_path: Path) -> None:
    recipe = tmp_path / "recipe.toml"
    status, printed = say("optimise", EXPERIMENTS / f"{name}.toml", "--steps", CASES[name], "-o", recipe)
    assert status == 0, printed
    found = chain(recipe, predicted_of(recipe, AIR_LAG_S), tmp_path, 1)
    report(name, CASES[name], found)
    assert set(found.ratios) == {r.name for r in gj.read_recipe(recipe).spec.requirement}
    assert {n: r for n, r in found.ratios.items() if abs(r / found.wider - 1.0) > 0.05} == {}
