"""The headline case and its variants, each optimised and set beside its limit: recipes, and a table.

    python experiments/designs/variants.py [--limits] [NAME …]

Without names all are run (some minutes each); with names, those alone, and the others keep their rows. `--limits`
proves the limits of the kept recipes again, without a search. Recipes go to
experiments/recipes, figures to results.json and table.md here.
"""

import json
import sys
import time
from pathlib import Path

from gradcal_jax.cli.precision import use_float64
from gradcal_jax.spec.changes import changed
from gradcal_jax.spec.spec import Spec, read_spec
from gradcal_jax.tables.writing import to_toml

HERE = Path(__file__).parent
RECIPES = HERE.parent / "recipes"


def hidden(each: str) -> dict[str, object]:
    """The polynomials after the cubics, up to degree 5 x 5, with a standard deviation each."""
    return {"standard_deviation": each, "temperature_degree": 5, "rate_degree": 5}


FREE: list[str] = []
BIAS = {"temperature": {"degree": 3, "centre": "20 degC", "scale": "50 K"}}
REALISTIC = {
    "rig.table.axis[0].angle.reading_noise": "0 deg",
    "rig.table.axis[0].angle.standstill_offset": "0.05 deg",
    "sensor.gyro.scale_factor_instability": [{"standard_deviation": "20 ppm", "correlation_time": "20 min"}],
    "sensor.thermal_lag": "5 min",
    # The map's slope is a draw, too: 20 ppm/K is a usual figure of such gyros.
    "sensor.gyro.temperature_error": {"standard_deviation": "0.1 K", "scale_factor_slope": "20 ppm/K"},
}
STATIC = {
    "2h40": {"plan.gradient": "1 K/min", "design.max_total": "160 min"},
    "9h": {"plan.gradient": "1 K/min", "design.max_total": "540 min"},
}
MOVING: dict[str, dict[str, object]] = {
    "headline": {},
    # More starts and another seed where those found better: there are many local optima.
    "cycle-length-free": {"design.free": [*FREE, "cycle"], "design.starts": 64},
    "bias-unknown": {"sensor.gyro.bias": BIAS, "design.seed": 1},
    "realistic-budget": REALISTIC,
    "headline_discrepancy": {"sensor.gyro.scale_factor.discrepancy": hidden("5 ppm")},
    "headline_discrepancy_10ppm": {"sensor.gyro.scale_factor.discrepancy": hidden("10 ppm")},
}


def spec_of(name: str) -> Spec:
    """The spec of a variant."""
    if name in STATIC:
        base = read_spec(HERE.parent / "paper" / "static_gradient.toml")
        design = {"minimise": "full range", "free": ["programme"], "starts": 16}
        return changed(base, {"design": design} | STATIC[name])
    return changed(read_spec(HERE / "headline.toml"), MOVING[name])


def run(name: str) -> dict[str, object]:
    """Optimise a variant, write its recipe, and say what is to be said of it."""
    from gradcal_jax.design.optimise import optimise, record_of
    from gradcal_jax.design.recipe_of_plan import make_recipe

    spec = spec_of(name)
    begun = time.process_time()
    best = optimise(spec)
    took = time.process_time() - begun
    made = make_recipe(best)
    place = path_of(name)
    place.parent.mkdir(exist_ok=True)
    place.write_text(to_toml(made), encoding="utf-8")
    return record_of(best) | {"seconds": round(took)} | compared(name)


def path_of(name: str) -> Path:
    """Where a variant's recipe is kept."""
    return (RECIPES if name.partition("_")[0] == "headline" else RECIPES / "headline") / f"{name}.toml"


def compared(name: str) -> dict[str, object]:
    """What the kept recipe leaves, and the limit, where there is a proof."""
    from gradcal_jax.design.plan_limit import limit
    from gradcal_jax.information.prediction import predict
    from gradcal_jax.recipe.recipe import read_recipe

    spec = read_recipe(path_of(name)).spec
    if name not in MOVING:
        return {"residual": predict(spec).requirements[0].mean, "limit": None, "relaxed": []}
    proven = limit(spec)[0]
    return {"residual": proven.value, "limit": proven.certified, "relaxed": list(proven.relaxed)}


def table(results: dict[str, dict]) -> str:
    """The rows as Markdown."""
    lines = [
        "# The headline case and its variants",
        "",
        "`python experiments/designs/variants.py`; what each changes is in that file. All values are 1σ, exact for the "
        "rounded recipe; a variant's `before` is the plan of headline.toml, which is ours, under the variant's sensor "
        "and rig.",
        "",
        "| variant | objective | before | now | no plan below | ratio | converged | processor time, s |",
        "|---|---|---|---|---|---|---|---|",
    ]
    for name, r in results.items():
        unit = r["unit"]
        before = "—" if r.get("before") is None else f"{r['before']:.4g} {unit}"
        limit = "—" if r["limit"] is None else f"{r['limit']:.4g} ppm"
        ratio = "—" if r["limit"] is None else f"{r['residual'] / r['limit']:.2f}"
        lines.append(
            f"| {name} | {r['objective']} | {before} | {r['now']:.4g} {unit} | {limit} | {ratio} | "
            f"{'yes' if r['converged'] else 'no'} | {r['seconds']} |"
        )
    lines += ["", "What the limits relax:", ""]
    lines += [f"* {name}: {'; '.join(r['relaxed'])}" for name, r in results.items() if r["relaxed"]]
    return "\n".join(lines) + "\n"


def main(names: list[str]) -> None:
    """Run the named variants, or all."""
    use_float64()
    import jax

    kept = HERE / "results.json"
    results = json.loads(kept.read_text(encoding="utf-8")) if kept.exists() else {}
    again = "--limits" in names
    names = [name for name in names if name != "--limits"] or (list(results) if again else [*MOVING, *STATIC])
    for name in names:
        print(f"{name} …", flush=True)
        results[name] = results[name] | compared(name) if again else run(name)
        jax.clear_caches()
        print(f"  {results[name]['now']:.4g} {results[name]['unit']}, limit {results[name]['limit']}", flush=True)
        ordered = {name: results[name] for name in [*MOVING, *STATIC] if name in results}
        kept.write_text(json.dumps(ordered, indent=1) + "\n", encoding="utf-8")
        (HERE / "table.md").write_text(table(ordered), encoding="utf-8")


if __name__ == "__main__":
    main(sys.argv[1:])
