"""The engine of the search of one gyro's turns: L-BFGS-B of SciPy in threads against BFGS of optimistix in one program.

    python experiments/designs/turn_engine.py            # writes turn_engine.md; half an hour on two cores

Both engines descend from the same random points, through the same objective: as a
search does in its first stage; then from the best of these points with the hardest soft maximum, as a polish does.
"""

import argparse
import os
import platform
import time
from pathlib import Path

os.environ.setdefault("XLA_FLAGS", "--xla_cpu_multi_thread_eigen=false")

import jax
import numpy as np
from scipy.optimize import minimize

jax.config.update("jax_enable_x64", True)

import gradcal_jax as gj  # noqa: E402
from gradcal_jax.design.plan_objective import scenario_specs  # noqa: E402
from gradcal_jax.design.search import SHARPNESS, Compiled  # noqa: E402
from gradcal_jax.design.turn_plan import measure, structures  # noqa: E402
from gradcal_jax.recipe.recipe import spec_in  # noqa: E402

HERE = Path(__file__).parent
CASES = {
    "headline": HERE / "headline.toml",
    "realistic budget": HERE.parent / "recipes" / "headline" / "realistic-budget.toml",
    "discrepancy": HERE.parent / "recipes" / "headline_discrepancy.toml",
    "mission hover": HERE.parent / "missions" / "hover.toml",
}
# An evaluation of optimistix costs less: it has a gradient at accepted points alone. So many take as long, or longer.
STARTS, EVALUATIONS, POLISH = 6, {"SciPy": 40, "optimistix": 160}, {"SciPy": 300, "optimistix": 1200}


def scipy_descent(compiled: Compiled, point: np.ndarray, sharpness: float, evaluations: int) -> np.ndarray:
    """The end of a descent by SciPy after so many evaluations."""
    options = {"maxfun": evaluations, "maxiter": evaluations, "maxcor": 40, "ftol": 1e-12, "gtol": 1e-7, "maxls": 30}
    function = lambda z: compiled(z, sharpness).merit()  # noqa: E731
    return minimize(function, point, jac=True, method="L-BFGS-B", options=options).x


def compared(path: Path, seeds: int) -> list[dict]:
    """For each seed the best of the starts and its polish, and the processor time, by both engines."""
    spec: gj.Spec = spec_in(path)
    choice = structures(spec, [s for s, _ in scenario_specs(spec)])[0]
    compiled = measure(spec).compiled(choice.coordinates)
    compiled(np.zeros(compiled.size), SHARPNESS[0])
    began = time.process_time()
    compiled.descend(np.zeros(compiled.size), SHARPNESS[0], 2)
    compile_s = time.process_time() - began
    rows = []
    for seed in range(seeds):
        points = np.random.default_rng(seed).standard_normal((STARTS, compiled.size))
        row: dict = {"seed": seed, "size": compiled.size, "compile": compile_s}
        engines = {
            "SciPy": lambda z, k, n: scipy_descent(compiled, z, k, n),
            "optimistix": compiled.descend,
        }
        for name, engine in engines.items():
            began = time.process_time()
            ends = [engine(z, SHARPNESS[0], EVALUATIONS[name]) for z in points]
            merits = [compiled(z).merit()[0] for z in ends]
            staged = time.process_time() - began
            best = ends[int(np.argmin(merits))]
            polished = engine(best, SHARPNESS[-1], POLISH[name])
            row[name] = float(np.exp(min(merits))), float(np.exp(np.median(merits))), staged
            row[f"{name} polished"] = float(np.exp(compiled(polished).merit()[0])), time.process_time() - began - staged
        rows.append(row)
    return rows


def table(results: dict[str, list[dict]]) -> str:
    """The report."""
    head = "| case | seed | coordinates | best of the starts | median | time | polished | time |"
    lines = [
        "# The engine of the search of one gyro's turns",
        "",
        f"By `python experiments/designs/turn_engine.py` ({platform.machine()}, Python {platform.python_version()}): "
        f"{STARTS} random starts of {EVALUATIONS['SciPy']} evaluations by SciPy (L-BFGS-B) and "
        f"{EVALUATIONS['optimistix']} by optimistix (BFGS); then {POLISH['SciPy']} and {POLISH['optimistix']} from the "
        "best of them. Each cell: SciPy / optimistix; processor time in s without compiling, one thread; the value in "
        "the objective's unit.",
        "",
        head,
        "|---|---|---|---|---|---|---|---|",
    ]
    for case, rows in results.items():
        for row in rows:
            a, b, c, d = row["SciPy"], row["optimistix"], row["SciPy polished"], row["optimistix polished"]
            cells = [f"{x:.4g} / {y:.4g}" for x, y in zip(a, b, strict=True)]
            cells += [f"{x:.4g} / {y:.4g}" for x, y in zip(c, d, strict=True)]
            lines.append(f"| {case} | {row['seed']} | {row['size']} | {' | '.join(cells)} |")
    compiles = ", ".join(f"{case} {rows[0]['compile']:.0f} s" for case, rows in results.items())
    lines += ["", f"Compiling the descent of optimistix, beyond the objective's own program: {compiles}."]
    return "\n".join(lines) + "\n"


def main() -> None:
    """Compare the engines and write the report."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--seeds", type=int, default=5)
    parser.add_argument("--only", choices=CASES, action="append")
    asked = parser.parse_args()
    results = {}
    for case in asked.only or CASES:
        results[case] = compared(CASES[case], asked.seeds)
        print(case, *results[case], sep="\n", flush=True)
    if asked.only is None:
        (HERE / "turn_engine.md").write_text(table(results), encoding="utf-8")


if __name__ == "__main__":
    main()
