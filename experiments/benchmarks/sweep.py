"""How many plans a second? `gradcal sweep` against a Python loop over a FilterPy model, each in processes of its own.

    python experiments/benchmarks/sweep.py [--sample N] [--workers N] [--write FILE]

The sweep is `sweep.toml`, 10 000 predictions, as a user runs it: reading, compiling, computing, writing, from an empty
cache and from a full one. The loop is the textbook filter with the parameters in its state, reading by reading; its
regressors and its noise matrices are given to it and not timed, which spares it a good part of the work. It does a
sample of the points, drawn by seed, and the rest is extrapolated. Each of its points is compared with the sweep's.
"""

import argparse
import json
import os
import platform
import subprocess
import sys
import tempfile
import time
from datetime import UTC, datetime
from pathlib import Path

HERE = Path(__file__).resolve().parent


def loop(points: list[dict]) -> None:
    """The peer's process: for each point (changes of the base) its seconds and its residual, as JSON."""
    import importlib.metadata

    import jax

    jax.config.update("jax_enable_x64", True)
    import numpy as np
    from filterpy.kalman import KalmanFilter

    from gradcal_jax.information import imu_system
    from gradcal_jax.information.residual import residual_of
    from gradcal_jax.model.build import build_imu
    from gradcal_jax.spec.changes import changed
    from gradcal_jax.sweeps.sweep_file import read_sweep

    base = read_sweep(HERE / "sweep.toml").base
    found = []
    for changes in points:
        spec = changed(base, changes)
        built = build_imu(spec)
        steps, columns = imu_system(built.motion, built.model, built.body_nodes())
        transition, covariance, seen = (np.asarray(x) for x in (steps.transition, steps.covariance, steps.observation))
        variance, used, initial = (np.asarray(x) for x in (steps.reading_variance, steps.used, steps.initial))
        requirement = spec.requirement[0]
        (element,) = residual_of(built, requirement).elements
        rows = np.zeros((len(element.beyond), columns.shape[1]))
        rows[:, element.where] = element.rows[0]
        begin = time.perf_counter()
        n, p = seen.shape[1], columns.shape[1]
        kalman = KalmanFilter(dim_x=n + p, dim_z=1)
        kalman.P = np.zeros((n + p, n + p))
        kalman.P[:n, :n] = initial
        # A prior of 100 % on every coefficient: as good as none against the tens of ppm that are left.
        kalman.P[n:, n:] = np.eye(p)
        f, q, h = np.eye(n + p), np.zeros((n + p, n + p)), np.zeros((1, n + p))
        zero = np.zeros(1)
        for k in range(len(seen)):
            f[:n, :n], q[:n, :n] = transition[k], covariance[k]
            kalman.predict(F=f, Q=q)
            if used[k]:
                h[0, :n], h[0, n:] = seen[k], columns[k]
                kalman.update(zero, R=variance[k], H=h)
        left = np.sqrt(
            np.einsum("gi,ij,gj->g", rows, kalman.P[n:, n:][element.where, element.where], rows, optimize=True)
        )
        ppm = float(np.mean(np.max(left.reshape(requirement.grid), axis=0))) * 1e6
        found.append({"seconds": time.perf_counter() - begin, "ppm": ppm, "readings": int(np.sum(used))})
    print(json.dumps({"version": importlib.metadata.version("filterpy"), "points": found}))


def swept(folder: Path, name: str, workers: int) -> float:
    """Seconds of one whole `gradcal sweep`."""
    output = folder / name
    command = [sys.executable, "-c", "import sys; from gradcal_jax.cli import main; sys.exit(main())", "sweep"]
    command += [str(HERE / "sweep.toml"), "-o", str(output), "--workers", str(workers)]
    begin = time.perf_counter()
    done = subprocess.run(
        command, env={**os.environ, "XDG_CACHE_HOME": str(folder)}, capture_output=True, text=True, check=False
    )
    if done.returncode:
        raise SystemExit(done.stderr)
    return time.perf_counter() - begin


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--sample", type=int, default=12, help="points that the loop does")
    parser.add_argument("--workers", type=int, default=2)
    parser.add_argument("--write", metavar="FILE", help="the table in Markdown, besides the screen")
    parser.add_argument("--loop", action="store_true", help=argparse.SUPPRESS)
    asked = parser.parse_args()
    if asked.loop:
        loop(json.load(sys.stdin))
        return
    import numpy as np

    from gradcal_jax.sweeps.sweep import changes_of, read_dataset
    from gradcal_jax.sweeps.sweep_file import read_sweep

    job = read_sweep(HERE / "sweep.toml")
    points = changes_of(job)
    chosen = np.sort(np.random.default_rng(0).choice(len(points), asked.sample, replace=False))
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        cold, warm = (swept(folder, file, asked.workers) for file in ("cold.nc", "warm.nc"))
        same = (folder / "cold.nc").read_bytes() == (folder / "warm.nc").read_bytes()
        results = read_dataset(folder / "cold.nc")["full_range_mean_of_max"].values.ravel()
    one_thread = dict.fromkeys(("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "MKL_NUM_THREADS"), "1")
    peer = subprocess.run(
        [sys.executable, __file__, "--loop"],
        input=json.dumps([points[int(i)] for i in chosen]),
        env={**os.environ, **one_thread},
        capture_output=True,
        text=True,
        check=False,
    )
    if peer.returncode:
        raise SystemExit(peer.stderr)
    answer = json.loads(peer.stdout.splitlines()[-1])
    rows = answer["points"]
    seconds = np.array([row["seconds"] for row in rows])
    error = float(np.max(np.abs(np.array([row["ppm"] for row in rows]) / results[chosen] - 1.0)))
    per_design = float(np.mean(seconds))
    count = len(points)
    readings = [row["readings"] for row in rows]
    lines = [
        "# Benchmark of sweeps",
        "",
        f"{datetime.now(UTC):%Y-%m-%d}, {os.cpu_count()} cores, Python {platform.python_version()}; "
        "`python experiments/benchmarks/sweep.py`. "
        f"{count} predictions of the paper's dynamic gradient plan over gradient × rest × peak rate.",
        "",
        f"| method | {count} plans, s | plans a second | × the loop |",
        "|---|---|---|---|",
        f"| `gradcal sweep`, {asked.workers} workers, nothing compiled before "
        f"| {cold:.3g} | {count / cold:.4g} | {per_design * count / cold:.3g} |",
        f"| `gradcal sweep`, {asked.workers} workers, programs kept from before "
        f"| {warm:.3g} | {count / warm:.4g} | {per_design * count / warm:.3g} |",
        f"| Python loop over FilterPy {answer['version']}, one core | {per_design * count:.3g} (extrapolated) "
        f"| {1.0 / per_design:.3g} | 1 |",
        "",
        f"* The sweep's times are of the whole command: start, reading {count} specs, compiling, two residual maps of "
        "101 × 121 points and eight statistics for each plan, writing the file. Both runs wrote "
        f"{'the same bytes' if same else 'DIFFERENT bytes'}.",
        f"* The loop did {len(rows)} points, drawn by seed ({min(readings)} to {max(readings)} readings), "
        f"{seconds.min():.3g} to {seconds.max():.3g} s each; the rest is extrapolated. Its regressors and noise "
        "matrices were given to it and are not timed; it computes one residual map. Two such loops on two "
        "cores would halve its time at best.",
        f"* The two agree within {error:.1e} of the residual.",
    ]
    text = "\n".join(lines) + "\n"
    print(text)
    if asked.write:
        Path(asked.write).write_text(text, encoding="utf-8")


if __name__ == "__main__":
    main()
