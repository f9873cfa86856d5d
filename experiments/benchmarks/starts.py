"""How quickly do many plans descend side by side: one thread for each, as a search does it, or one program for all?

    python experiments/benchmarks/starts.py [--case imu axis] [--starts N] [--ways threads 1 8 64] [--write FILE]

The plans are changed cycles of a whole IMU (`experiments/imu/hand2.toml`), and random starts of one gyro's plan
(`experiments/designs/headline.toml`). "threads": one descent in each, on all cores. A number: so many plans at once by
`vmap`, in which all of them wait for the longest line search. It runs on whatever device JAX finds; a GPU compiles in
less time with

    XLA_FLAGS="--xla_gpu_autotune_level=0 --xla_gpu_experimental_enable_fusion_autotuner=false"
"""

import argparse
import os
import platform
import time
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from functools import partial
from pathlib import Path
from typing import Any, NamedTuple

from gradcal_jax.cli.precision import use_float64

use_float64()

import equinox as eqx  # noqa: E402
import jax  # noqa: E402
import jax.numpy as jnp  # noqa: E402
import numpy as np  # noqa: E402

import gradcal_jax as gj  # noqa: E402
from gradcal_jax.design.compiling import compiler_options  # noqa: E402
from gradcal_jax.design.cycle_moves import Neighbourhood  # noqa: E402
from gradcal_jax.design.cycle_plan import CyclePlan  # noqa: E402
from gradcal_jax.design.descent import Descent  # noqa: E402
from gradcal_jax.design.turn_plan import measure, structures  # noqa: E402

EXPERIMENTS = Path(__file__).resolve().parent.parent
EVALUATIONS = 40


class Starts(NamedTuple):
    """Points `(N, n)`, the arguments of each, stacked, and the descent of them all."""

    points: np.ndarray
    args: Any
    descent: Descent

    def one(self, k: int) -> tuple[np.ndarray, Any]:
        return self.points[k], jax.tree.map(lambda x: x[k], self.args)


def of_imu(count: int) -> Starts:
    """The cycle of `hand2` and changed ones near it."""
    plan, rng = CyclePlan(gj.read_spec(EXPERIMENTS / "imu" / "hand2.toml")), np.random.default_rng(0)
    around, cycles = Neighbourhood(plan.limits, plan.slots), [plan.start]
    while len(cycles) < count:
        cycles.append(plan.start._replace(turns=around.neighbour(plan.start.turns, rng)))
    of = [plan.structure(c) for c in cycles]
    points = np.stack([plan.point(c, s) for c, s in zip(cycles, of, strict=True)])
    others = plan.course(plan.start.cycles).ramps, 30.0, plan.objective.targets
    args = [jax.tree.map(jnp.asarray, (s, *others)) for s in of]
    return Starts(points, jax.tree.map(lambda *x: jnp.stack(x), *args), plan.descent)


def of_axis(count: int) -> Starts:
    """Random starts of the headline's first structure."""
    spec = gj.read_spec(EXPERIMENTS / "designs" / "headline.toml")
    compiled = measure(spec).compiled(structures(spec, [])[0].coordinates)
    points, mask = np.zeros((2, count, compiled._whole))
    mask[:, compiled._places] = 1.0
    points[:, compiled._places] = np.random.default_rng(0).standard_normal((count, compiled.size))
    alike = [jnp.broadcast_to(leaf, (count, *leaf.shape)) for leaf in compiled._leaves]
    return Starts(points, (alike, jnp.asarray(mask), jnp.full(count, 8.0)), compiled._descent)


def by_threads(starts: Starts) -> Callable[[], tuple[np.ndarray, int]]:
    """One descent in each thread."""

    def descend(k: int) -> tuple[float, int]:
        *_, last = starts.descent(*starts.one(k), evaluations=EVALUATIONS)
        return last.value, last.evaluations

    def run() -> tuple[np.ndarray, int]:
        with ThreadPoolExecutor(os.cpu_count()) as pool:
            values, made = zip(*pool.map(descend, range(len(starts.points))), strict=True)
        return np.array(values), sum(made)

    return run


def by_vmap(starts: Starts, at_once: int) -> Callable[[], tuple[np.ndarray, int]]:
    """`at_once` descents in one program."""
    point, args = starts.one(0)
    of = starts.descent
    static = of._static_of(jnp.asarray(point), args)
    each = jax.vmap(partial(of._advanced, static), in_axes=(0, 0, 0, None))
    advance = jax.jit(each, compiler_options=compiler_options())

    def run() -> tuple[np.ndarray, int]:
        values, evaluations = [], 0
        for first in range(0, len(starts.points), at_once):
            some = jax.tree.map(lambda x, k=first: x[k : k + at_once], (jnp.asarray(starts.points), starts.args))
            begun = jax.vmap(lambda y, a: eqx.filter(of._begun(y, a), eqx.is_array))(*some)
            made, _, last = advance(*some, begun, EVALUATIONS)
            values.append(np.asarray(eqx.combine(last, static.state).f_info.f))
            evaluations += int(np.sum(made))
        return np.concatenate(values), evaluations

    return run


def main() -> None:
    """The table, to the screen and a file."""
    parser = argparse.ArgumentParser(description=(__doc__ or "").splitlines()[0])
    parser.add_argument("--case", nargs="+", choices=["imu", "axis"], default=["imu", "axis"])
    parser.add_argument("--starts", type=int, default=64)
    parser.add_argument("--ways", nargs="+", default=["threads", "1", "8", "64"], metavar="threads|N")
    parser.add_argument("--write", metavar="FILE", help="the table in Markdown, besides the screen")
    asked = parser.parse_args()
    device = jax.devices()[0]
    if device.platform != "cpu":
        # There is machine code of the filter for CPUs alone.
        os.environ["GRADCAL_NATIVE"] = "0"
    lines = [
        f"{device.device_kind} ({device.platform}), {platform.machine()}, {os.cpu_count()} cores, JAX "
        f"{jax.__version__}; {asked.starts} descents of at most {EVALUATIONS} evaluations.",
        "",
        "| plan | way | first call, s | second call, s | evaluations | ms an evaluation | best | median |",
        "|---|---|---|---|---|---|---|---|",
    ]
    print("\n".join(lines), flush=True)
    for case in asked.case:
        starts = {"imu": of_imu, "axis": of_axis}[case](asked.starts)
        for way in asked.ways:
            run = by_threads(starts) if way == "threads" else by_vmap(starts, int(way))
            begun = time.perf_counter()
            run()
            between = time.perf_counter()
            values, made = run()
            second = time.perf_counter() - between
            lines.append(
                f"| {case} | {way if way == 'threads' else f'{way} at once'} | {between - begun:.1f} | {second:.2f} | "
                f"{made} | {1e3 * second / made:.3g} | {np.min(values):.5f} | {np.median(values):.5f} |"
            )
            print(lines[-1], flush=True)
            if asked.write:
                Path(asked.write).write_text("\n".join(lines) + "\n", encoding="utf-8")


if __name__ == "__main__":
    main()
