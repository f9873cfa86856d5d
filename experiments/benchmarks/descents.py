"""Descents of the search's objective: SciPy's L-BFGS-B of the compiled value and gradient, as the program does it,
against optimistix' BFGS and L-BFGS, each compiled as a whole.

    python experiments/benchmarks/descents.py [SPEC] [--starts N] [--evaluations N]

Every engine descends from the same random starts, after one descent that compiles. Printed: processor time, and how far
the ends are above the best end of the same start (mean of the logarithm of the objective).
"""

import argparse
import time
from collections.abc import Callable
from pathlib import Path

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import optimistix

from gradcal_jax.cli.precision import use_float64
from gradcal_jax.design.cycle_plan import CyclePlan
from gradcal_jax.design.visits import visit_choices
from gradcal_jax.spec.spec import read_spec

HEADLINE = Path(__file__).parent.parent / "designs" / "headline.toml"
SHARPNESS, TOLERANCE = 100.0, 1e-9


def whole(plan: CyclePlan, solver: object, evaluations: int) -> Callable:
    """A descent of optimistix as one compiled program."""

    @eqx.filter_jit
    def end(point, args):
        value = lambda y, args: plan.value(y, args)  # noqa: E731
        found = optimistix.minimise(value, solver, point, args, max_steps=evaluations, throw=False)
        return plan.value(found.value, args)

    return lambda point, args: float(end(jnp.asarray(point), args))


def engines(plan: CyclePlan, evaluations: int) -> dict[str, Callable]:
    bfgs = optimistix.BFGS(rtol=TOLERANCE, atol=TOLERANCE)
    of_limited_memory = optimistix.LBFGS(rtol=TOLERANCE, atol=TOLERANCE, history_length=30)
    return {
        "SciPy, L-BFGS-B": lambda point, args: plan.descent(point, args, evaluations=evaluations).value,
        "optimistix, BFGS": whole(plan, bfgs, evaluations),
        "optimistix, BFGS, 3 times as many": whole(plan, bfgs, 3 * evaluations),
        "optimistix, L-BFGS": whole(plan, of_limited_memory, evaluations),
    }


def main() -> None:
    parser = argparse.ArgumentParser()
    parser.add_argument("spec", nargs="?", default=HEADLINE, type=Path)
    parser.add_argument("--starts", type=int, default=12)
    parser.add_argument("--evaluations", type=int, default=140)
    options = parser.parse_args()
    use_float64()
    spec, rng = read_spec(options.spec), np.random.default_rng(0)
    plan = CyclePlan(spec, visit_choices(spec, spec.design)[0])
    begins = []
    for _ in range(options.starts + 1):
        drawn = plan.drawn(rng)
        of = plan.coordinates.structure(drawn.turns)
        begins.append((plan.point(drawn), (jax.tree.map(jnp.asarray, of), SHARPNESS)))
    ends, seconds = {}, {}
    for name, descend in engines(plan, options.evaluations).items():
        descend(*begins[0])
        begun = time.process_time()
        ends[name] = np.array([descend(*begin) for begin in begins[1:]])
        seconds[name] = time.process_time() - begun
    best = np.min(list(ends.values()), axis=0)
    first = next(iter(seconds.values()))
    print(f"{options.starts} starts of {options.spec.name}, at most {options.evaluations} evaluations each")
    print("| engine | processor time, s | ratio | above the best end, mean of ln | best of all starts |")
    print("|---|---|---|---|---|")
    for name, values in ends.items():
        above = np.mean(values - best)
        print(f"| {name} | {seconds[name]:.2f} | {seconds[name] / first:.2f} | {above:.4f} | {np.min(values):.4f} |")


if __name__ == "__main__":
    main()
