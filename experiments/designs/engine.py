"""Optima of IMU plans, found by the product: what they leave, beside the plan by hand, and what finding them takes.

    python experiments/designs/engine.py            all cases: an hour of processor time on two cores
    python experiments/designs/engine.py "seed 0"   one case; the table keeps the others as they are

Writes engine.json and engine.md beside this file. Of one search `evaluations` are of the objective with its gradient,
and processor time counts everything, compilation too. "better" is the geometric mean over the requirements of the plan
by hand (`experiments/imu/hand2.toml`) over the plan in question, or of the case's own file where it is another.
"""

import json
import math
import platform
import sys
import time
from pathlib import Path

from gradcal_jax.cli.precision import use_float64

use_float64()

import numpy as np  # noqa: E402

import gradcal_jax as gj  # noqa: E402
from gradcal_jax.api.optimise import optimise  # noqa: E402
from gradcal_jax.api.pose_search import EVALUATIONS, CyclePlan  # noqa: E402
from gradcal_jax.api.search_results import Optimised  # noqa: E402
from gradcal_jax.design.cycle_moves import Neighbourhood  # noqa: E402
from gradcal_jax.files import write_toml  # noqa: E402

HERE = Path(__file__).parent
IMU = HERE.parent / "imu"
RANDOM_TURNS = 30


def random_start(seed: int) -> gj.Spec:
    """The plan by hand with a cycle that is nothing but chance."""
    plan = CyclePlan(gj.read_spec(IMU / "hand2.toml"))
    turns = Neighbourhood(plan.limits, plan.slots).random(RANDOM_TURNS, np.random.default_rng(seed))
    return plan.spec_of(plan.start._replace(turns=turns))


def cases() -> dict[str, tuple[gj.Spec, Path, int]]:
    """Start, file that the gain counts from, and seed of each case."""
    by_hand, rows = IMU / "hand2.toml", {}
    for seed in range(3):
        rows[f"by hand, seed {seed}"] = gj.read_spec(by_hand), by_hand, seed
    for seed in range(3):
        rows[f"random cycle {seed}"] = random_start(seed), by_hand, seed
    rows["six faces (hand.toml)"] = gj.read_spec(IMU / "hand.toml"), by_hand, 0
    for name in ("skew", "poses48"):
        rows[name] = gj.read_spec(IMU / f"{name}.toml"), IMU / f"{name}.toml", 0
    return rows


def searched(start: gj.Spec, reference: Path, seed: int) -> tuple[dict[str, object], Optimised]:
    """One row of the table, and the optimum."""
    began, wall = time.process_time(), time.monotonic()
    *_, best = optimise(gj.changed(start, {"design.seed": seed}))
    assert isinstance(best, Optimised)
    took, wall = time.process_time() - began, time.monotonic() - wall
    before = [row.decisive or math.nan for row in gj.predict(gj.read_spec(reference)).requirements]
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


def main(only: str | None) -> None:
    """All cases, or those with `only` in their name."""
    known = HERE / "engine.json"
    results = json.loads(known.read_text()) if known.exists() else {}
    for name, case in cases().items():
        if only is not None and only not in name:
            continue
        results[name], best = searched(*case)
        print(f"{name}: {results[name]['better']:.3f} times better, {results[name]['processor_s']:.0f} s", flush=True)
        if name.startswith("by hand") and results[name]["better"] >= max(
            r["better"] for key, r in results.items() if key.startswith("by hand")
        ):
            found = gj.changed(best.spec, {"title": "The plan by hand on two axes after its descent"})
            write_toml(found, IMU / "descended.toml", header="Found by experiments/designs/engine.py.")
        known.write_text(json.dumps(results, indent=1) + "\n")
        (HERE / "engine.md").write_text(table(results))


if __name__ == "__main__":
    main(sys.argv[1] if len(sys.argv) > 1 else None)
