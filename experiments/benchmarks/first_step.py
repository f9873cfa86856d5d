"""Processor time until a search has made its first step, nothing compiled before, and of single predictions.

    python experiments/benchmarks/first_step.py [--against CHECKOUT] [--runs N] [--write FILE]

Each figure is the least of some runs, every one in a process of its own; those of another checkout of the program, with
which it is compared, alternate with them. A first step is all from the spec to the first value and gradient of the
objective and the plan of that point; a prediction is one of the points of `sweep.toml`.
"""

import argparse
import os
import platform
import subprocess
import sys
import time
from datetime import UTC, datetime
from pathlib import Path

HERE = Path(__file__).resolve().parent
CASES = {
    "first step, one axis": "../designs/headline.toml",
    "first step, IMU": "../imu/hand2.toml",
    "a prediction": "sweep.toml",
}
POINTS = 100


def of_step(path: Path) -> float:
    """Seconds of processor time of a first step."""
    from gradcal_jax.cli.precision import use_float64

    # As in the command line, before JAX is imported: afterwards memory and garbage collection stay as they are.
    use_float64()

    import jax
    import jax.numpy as jnp

    from gradcal_jax.design.cycle_plan import CyclePlan
    from gradcal_jax.design.visits import visit_choices
    from gradcal_jax.spec.design import Design
    from gradcal_jax.spec.spec import read_spec

    begun = time.process_time()
    spec = read_spec(path)
    plan = CyclePlan(spec, visit_choices(spec, spec.design or Design())[0] if spec.turns_one_gyro else None)
    start = plan.starts()[0]
    of = plan.coordinates.structure(start.turns)
    reached = plan.descent(plan.point(start), (jax.tree.map(jnp.asarray, of), 8.0), evaluations=1)
    plan.at(reached.point, of)
    return time.process_time() - begun


def of_predictions(path: Path) -> float:
    """Seconds of processor time of a prediction."""
    import numpy as np

    from gradcal_jax.information.prediction import requirement_rows
    from gradcal_jax.spec.changes import changed
    from gradcal_jax.sweeps.sweep import changes_of
    from gradcal_jax.sweeps.sweep_file import read_sweep

    job = read_sweep(path)
    points = changes_of(job)
    chosen = np.random.default_rng(0).choice(len(points), POINTS, replace=False)
    requirement_rows(job.base)
    begun = time.process_time()
    for k in chosen:
        requirement_rows(changed(job.base, points[int(k)]))
    return (time.process_time() - begun) / POINTS


def measured(case: str, checkout: Path) -> float:
    one_thread = dict.fromkeys(("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS"), "1")
    done = subprocess.run(
        [sys.executable, __file__, "--case", case],
        env={**os.environ, **one_thread, "PYTHONPATH": str(checkout), "JAX_ENABLE_COMPILATION_CACHE": "false"},
        capture_output=True,
        text=True,
        check=False,
    )
    if done.returncode:
        raise SystemExit(done.stderr)
    return float(done.stdout.split()[-1])


def main() -> None:
    parser = argparse.ArgumentParser(description=(__doc__ or "").splitlines()[0])
    parser.add_argument("--against", metavar="CHECKOUT", type=Path, help="another checkout of the program")
    parser.add_argument("--runs", type=int, default=2)
    parser.add_argument("--write", metavar="FILE", help="the table in Markdown, besides the screen")
    parser.add_argument("--case", help=argparse.SUPPRESS)
    asked = parser.parse_args()
    if asked.case:
        path = HERE / CASES[asked.case]
        print(of_predictions(path) if path.name == "sweep.toml" else of_step(path))
        return
    checkouts = {"now": HERE.parent.parent} | ({"before": asked.against} if asked.against else {})
    lines = [
        "# Benchmark of first steps",
        "",
        f"{datetime.now(UTC):%Y-%m-%d}, {os.cpu_count()} cores beside other work, Python {platform.python_version()}; "
        f"`python experiments/benchmarks/first_step.py`, the least of {asked.runs} runs. Processor time, s.",
        "",
        "| | " + " | ".join(checkouts) + " |",
        "|---" * (1 + len(checkouts)) + "|",
    ]
    for case in CASES:
        runs = [[measured(case, of) for of in checkouts.values()] for _ in range(asked.runs)]
        lines.append(f"| {case} | " + " | ".join(f"{min(of):.3g}" for of in zip(*runs, strict=True)) + " |")
    text = "\n".join(lines) + "\n"
    print(text)
    if asked.write:
        Path(asked.write).write_text(text, encoding="utf-8")


if __name__ == "__main__":
    main()
