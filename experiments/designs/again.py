"""Does anything near an optimum beat it? Re-optimisations from perturbed optima, and shadow prices by differences.

    python experiments/designs/again.py [--count 200] [NAME …]

Every variant (or those named) is optimised; its optimum is perturbed by normal steps of 0.05 to 0.8 (the coordinates
are of unit size) and polished again, `count` times. Then each limit is eased by a little and the optimum polished again
under it: the difference of the two optima is set beside the shadow price. Figures go to again.json and again.md here.
"""

import argparse
import json
import time
from pathlib import Path
from typing import Any

import jax
import numpy as np
from variants import MOVING, STATIC, spec_of

from gradcal_jax.design import Coordinates, Optimum, polish
from gradcal_jax.design.optimise import run_search
from gradcal_jax.design.plan_objective import scenario_specs
from gradcal_jax.design.searching import SearchStep
from gradcal_jax.design.turn_plan import Measure, measure, structures
from gradcal_jax.design.turn_search import PRICED, polished, shadow_prices

HERE = Path(__file__).parent
STEPS = (0.05, 0.1, 0.2, 0.4, 0.8)
# Amounts by which limits are eased, in the price's unit.
EASED = {"minute": 0.5, "deg/s": 0.5, "deg/s^2": 3.0, "turn": 0.1, "K/min": 0.02}
# The shortest plan is the chamber's; a search in time has no optimum of this kind.
NAMES = [name for name in (*MOVING, *STATIC) if name != "shortest-for-77ppm"]


def tried(name: str, count: int) -> dict[str, Any]:
    """Optimise a variant, perturb its optimum and polish `count` times, ease its limits."""
    spec = spec_of(name)
    kept = [e.checkpoint for e in run_search(spec) if isinstance(e, SearchStep)][-1]
    structure = structures(spec, [s for s, _ in scenario_specs(spec)])[kept["at"][1]]
    of = measure(spec)
    unit = of.objective.name_and_unit()[1]
    coordinates, found = polished(of, structure.coordinates, kept["best_best_point"])
    objective = of.compiled(coordinates)
    begun, generator = time.perf_counter(), np.random.default_rng(0)
    values: dict[str, list[float]] = {}
    for k in range(count):
        step = STEPS[k % len(STEPS)]
        point = found.point + step * generator.standard_normal(found.point.shape)
        other = polish(objective, point, steps=150)
        values.setdefault(str(step), []).append(other.value if other.held else np.inf)
        if (k + 1) % 20 == 0:
            print(f"  {k + 1} of {count}: best {min(min(v) for v in values.values()):.5g} {unit}", flush=True)
    every = np.concatenate([np.array(v) for v in values.values()])
    return {
        "unit": unit,
        "optimum": found.value,
        "gradient": found.gradient_norm,
        "count": count,
        "best": float(every.min()),
        "better": int(np.sum(every < 0.99 * found.value)),
        "by_step": {s: [float(f(v)) for f in (np.min, np.median, np.max)] for s, v in values.items()},
        "seconds": round(time.perf_counter() - begun),
        "prices": prices(of, coordinates, found) if isinstance(coordinates, Coordinates) else [],
    }


def prices(of: Measure, coordinates: Coordinates, found: Optimum) -> list[dict[str, Any]]:
    """Each shadow price beside the difference of the optima with its limit eased and tightened."""
    rows = []
    for price in shadow_prices(of, coordinates, found):
        index = next(i for i, priced in enumerate(PRICED) if priced[0] == price.limit)
        amount, size = EASED[price.per], PRICED[index][2]
        ends = []
        for sign in (1.0, -1.0):
            by = np.zeros(len(PRICED))
            by[index] = sign * amount * size
            ends.append(polish(of.compiled(coordinates.eased(by)), found.point).value)
        difference = (ends[0] - ends[1]) / (2.0 * amount)
        rows.append({"limit": price.limit, "per": price.per, "price": price.change, "difference": difference})
    return rows


def table(found: dict[str, dict[str, Any]]) -> str:
    """The figures as Markdown."""
    lines = [
        "# Re-optimisations from perturbed optima, and shadow prices by differences",
        "",
        "`python experiments/designs/again.py`; what is perturbed and how is said there.",
        "",
        "| variant | optimum | largest gradient component | re-optimisations | best of them | better by over 1 % |",
        "|---|---|---|---|---|---|",
    ]
    for name, r in found.items():
        gain = 100.0 * (r["best"] / r["optimum"] - 1.0)
        lines.append(
            f"| {name} | {r['optimum']:.4f} {r['unit']} | {r['gradient']:.1e} | {r['count']} | "
            f"{r['best']:.4f} ({gain:+.2f} %) | {r['better']} |"
        )
    lines += ["", "By the size of the perturbation: best, median, worst.", ""]
    lines += ["| variant | " + " | ".join(map(str, STEPS)) + " |", "|---|" + "---|" * len(STEPS)]
    for name, r in found.items():
        cells = [", ".join(f"{v:.4g}" for v in r["by_step"][str(s)]) for s in STEPS]
        lines.append(f"| {name} | {' | '.join(cells)} |")
    lines += [
        "",
        "Shadow prices against the difference of the optima with the limit eased and tightened, both per unit:",
        "",
        "| variant | limit | price | difference |",
        "|---|---|---|---|",
    ]
    for name, r in found.items():
        for p in r["prices"]:
            lines.append(
                f"| {name} | {p['limit']} (1 {p['per']}) | {p['price']:+.4g} {r['unit']} | {p['difference']:+.4g} |"
            )
    return "\n".join(lines) + "\n"


def main() -> None:
    """Try the named variants, or all; the others keep their figures."""
    parser = argparse.ArgumentParser(description=(__doc__ or "").split("\n", maxsplit=1)[0])
    parser.add_argument("names", nargs="*", metavar="NAME", help=f"of {', '.join(NAMES)}")
    parser.add_argument("--count", type=int, default=200)
    asked = parser.parse_args()
    jax.config.update("jax_enable_x64", True)
    kept = HERE / "again.json"
    found = json.loads(kept.read_text(encoding="utf-8")) if kept.exists() else {}
    for name in asked.names or NAMES:
        print(f"{name} …", flush=True)
        found[name] = tried(name, asked.count)
        jax.clear_caches()
        found = {n: found[n] for n in NAMES if n in found}
        kept.write_text(json.dumps(found, indent=1) + "\n", encoding="utf-8")
        (HERE / "again.md").write_text(table(found), encoding="utf-8")


if __name__ == "__main__":
    main()
