"""How much longer does a search take that counts a discrepancy?

    python experiments/benchmarks/discrepancy.py [--repeats N] [--searches N] [--write FILE]

The headline case, with and without the polynomials up to degree 5 x 5 hidden, in one process set up as `gradcal
optimise` is: the same descents of the same number of steps from the same starts, by turns, so that both meet the same
load. Times are of processor, all threads together, without compiling; medians over the repetitions, and the ratio of
each pair's. Then whole searches, to the polished and rounded plan, from as many seeds, each after the same search has
compiled what it needs.
"""

import argparse
import time
from pathlib import Path

import numpy as np

SPEC = Path(__file__).resolve().parent.parent / "designs" / "headline.toml"
HIDDEN = {"standard_deviation": "5 ppm", "temperature_degree": 5, "rate_degree": 5}
SHARPNESS, STEPS = 40.0, 15


def objectives():
    """The compiled objective without and with a discrepancy, and the sizes of their vectors, which are the same."""
    from gradcal_jax.design.turn_plan import measure, structures

    return [measure(one).compiled(structures(one, [])[0].coordinates) for one in specs()]


def specs():
    """The headline without and with a discrepancy."""
    from gradcal_jax.spec.changes import changed
    from gradcal_jax.spec.spec import read_spec

    spec = read_spec(SPEC)
    return [spec, changed(spec, {"sensor.gyro.scale_factor.discrepancy": HIDDEN})]


def descent(objective, start: np.ndarray) -> tuple[float, int]:
    """Processor time (s) of a descent, and how often it asked for value and gradient."""
    from scipy.optimize import minimize

    begun = time.process_time()
    found = minimize(
        lambda z: objective(z, SHARPNESS).merit(),
        start,
        jac=True,
        method="L-BFGS-B",
        options={"maxiter": STEPS, "maxcor": 40, "ftol": 0.0, "gtol": 0.0},
    )
    return time.process_time() - begun, found.nfev


def whole_search(spec, seed: int) -> float:
    """Processor time (s) of `optimise` from a seed, to its end."""
    from gradcal_jax.design.optimise import run_search
    from gradcal_jax.spec.changes import changed

    begun = time.process_time()
    for _ in run_search(changed(spec, {"design.seed": seed})):
        pass
    return time.process_time() - begun


def main() -> None:
    """Measure, print, and write a table where asked."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--repeats", type=int, default=9)
    parser.add_argument("--searches", type=int, default=5)
    parser.add_argument("--write", type=Path)
    given = parser.parse_args()
    from gradcal_jax.cli.precision import use_float64

    use_float64()
    both = objectives()
    starts = np.random.default_rng(0).standard_normal((given.repeats, both[0].size))
    for objective in both:
        objective(starts[0], SHARPNESS)
    spent = np.zeros((given.repeats, 2))
    asked = np.zeros((given.repeats, 2))
    for k, start in enumerate(starts):
        for which in (0, 1) if k % 2 else (1, 0):
            spent[k, which], asked[k, which] = descent(both[which], start)
    each = spent / asked
    whole = np.zeros((given.searches, 2))
    for seed in range(given.searches):
        for which in (0, 1):
            whole_search(specs()[which], seed)
        for which in (0, 1) if seed % 2 else (1, 0):
            whole[seed, which] = whole_search(specs()[which], seed)
    lines = [
        "# A search with a discrepancy",
        "",
        f"`python experiments/benchmarks/discrepancy.py`: {given.repeats} descents of {STEPS} steps each, by turns in "
        "one process; medians of processor time (all threads).",
        "",
        "| | without | with 5 ppm, 5 x 5 | ratio of medians | ratios of pairs: least, median, largest |",
        "|---|---|---|---|---|",
    ]
    rows = (
        ("a descent, s", spent, 3),
        ("a value and its gradient, ms", 1e3 * each, 3),
        ("a whole search, s", whole, 3),
    )
    for name, values, digits in rows:
        median, pairs = np.median(values, axis=0), np.sort(values[:, 1] / values[:, 0])
        lines.append(
            f"| {name} | {median[0]:.{digits}g} | {median[1]:.{digits}g} | {median[1] / median[0]:.2f} | "
            f"{pairs[0]:.2f}, {np.median(pairs):.2f}, {pairs[-1]:.2f} |"
        )
    text = "\n".join(lines) + "\n"
    print(text)
    if given.write is not None:
        given.write.write_text(text, encoding="utf-8")


if __name__ == "__main__":
    main()
