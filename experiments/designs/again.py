"""Does anything near an optimum beat it? Re-optimisations from perturbed optima, and shadow prices by differences.

    python experiments/designs/again.py [--count 200] [--write FILE]

The headline case is optimised; its optimum is perturbed by normal steps of 0.05 to 0.8 (the coordinates are of unit
size) and polished again, `count` times. Then each limit is eased by a little and the optimum polished again under it:
the difference of the two optima is set beside the shadow price.
"""

import argparse
import time
from datetime import UTC, datetime
from pathlib import Path

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from variants import spec_of

from gradcal_jax.assemble.measure import measure
from gradcal_jax.assemble.optimise import Optimised, eased, optimise
from gradcal_jax.design import polish

STEPS = (0.05, 0.1, 0.2, 0.4, 0.8)
# Amounts by which limits are eased, in the price's unit.
EASED = {"minute": 0.5, "deg/s": 1.5, "deg/s^2": 3.0}


def main() -> None:
    """Optimise, perturb, polish; print the tables."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--count", type=int, default=200)
    parser.add_argument("--write", type=Path)
    asked = parser.parse_args()
    jax.config.update("jax_enable_x64", True)
    spec = spec_of("headline")
    best = next(e for e in optimise(spec) if isinstance(e, Optimised))
    of, coordinates = measure(spec).of, best.coordinates

    def objective(z, sharpness):
        return of(coordinates.decode(z), sharpness)

    found = polish(objective, best.point)
    begun, generator = time.perf_counter(), np.random.default_rng(0)
    values: dict[float, list[float]] = {}
    for k in range(asked.count):
        step = STEPS[k % len(STEPS)]
        point = found.point + step * generator.standard_normal(found.point.shape)
        values.setdefault(step, []).append(polish(objective, point, steps=150).value)
        print(f"{k + 1} of {asked.count}: {values[step][-1]:.4f} ppm from a step of {step}", flush=True)
    took = time.perf_counter() - begun
    every = np.concatenate([np.array(v) for v in values.values()])
    lines = [
        "# Re-optimisations from the perturbed optimum of the headline case",
        "",
        f"{datetime.now(UTC):%Y-%m-%d}; `python experiments/designs/again.py --count {asked.count}`; {took:.0f} s.",
        "",
        f"The optimum is {found.value:.4f} ppm, its largest gradient component {found.gradient_norm:.1e} of it. Of "
        f"{len(every)} re-optimisations the best is {every.min():.4f} ppm "
        f"({100 * (every.min() / found.value - 1):+.2f} %); "
        f"{int(np.sum(every < 0.99 * found.value))} are better by more than 1 %.",
        "",
        "| step | best, ppm | median | worst |",
        "|---|---|---|---|",
    ]
    lines += [f"| {s} | {min(v):.4f} | {np.median(v):.4f} | {max(v):.4f} |" for s, v in values.items()]
    lines += [
        "",
        "Shadow prices against the difference of optima, both ppm per unit:",
        "",
        "| limit | price | difference, eased and tightened |",
        "|---|---|---|",
    ]
    for index, price in enumerate(best.prices):
        amount = EASED.get(price.per)
        if amount is None:
            continue
        ends = []
        for sign in (1.0, -1.0):
            si = {"minute": 60.0, "deg/s": np.pi / 180.0, "deg/s^2": np.pi / 180.0}[price.per]
            by = jnp.zeros(5).at[index].set(sign * amount * si)
            other = eqx.filter_jit(eased)(coordinates, by)
            ends.append(polish(lambda z, k, c=other: of(c.decode(z), k), found.point).value)
        difference = (ends[0] - ends[1]) / (2.0 * amount)
        lines.append(f"| {price.limit} (1 {price.per}) | {price.change:+.4g} | {difference:+.4g} |")
    text = "\n".join(lines) + "\n"
    print(text)
    if asked.write:
        asked.write.write_text(text, encoding="utf-8")


if __name__ == "__main__":
    main()
