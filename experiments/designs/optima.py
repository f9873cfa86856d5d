"""Optima of searches: what each plan leaves, beside the plan that its search begins with, and what the search takes.

    python experiments/designs/optima.py [--recipes] [NAME …]

Every case runs in a process of its own, without JAX's compilation cache; processor time counts everything, compiling
too, and "first" is that until the first progress of a search. Without names all are run (some hours); with names,
those alone, and the others keep their rows in optima.json. `--recipes` also writes the recipes of the headline's
variants. "Gain" is the geometric mean of all requirements of the plan by hand (`experiments/imu/hand2.toml`), or of the
case's own file where it is another, over those of the optimum.
"""

import json
import math
import os
import subprocess
import sys
import time
from pathlib import Path
from typing import Any

import gradcal_jax as gj
from gradcal_jax.cli.precision import use_float64
from gradcal_jax.tables.writing import to_toml

HERE = Path(__file__).parent
IMU, RECIPES, KEPT = HERE.parent / "imu", HERE.parent / "recipes", HERE / "optima.json"
RANDOM_TURNS, SEEDS = 30, 5


def hidden(each: str) -> dict[str, Any]:
    """The polynomials after the cubics, up to degree 5 x 5, with a standard deviation each."""
    return {"standard_deviation": each, "temperature_degree": 5, "rate_degree": 5}


REALISTIC = {
    "rig.table.axis[0].angle.reading_noise": "0 deg",
    "rig.table.axis[0].angle.standstill_offset": "0.05 deg",
    "sensor.gyro.scale_factor_instability": [{"standard_deviation": "20 ppm", "correlation_time": "20 min"}],
    "sensor.thermal_lag": "5 min",
    # The map's slope is a draw, too: 20 ppm/K is a usual figure of such gyros.
    "sensor.gyro.temperature_error": {"standard_deviation": "0.1 K", "scale_factor_slope": "20 ppm/K"},
}
BIAS = {"temperature": {"degree": 3, "centre": "20 degC", "scale": "50 K"}}
# Changes of headline.toml.
HEADLINE: dict[str, dict[str, Any]] = {f"headline, seed {seed}": {"design.seed": seed} for seed in range(SEEDS)} | {
    # More starts, as there are many local optima.
    "cycle length free": {"design.free": ["cycle"], "design.starts": 64},
    "bias unknown": {"sensor.gyro.bias": BIAS, "design.seed": 1},
    "realistic": REALISTIC,
    "discrepancy 5 ppm": {"sensor.gyro.scale_factor.discrepancy": hidden("5 ppm")},
    "discrepancy 10 ppm": {"sensor.gyro.scale_factor.discrepancy": hidden("10 ppm")},
}
RECIPE_OF = {
    "headline, seed 0": "headline",
    "discrepancy 5 ppm": "headline_discrepancy",
    "discrepancy 10 ppm": "headline_discrepancy_10ppm",
}
# Changes of experiments/paper/static_gradient.toml.
STATIC = {
    "at rest, 2 h 40 min": {"plan.gradient": "1 K/min", "design.max_total": "160 min"},
    "at rest, 9 h": {"plan.gradient": "1 K/min", "design.max_total": "540 min"},
}
# A file of experiments/imu, and a seed.
OF_IMU = {f"by hand, seed {seed}": ("hand2", seed) for seed in range(SEEDS)} | {
    **{f"random cycle {seed}": ("hand2", seed) for seed in range(3)},
    "six faces": ("hand", 0),
    **{f"skew, seed {seed}": ("skew", seed) for seed in range(SEEDS)},
    "poses48": ("poses48", 0),
}
PRESETS = [f"preset {name}" for name in gj.presets.names()]
CASES = [*HEADLINE, *STATIC, *OF_IMU, *PRESETS]


def start_of(name: str) -> gj.Spec:
    """The spec that a case's search begins with."""
    if name in HEADLINE:
        return gj.changed(gj.read_spec(HERE / "headline.toml"), HEADLINE[name])
    if name in STATIC:
        base = gj.read_spec(HERE.parent / "paper" / "static_gradient.toml")
        design = {"minimise": "full range", "free": ["programme"], "starts": 16}
        return gj.changed(base, {"design": design} | STATIC[name])
    if name in PRESETS:
        return gj.parse_spec(gj.presets.text(name.removeprefix("preset ")))
    file, seed = OF_IMU[name]
    spec = gj.changed(gj.read_spec(IMU / f"{file}.toml"), {"design.seed": seed})
    return random_start(spec, seed) if name.startswith("random") else spec


def random_start(spec: gj.Spec, seed: int) -> gj.Spec:
    """The spec with a random cycle."""
    import numpy as np

    from gradcal_jax.design.cycle_moves import Neighbourhood
    from gradcal_jax.design.cycle_plan import CyclePlan

    plan = CyclePlan(spec)
    turns = Neighbourhood(plan.limits, plan.coordinates.slots).random(RANDOM_TURNS, np.random.default_rng(seed))
    return plan.spec_of(plan.start._replace(turns=turns))


def search(name: str) -> dict[str, Any]:
    """The row of a case."""
    from gradcal_jax.design.optimise import Optimised, run_search

    begun, first, best = time.process_time(), None, None
    for event in run_search(start_of(name)):
        first = first or time.process_time() - begun
        best = event
    assert isinstance(best, Optimised)
    if "--recipes" in sys.argv and name in RECIPE_OF:
        (RECIPES / f"{RECIPE_OF[name]}.toml").write_text(to_toml(gj.make_recipe(best)), encoding="utf-8")
    took, gain = time.process_time() - begun, best.gain
    if name in OF_IMU:
        rows = gj.predict(gj.read_spec(IMU / f"{'skew' if 'skew' in name else 'hand2'}.toml")).requirements
        known = {row.name: row.decisive for row in rows}
        ratios = [math.log(before / row.now) for row in best.rows if row.now and (before := known.get(row.name))]
        gain = math.exp(sum(ratios) / len(ratios))
    figures = {"objective": f"{best.name}, {best.unit}", "before": best.before, "now": best.now, "gain": gain}
    counts = {"evaluations": best.evaluations, "first_s": first, "processor_s": took}
    git = ["git", "-C", str(HERE), "rev-parse", "--short", "HEAD"]
    commit = subprocess.run(git, capture_output=True, text=True, check=True).stdout.strip()
    return figures | counts | {"commit": commit}


def table(results: dict[str, dict]) -> str:
    """The rows as Markdown."""
    head = (__doc__ or "").partition("\n\n")[2].partition("\n\n")[2].strip()
    head = " ".join(head.split())
    lines = ["# Optima of searches", "", "By `python experiments/designs/optima.py`. " + head, ""]
    lines += ["| case | objective | before | now | gain | evaluations | first, s | processor time, s | commit |"]
    lines += ["|---" * 9 + "|"]
    for name, r in results.items():
        if "refused" in r:
            continue
        before = "not observable" if r["before"] is None else f"{r['before']:.4g}"
        lines.append(
            f"| {name} | {r['objective']} | {before} | {r['now']:.4g} | {r['gain']:.3f} | {r['evaluations']} | "
            f"{r['first_s']:.1f} | {r['processor_s']:.0f} | {r['commit']} |"
        )
    lines += ["", *(f"* {name}: refused, {r['refused']}" for name, r in results.items() if "refused" in r)]
    return "\n".join(lines).strip() + "\n"


def main() -> None:
    """Run the named cases, or all, or (`--alone`) one in this process."""
    names = [name for name in sys.argv[1:] if not name.startswith("--")] or CASES
    if "--alone" in sys.argv:
        use_float64()
        try:
            row = search(names[0])
        except ValueError as error:
            row = {"refused": str(error).splitlines()[0]}
        print(json.dumps(row))
        return
    options, environment = [o for o in sys.argv[1:] if o.startswith("--")], dict(os.environ)
    environment["JAX_ENABLE_COMPILATION_CACHE"] = "false"
    for name in names:
        command = [sys.executable, __file__, "--alone", *options, name]
        done = subprocess.run(command, stdout=subprocess.PIPE, text=True, check=True, env=environment)
        results = json.loads(KEPT.read_text(encoding="utf-8")) if KEPT.exists() else {}
        results[name] = json.loads(done.stdout.splitlines()[-1])
        print(name, results[name], flush=True)
        ordered = {case: results[case] for case in CASES if case in results}
        KEPT.write_text(json.dumps(ordered, indent=1) + "\n", encoding="utf-8")
        (HERE / "optima.md").write_text(table(ordered), encoding="utf-8")


if __name__ == "__main__":
    main()
