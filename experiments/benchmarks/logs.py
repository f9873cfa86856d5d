"""How quick are identifications on a long log, and in how much memory? Side by side, each in a process of its own.

    python experiments/benchmarks/logs.py [--samples 10000000] [--times 200] [--rounds 3] [--json FILE]

A simulated record (angle random walk and a Gauss-Markov drift, 100 Hz, float64) is made anew, from one seed, in every
process. Methods of a case answer the same question; the table says by how much their answers differ.

    direct bound   D_θ*(t) for integration times from 1 s to 20 min, over every start:
                   gradcal_jax against the plain passes (a difference of the running angle, its largest magnitude),
                   with temporaries as one would write them, and with every temporary reused
    allan          overlapping Allan deviation at ten averaging times a decade: gradcal_jax against allantools

"peak" is the resident memory of the whole process at its largest: the record (80 MB for ten million samples), its
making and the imports included.
"""

import argparse
import importlib.util
import json
import os
import platform
import resource
import subprocess
import sys
import time
from datetime import UTC, datetime
from pathlib import Path

import numpy as np
from scipy.signal import lfilter

INTERVAL = 0.01
AVERAGE = 10.0
METHODS = {
    "direct bound": {
        "ours": "gradcal_jax, blocks with bounds",
        "plain": "NumPy, difference passes",
        "reused": "NumPy, difference passes, no temporaries",
    },
    "allan": {"ours": "gradcal_jax", "allantools": "allantools, oadev"},
}


def record(samples: int) -> np.ndarray:
    """0.1 deg/√h and a drift of 1 deg/h over 120 s, in deg/h."""
    rng = np.random.default_rng(2026)
    keep = np.exp(-INTERVAL / 120.0)
    drift = lfilter([np.sqrt(1 - keep**2)], [1.0, -keep], rng.standard_normal(samples))
    drift += 0.1 * 60 / np.sqrt(INTERVAL) * rng.standard_normal(samples)
    return drift


def direct_bound_ours(rate: np.ndarray, times: np.ndarray) -> np.ndarray:
    from gradcal_jax.identify.largest_drift import largest_drift

    return largest_drift(rate, INTERVAL, times, AVERAGE).largest_drift[:, 0]


def _angle_and_mean(rate: np.ndarray) -> tuple[np.ndarray, np.ndarray, int]:
    angle = np.concatenate([[0.0], np.cumsum(rate - rate.mean())])
    before = round(AVERAGE / INTERVAL)
    return angle, (angle[before:] - angle[:-before]) / before, before


def direct_bound_plain(rate: np.ndarray, times: np.ndarray) -> np.ndarray:
    angle, mean, before = _angle_and_mean(rate)
    found = []
    for time_s in times:
        k = round(time_s / INTERVAL)
        drift = (angle[before + k :] - angle[before:-k]) / k - mean[:-k]
        found.append(np.max(np.abs(drift)))
    return np.array(found)


def direct_bound_reused(rate: np.ndarray, times: np.ndarray) -> np.ndarray:
    angle, mean, before = _angle_and_mean(rate)
    buffer = np.empty_like(mean)
    found = []
    for time_s in times:
        k = round(time_s / INTERVAL)
        drift = buffer[: len(mean) - k]
        np.subtract(angle[before + k :], angle[before:-k], out=drift)
        drift /= k
        drift -= mean[:-k]
        found.append(max(drift.max(), -drift.min()))
    return np.array(found)


def allan_ours(rate: np.ndarray, times: np.ndarray) -> np.ndarray:
    from gradcal_jax.identify.allan import overlapping_allan

    return overlapping_allan(rate, INTERVAL, times).deviation


def allan_allantools(rate: np.ndarray, times: np.ndarray) -> np.ndarray:
    import allantools

    return allantools.oadev(rate, rate=1 / INTERVAL, data_type="freq", taus=times)[1]


def questions(case: str, samples: int, count: int) -> np.ndarray:
    if case == "direct bound":
        from gradcal_jax.identify.largest_drift import integration_times

        return integration_times(1.0, min(1200.0, samples * INTERVAL / 4), INTERVAL, count=count)
    from gradcal_jax.identify.allan import averaging_times

    return averaging_times(samples, INTERVAL)


def measure(case: str, method: str, samples: int, count: int, rounds: int) -> dict:
    """Run in the method's own process."""
    function = globals()[f"{case.replace(' ', '_')}_{method}"]
    rate = record(samples)
    times = questions(case, samples, count)
    function(rate[: 1 << 18], times[times < (1 << 18) * INTERVAL / 4])  # imports and first calls
    seconds = []
    for _ in range(rounds):
        start = time.perf_counter()
        answer = function(rate, times)
        seconds.append(time.perf_counter() - start)
    peak = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss
    return {
        "seconds": seconds,
        "peak_mb": peak / 1024,
        "times": len(times),
        "answer": answer.tolist(),
    }


def in_own_process(case: str, method: str, samples: int, count: int, rounds: int) -> dict:
    arguments = [sys.executable, __file__, "--measure", case, method]
    arguments += ["--samples", str(samples), "--times", str(count), "--rounds", str(rounds)]
    one_thread = dict.fromkeys(("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "MKL_NUM_THREADS"), "1")
    root = str(Path(__file__).resolve().parents[2])
    path = os.pathsep.join(filter(None, [root, os.environ.get("PYTHONPATH")]))
    done = subprocess.run(
        arguments, capture_output=True, text=True, env={**os.environ, **one_thread, "PYTHONPATH": path}, check=False
    )
    if done.returncode:
        raise RuntimeError(f"{case}, {method}:\n{done.stderr[-2000:]}")
    return json.loads(done.stdout)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.split("\n\n")[0])
    parser.add_argument("--samples", type=int, default=10_000_000)
    parser.add_argument("--times", type=int, default=200)
    parser.add_argument("--rounds", type=int, default=3)
    parser.add_argument("--json", type=Path)
    parser.add_argument("--measure", nargs=2, metavar=("CASE", "METHOD"), help=argparse.SUPPRESS)
    options = parser.parse_args()
    if options.measure:
        print(json.dumps(measure(*options.measure, options.samples, options.times, options.rounds)))
        return

    results: dict[str, dict] = {}
    for case, methods in METHODS.items():
        for method in methods:
            if method == "allantools" and importlib.util.find_spec("allantools") is None:
                print("allantools is not installed: left out", file=sys.stderr)
                continue
            found = in_own_process(case, method, options.samples, options.times, options.rounds)
            results.setdefault(case, {})[method] = found
        ours = results[case]["ours"]
        print(f"\n{case}: {options.samples:,} samples, {ours['times']} times")
        print(f"{'':42} {'seconds':>9} {'against ours':>13} {'peak MB':>8} {'answer differs by':>18}")
        for method, found in results[case].items():
            best = min(found["seconds"])
            differs = np.max(np.abs(np.array(found["answer"]) / np.array(ours["answer"]) - 1))
            print(
                f"{METHODS[case][method]:42} {best:9.3f} {best / min(ours['seconds']):13.1f} "
                f"{found['peak_mb']:8.0f} {differs:18.1e}"
            )
    machine = {"machine": platform.processor() or platform.machine(), "cores": os.cpu_count(), "numpy": np.__version__}
    print(f"\n{machine}; best of {options.rounds}, one thread")
    if options.json:
        report = {"when": datetime.now(UTC).isoformat(timespec="seconds"), **machine, "results": results}
        options.json.write_text(json.dumps(report, indent=1))


if __name__ == "__main__":
    main()
