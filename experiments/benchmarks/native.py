"""What machine code gains: a value with its gradient, and a quick search, with and without `information/filter.cc`.

    python experiments/benchmarks/native.py

Processor time of a process of its own for each, after one that compiled everything.
"""

import os
import subprocess
import sys
import tempfile

SPECS = ("experiments/designs/headline.toml", "experiments/paper/dynamic_gradient.toml")
CALLS = 20


def gradient(path: str) -> float:
    """Milliseconds of processor time for one value with the gradient by every peak rate: the median."""
    import statistics
    import time

    from gradcal_jax.cli.precision import use_float64

    use_float64()
    import jax

    import gradcal_jax as gj

    f = gj.differentiable(gj.read_spec(path))
    name = next(iter(f(f.quantities)))
    of_rates = jax.jit(jax.value_and_grad(lambda rates: f({"peak rates": rates})[name]))
    rates = jax.numpy.asarray(f.quantities["peak rates"])
    times = []
    for _ in range(CALLS):
        begun = time.process_time()
        jax.block_until_ready(of_rates(rates))
        times.append(1e3 * (time.process_time() - begun))
    return statistics.median(times[3:])


def search(path: str) -> float:
    """Seconds of processor time for `gradcal optimise --quick`."""
    import time

    from gradcal_jax.cli import main

    with tempfile.TemporaryDirectory() as folder:
        begun = time.process_time()
        main(["optimise", path, "--quick", "--json", "--output", f"{folder}/recipe.toml"])
        return time.process_time() - begun


def measured(what: str, path: str, native: str) -> float:
    """`gradient` or `search` in a process of its own, the second time."""
    command = [sys.executable, __file__, what, path]
    for _ in range(2):
        done = subprocess.run(
            command, env={**os.environ, "GRADCAL_NATIVE": native}, capture_output=True, text=True, check=True
        )
    return float(done.stdout.splitlines()[-1])


def main() -> None:
    for what, path in (*(("gradient", p) for p in SPECS), ("search", SPECS[0])):
        slow, quick = (measured(what, path, native) for native in ("0", "1"))
        print(f"| {what}, {path} | {slow:.2f} | {quick:.2f} | {slow / quick:.2f} |")


if __name__ == "__main__":
    if len(sys.argv) > 1:
        print({"gradient": gradient, "search": search}[sys.argv[1]](sys.argv[2]))
    else:
        main()
