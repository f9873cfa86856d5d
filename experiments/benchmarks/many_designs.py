"""How quickly are many plans of an IMU judged? `gradcal_jax.differentiable` by `jit`, `lax.map` and `vmap`.

    python experiments/benchmarks/many_designs.py [--designs N] [--programs one map 50 ...] [--write FILE]

The plans are one of a whole IMU (`experiments/imu/descended.toml`) with other numbers of its cycle; of each the
eight residuals, and their geometric mean with its gradient in all numbers. It runs on whatever device JAX finds: on a
GPU it counts, too, how many steps a program makes one after the other. There most of the time to compile goes into the
choice of kernels, which is left out by

    XLA_FLAGS="--xla_gpu_autotune_level=0 --xla_gpu_experimental_enable_fusion_autotuner=false"
"""

import argparse
import math
import os
import platform
import time
from collections.abc import Callable, Iterator
from functools import partial
from pathlib import Path
from typing import Any

from gradcal_jax.cli.precision import use_float64

use_float64()

import jax  # noqa: E402
import jax.numpy as jnp  # noqa: E402
import numpy as np  # noqa: E402

import gradcal_jax as gj  # noqa: E402

SPEC = Path(__file__).resolve().parent.parent / "imu" / "descended.toml"
SPREAD = 0.02
ONE_AT_A_TIME = 20


def sequential(jaxpr: Any, times: int = 1) -> Iterator[float]:
    """How many steps each loop within a program makes, one after the other."""
    for equation in jaxpr.eqns:
        steps = times
        if equation.primitive.name == "scan":
            steps = times * equation.params["length"]
            yield steps
        elif equation.primitive.name == "while":
            yield math.inf
        for part in jax.tree.leaves(list(equation.params.values()), is_leaf=lambda x: hasattr(x, "jaxpr")):
            part = getattr(part, "jaxpr", part)
            if hasattr(part, "eqns"):
                yield from sequential(part, steps)


def clocked(call: Callable[[], Any]) -> tuple[Any, float, float]:
    """The result of a call, and wall and processor seconds."""
    wall, processor = time.perf_counter(), time.process_time()
    result = jax.block_until_ready(call())
    return result, time.perf_counter() - wall, time.process_time() - processor


def main() -> None:
    """The table, to the screen and a file."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--designs", type=int, default=1000)
    parser.add_argument("--programs", nargs="+", default=["one", "map", "50"], metavar="NAME|N")
    parser.add_argument("--write", metavar="FILE", help="the table in Markdown, besides the screen")
    asked = parser.parse_args()
    device = jax.devices()[0]
    if device.platform != "cpu":
        # There is machine code of the filter for CPUs alone; without it the loops can be counted.
        os.environ["GRADCAL_NATIVE"] = "0"
    residuals = gj.differentiable(gj.read_spec(SPEC))
    rng = np.random.default_rng(0)
    designs = {
        name: jnp.asarray(own * (1.0 + SPREAD * rng.standard_normal((asked.designs, *own.shape))))
        for name, own in residuals.quantities.items()
    }

    def value(numbers: Any) -> Any:
        return jnp.mean(jnp.log(jnp.stack(list(residuals(numbers).values()))))

    # The first plan is the spec's own, of which the value is known.
    designs = {name: x.at[0].set(residuals.quantities[name]) for name, x in designs.items()}
    known = np.mean(np.log([r.decisive for r in gj.predict(gj.read_spec(SPEC)).requirements]))
    lines = [
        "# Many plans of an IMU",
        "",
        f"{device.device_kind} ({device.platform}), {platform.machine()}, {os.cpu_count()} cores, JAX "
        f"{jax.__version__}; {asked.designs} plans of {sum(x[0].size for x in designs.values())} numbers, "
        f"machine code {'off' if os.environ.get('GRADCAL_NATIVE') == '0' else 'on'}.",
        "",
        "| program | plans at once | steps one after the other | tracing and compiling, s | ms a plan, wall | "
        "ms a plan, processor | first value less `predict`'s |",
        "|---|---|---|---|---|---|---|",
    ]
    print("\n".join(lines), flush=True)
    for what, one in (("value", value), ("value and gradient", jax.value_and_grad(value))):
        for name in asked.programs:
            at_once = int(name) if name.isdigit() else None
            some = {key: x[: ONE_AT_A_TIME if name == "one" else None] for key, x in designs.items()}
            first = {key: x[0] for key, x in designs.items()}
            begun = time.perf_counter()
            if name == "one":
                traced = jax.jit(one).trace(first)
            else:
                traced = jax.jit(partial(jax.lax.map, one, batch_size=at_once)).trace(some)
            program = traced.lower().compile()
            took = time.perf_counter() - begun
            each = (
                [{key: x[k] for key, x in some.items()} for k in range(len(some["turns"]))] if name == "one" else None
            )
            found, wall, processor = clocked(lambda p=program, q=some, e=each: p(q) if e is None else [p(x) for x in e])
            apart = float(jnp.ravel(jax.tree.leaves(found)[0])[0]) - known
            steps = max(sequential(traced.jaxpr.jaxpr), default=0)
            ms = 1e3 / len(some["turns"])
            lines.append(
                f"| {what} | {at_once or 1} | {steps:.0f} | {took:.1f} | {ms * wall:.3g} | {ms * processor:.3g} | "
                f"{apart:.1e} |"
            )
            print(lines[-1], flush=True)
            if asked.write:
                Path(asked.write).write_text("\n".join(lines) + "\n", encoding="utf-8")


if __name__ == "__main__":
    main()
