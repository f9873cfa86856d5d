"""Optima of IMU plans, found by the product: what they leave, beside the plan by hand, and what finding them takes.

    python experiments/designs/engine.py                          all cases: two hours of processor time
    python experiments/designs/engine.py --case "skew, seed 0"    one case, to experiments/designs/engine
    python experiments/designs/engine.py --report                 the table of the cases there; it keeps all others

Writes engine.json and engine.md beside this file, from one file for each case in the folder `engine`, which keeps the
plans; `tests/evidence/test_searched_plans.py` runs their recipes. Of one search `evaluations`
are of the objective with its gradient, and processor time counts everything, compilation too. "better" is the
geometric mean over the requirements of the plan by hand (`experiments/imu/hand2.toml`) over the plan in question, or of
the case's own file where it is another.
"""

import argparse
import json
import math
import platform
import re
import time
from pathlib import Path

from gradcal_jax.cli.precision import use_float64

use_float64()

import numpy as np  # noqa: E402

import gradcal_jax as gj  # noqa: E402
from gradcal_jax.design.cycle_moves import Neighbourhood  # noqa: E402
from gradcal_jax.design.cycle_plan import CyclePlan  # noqa: E402
from gradcal_jax.design.optimise import run_search  # noqa: E402
from gradcal_jax.design.pose_search import EVALUATIONS  # noqa: E402
from gradcal_jax.design.searching import Optimised  # noqa: E402
from gradcal_jax.tables.writing import write_toml  # noqa: E402

HERE = Path(__file__).parent
IMU = HERE.parent / "imu"
RANDOM_TURNS, SEEDS = 30, 5


def random_start(seed: int) -> gj.Spec:
    """The plan by hand with a cycle that is nothing but chance."""
    plan = CyclePlan(gj.read_spec(IMU / "hand2.toml"))
    turns = Neighbourhood(plan.limits, plan.slots).random(RANDOM_TURNS, np.random.default_rng(seed))
    return plan.spec_of(plan.start._replace(turns=turns))


def cases() -> dict[str, tuple[gj.Spec, Path, int]]:
    """Start, file that the gain counts from, and seed of each case."""
    by_hand, rows = IMU / "hand2.toml", {}
    for seed in range(SEEDS):
        rows[f"by hand, seed {seed}"] = gj.read_spec(by_hand), by_hand, seed
    for seed in range(3):
        rows[f"random cycle {seed}"] = random_start(seed), by_hand, seed
    rows["six faces (hand.toml)"] = gj.read_spec(IMU / "hand.toml"), by_hand, 0
    for seed in range(SEEDS):
        rows[f"skew, seed {seed}"] = gj.read_spec(IMU / "skew.toml"), IMU / "skew.toml", seed
    rows["poses48"] = gj.read_spec(IMU / "poses48.toml"), IMU / "poses48.toml", 0
    return rows


def file_name(case: str) -> str:
    """The name of a case's files, without their endings."""
    return re.sub(r"\W+", "-", case).strip("-")


def residuals(plan: Path) -> list[float]:
    """What a plan leaves of each requirement."""
    return [row.decisive or math.nan for row in gj.predict(gj.read_spec(plan)).requirements]


def better_than(plan: Path, other: Path) -> float:
    """The geometric mean of the other's residuals over those of a plan."""
    return math.exp(np.mean(np.log(residuals(other)) - np.log(residuals(plan))))


def searched(start: gj.Spec, reference: Path, seed: int) -> tuple[dict[str, object], Optimised]:
    """One row of the table, and the optimum."""
    began, wall = time.process_time(), time.monotonic()
    *_, best = run_search(gj.changed(start, {"design.seed": seed}))
    assert isinstance(best, Optimised)
    took, wall = time.process_time() - began, time.monotonic() - wall
    before = residuals(reference)
    now = [row[3] or math.nan for row in best.rows]
    better = [
        math.exp(np.mean(np.log(before) - np.log([x or math.nan for x in of])))
        for of in ([row[2] for row in best.rows], now)
    ]
    return {
        "before": better[0],
        "better": better[1],
        "worst": max(new / old for old, new in zip(before, now, strict=True)),
        "rows": [(name, unit, now) for name, unit, _, now in best.rows],
        "cycles": best.spec.plain_schedule.stretches[0].cycles,
        "turns": sum(step.axis >= 0 for step in best.spec.plain_schedule.steps),
        "evaluations": best.evaluations,
        "processor_s": took,
        "wall_s": wall,
    }, best


def table(results: dict[str, dict]) -> str:
    """The results as Markdown."""
    lines = [
        "# Optima of IMU plans",
        "",
        f"By `python experiments/designs/engine.py` ({platform.machine()}, Python {platform.python_version()}; "
        f"{EVALUATIONS} evaluations at most). "
        "“better” counts from the plan by hand, `experiments/imu/hand2.toml`, or from the case's own file; “worst "
        "residual” is the largest of a requirement's, in units of that plan's.",
        "",
        "| case | start | **better** | worst residual | turns × cycles | evaluations | processor time |",
        "|---|---|---|---|---|---|---|",
    ]
    lines += [
        f"| {name} | {r['before']:.3f} | **{r['better']:.3f}** | {r['worst']:.3f} | {r['turns']} × {r['cycles']} | "
        f"{r['evaluations']} | {r['processor_s']:.0f} s |"
        for name, r in results.items()
    ]
    of_hand = {name: r for name, r in results.items() if name.startswith(("by hand", "random", "six"))}
    if of_hand:
        heads = [f"{name} ({unit})" for name, unit, _ in next(iter(of_hand.values()))["rows"]]
        lines += ["", "What each leaves:", "", f"| case | {' | '.join(heads)} |", "|---" * (len(heads) + 1) + "|"]
        lines += [
            f"| {name} | " + " | ".join(f"{now:.4g}" for *_, now in r["rows"]) + " |" for name, r in of_hand.items()
        ]
    return "\n".join(lines) + "\n"


def write_share(name: str, folder: Path) -> None:
    """Search one case: its row and its plan as files of a folder."""
    row, best = searched(*cases()[name])
    print(f"{name}: {row['better']:.3f} times better, {row['processor_s']:.0f} s", flush=True)
    folder.mkdir(parents=True, exist_ok=True)
    file = folder / file_name(name)
    file.with_suffix(".json").write_text(json.dumps({name: row}, indent=1) + "\n")
    found = gj.changed(best.spec, {"title": f"The optimum of a search: {name}"})
    write_toml(found, file.with_suffix(".toml"), header="Found by experiments/designs/engine.py.")


def report(folder: Path) -> None:
    """The rows of a folder into the table. The best from the one by hand is `descended` if it is clearly better."""
    known = HERE / "engine.json"
    results = json.loads(known.read_text()) if known.exists() else {}
    for file in folder.glob("*.json"):
        results |= json.loads(file.read_text())
    results = {name: results[name] for name in cases() if name in results}
    known.write_text(json.dumps(results, indent=1) + "\n")
    (HERE / "engine.md").write_text(table(results))
    by_hand = max((name for name in results if name.startswith("by hand")), key=lambda name: results[name]["better"])
    plan, known = (folder / file_name(by_hand)).with_suffix(".toml"), IMU / "descended.toml"
    if plan.exists() and better_than(plan, known) > 1.001:
        found = gj.changed(gj.read_spec(plan), {"title": "The plan by hand on two axes after its descent"})
        write_toml(found, known, header="Found by experiments/designs/engine.py.")


def main() -> None:
    """All cases, or one."""
    parser = argparse.ArgumentParser(description=(__doc__ or "").partition("\n")[0])
    parser.add_argument("--case", action="append", choices=cases(), help="only this one, without the table")
    parser.add_argument("--report", action="store_true", help="only the table, of the cases that are there")
    parser.add_argument("folder", type=Path, nargs="?", default=HERE / "engine", help="of the cases' files")
    asked = parser.parse_args()
    for name in () if asked.report else asked.case or cases():
        write_share(name, asked.folder)
    if not asked.case:
        report(asked.folder)


if __name__ == "__main__":
    main()
