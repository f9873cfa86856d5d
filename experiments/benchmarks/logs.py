"""How quick are identifications on a long log, and in how much memory? Side by side, each in a process of its own.

    python experiments/benchmarks/logs.py [--samples 10000000] [--times 200] [--rounds 3] [--json FILE] [--table FILE]

A simulated record (angle random walk and a Gauss-Markov drift, 100 Hz, float64) is made anew, from one seed, in every
process. Methods of a case answer the same question; the table says by how much their answers differ.

    direct bound   D_θ*(t) for integration times from 1 s to 20 min, over every start:
                   gradcal_jax against the plain passes (a difference of the running angle, its largest magnitude),
                   with temporaries as one would write them, and with every temporary reused
    allan          overlapping Allan deviation at ten averaging times a decade: gradcal_jax against allantools
    estimate       a calibration (cubic bias, 4 x 4 scale factor) from a log with temperature, table angle and
                   standstills: gradcal_jax, from raw samples to parameters with covariance and tests of the fit,
                   against one pass over the samples that only sums the same regressors between readings (NumPy), and
                   against that pass with ordinary least squares of the moves' angles behind it: quicker, and without
                   a noise model; its answers differ by what it leaves out

"peak" is the resident memory of the whole process at its largest: the record (80 MB for ten million samples; 400 MB for
a log), its making and the imports included.
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
    "estimate": {
        "ours": "gradcal_jax, calibration with covariance",
        "pass": "NumPy, one pass over the regressors alone",
        "least squares": "NumPy, that pass and least squares",
    },
}
SPEC = """
format = "gradcal-spec/1"
title = "long log"
[sensor]
quantity = "gyro"
angle_random_walk = "0.1 deg/sqrt(h)"
[[sensor.drift]]
standard_deviation = "1 deg/h"
correlation_time = "120 s"
[sensor.bias]
temperature = { basis = "polynomial", degree = 3, centre = "20 degC", scale = "50 K" }
[sensor.scale_factor]
temperature = { basis = "polynomial", degree = 3, centre = "20 degC", scale = "50 K" }
rate = { basis = "polynomial", degree = 3, scale = "300 deg/s" }
[rig.table]
max_rate = "300 deg/s"
max_acceleration = "1500 deg/s^2"
[rig.table.angle]
reading_noise = "3 arcsec"
[rig.chamber]
range = ["-40 degC", "85 degC"]
max_heating = "2 K/min"
max_cooling = "2 K/min"
[[requirement]]
name = "full range"
quantity = "scale_factor"
temperature = ["-30 degC", "70 degC"]
rate = ["-300 deg/s", "300 deg/s"]
[plan]
method = "gradient"
temperature = ["-30 degC", "70 degC"]
gradient = "1 K/min"
[plan.cycle]
moves = [
  { rest = "10 s", read_every = "1 s" },
  { turns = 4, peak_rate = "300 deg/s", shape = "cosine ramps" },
  { turns = -4, peak_rate = "300 deg/s", shape = "cosine ramps" },
]
"""
# Of the log's cycle: rest, a turn of cosine shape to one of these rates, rest, and back.
RATES = np.radians([300.0, 150.0, 10.0, 220.0, 60.0])
REST, TURN = 20.0, 10.0
DEG_PER_H = 180.0 / np.pi * 3600.0
TRUTH = 1e-3


def record(samples: int) -> np.ndarray:
    """0.1 deg/√h and a drift of 1 deg/h over 120 s, in deg/h."""
    rng = np.random.default_rng(2026)
    keep = np.exp(-INTERVAL / 120.0)
    drift = lfilter([np.sqrt(1 - keep**2)], [1.0, -keep], rng.standard_normal(samples))
    drift += 0.1 * 60 / np.sqrt(INTERVAL) * rng.standard_normal(samples)
    return drift


def direct_bound_ours(rate: np.ndarray, times: np.ndarray) -> np.ndarray:
    from gradcal_jax.identify.largest_drift import largest_drift

    return largest_drift(rate, INTERVAL, times, AVERAGE).largest_drift


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


def calibration_log(samples: int):
    """Ramping up and down between -30 and 70 °C at 1 K/min, as long as it takes; b00 is `TRUTH`, all else zero."""
    from gradcal_jax.records.log import Log

    time_s = INTERVAL * np.arange(samples)
    cycle, into = np.divmod(time_s, 2.0 * (REST + TURN))
    turning = np.mod(into, REST + TURN) >= REST
    phase = 2.0 * np.pi * (np.mod(into, REST + TURN) - REST) / TURN
    peak = np.where(into < REST + TURN, 1.0, -1.0) * RATES[cycle.astype(int) % len(RATES)]
    motion = np.where(turning, 0.5 * peak * (1.0 - np.cos(phase)), 0.0)
    del phase, peak, cycle
    motion[0] = 0.0
    angle = np.cumsum(motion) * INTERVAL
    rng = np.random.default_rng(7)
    table = angle + np.radians(3.0 / 3600.0) * rng.standard_normal(samples)
    temperature = -30.0 + 100.0 * np.abs(np.mod(time_s / 6000.0, 2.0) - 1.0)
    standing = ~turning
    begins = standing & ~np.concatenate([[False], standing[:-1]])
    return Log(
        time_s=time_s,
        rate_rad_per_s=(motion * (1.0 + TRUTH) + record(samples) / DEG_PER_H)[None, :, None],
        units=("simulated",),
        axes=("x",),
        temperature_c=temperature[None],
        table_axes=("x",),
        table_angle_rad=table[:, None],
        standstill=np.where(standing, np.cumsum(begins) - 1, -1),
        simulated=True,
    )


def estimate_ours(log, times: np.ndarray) -> np.ndarray:
    import jax

    jax.config.update("jax_enable_x64", True)
    from gradcal_jax.estimation.estimate import estimate_log
    from gradcal_jax.spec.spec import parse_spec

    (one,) = estimate_log(parse_spec(SPEC), [log]).sensors
    return 1.0 + _scale_factors(one.solution.parameters, one.built.model.channels[0].model)


def _scale_factors(parameters: np.ndarray, model) -> np.ndarray:
    """On a grid of temperatures and rates."""
    from gradcal_jax.model import SCALE_FACTOR

    warm, fast = (g.ravel() for g in np.meshgrid(np.linspace(-20, 60, 9), RATES, indexing="ij"))
    return model.scale.values(warm, fast) @ parameters[model.where(SCALE_FACTOR)]


def _summed(log, rows_at_once: int = 1 << 16) -> tuple[np.ndarray, np.ndarray]:
    """Regressors and angle errors between readings, a second apart at rest and over whole turns, in one pass."""
    time_s, rate = log.time_s, log.rate_rad_per_s[0, :, 0]
    warm, standing = log.temperature_c[0], log.standstill >= 0
    ends = np.flatnonzero(standing & ((np.arange(len(time_s)) % round(1.0 / INTERVAL) == 0) | ~np.roll(standing, 1)))
    sums = np.zeros((len(ends) + 1, 21))
    for begin in range(0, len(time_s), rows_at_once):
        part = slice(begin, begin + rows_at_once)
        z, w = (warm[part] - 20.0) / 50.0, rate[part]
        powers = np.stack([np.ones_like(z), z, z**2, z**3], axis=1)
        by_rate = np.stack([w, w**2, w**3, w**4], axis=1)
        values = np.concatenate([powers, (powers[:, :, None] * by_rate[:, None, :]).reshape(len(z), 16), w[:, None]], 1)
        piece = np.searchsorted(ends, np.arange(begin, begin + len(z)))
        first = np.flatnonzero(np.diff(piece, prepend=-1))
        sums[piece[first]] += np.add.reduceat(values * INTERVAL, first, axis=0)
    sums = sums[1:-1]
    return sums[:, :20], sums[:, 20] - np.diff(log.table_angle_rad[ends, 0])


def estimate_pass(log, times: np.ndarray) -> np.ndarray:
    _summed(log)
    return np.zeros(0)  # it answers nothing: the time of reading everything once


def estimate_least_squares(log, times: np.ndarray) -> np.ndarray:
    columns, errors = _summed(log)
    size = np.linalg.norm(columns, axis=0)
    found = np.linalg.lstsq(columns / size, errors)[0] / size
    warm, fast = (g.ravel() for g in np.meshgrid((np.linspace(-20, 60, 9) - 20.0) / 50.0, RATES, indexing="ij"))
    values = np.stack([warm**i for i in range(4)], 1)[:, :, None] * np.stack([fast**j for j in range(4)], 1)[:, None]
    return 1.0 + values.reshape(len(warm), 16) @ found[4:]


def questions(case: str, samples: int, count: int) -> np.ndarray:
    if case == "direct bound":
        from gradcal_jax.identify.largest_drift import integration_times

        return integration_times(1.0, min(1200.0, samples * INTERVAL / 4), INTERVAL, count=count)
    if case == "estimate":
        return np.zeros(0)
    from gradcal_jax.identify.allan import averaging_times

    return averaging_times(samples, INTERVAL)


def measure(case: str, method: str, samples: int, count: int, rounds: int) -> dict:
    """Run in the method's own process."""
    function = globals()[f"{case} {method}".replace(" ", "_")]
    times = questions(case, samples, count)
    if case == "estimate":
        rate = calibration_log(samples)  # the first round compiles; the best is of the others
        rounds += 1
    else:
        rate = record(samples)
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


def table(results: dict[str, dict], machine: str, samples: int, rounds: int) -> str:
    """Markdown."""
    lines = [
        "# Benchmark of identification and estimation on a long log",
        "",
        f"{machine}; `python experiments/benchmarks/logs.py`. Every method in a process of its own, one thread, the "
        f"best of {rounds}. {samples:,} samples at 100 Hz, float64, simulated.",
    ]
    for case, methods in results.items():
        ours = methods["ours"]
        asked = f", {ours['times']} integration times" if ours["times"] else ""
        lines += ["", f"### {case}{asked}", "", "| method | seconds | × ours | peak MB | answer differs by |"]
        lines += ["|---|---|---|---|---|"]
        for method, found in methods.items():
            best, answer = min(found["seconds"]), np.array(found["answer"])
            differs = f"{np.max(np.abs(answer / np.array(ours['answer']) - 1)):.1e}" if len(answer) else "–"
            lines.append(
                f"| {METHODS[case][method]} | {best:.2f} | {best / min(ours['seconds']):.2g} | {found['peak_mb']:.0f} "
                f"| {'–' if method == 'ours' else differs} |"
            )
    notes = (
        "Peak memory is the whole process's: the record, its making and the imports included (a log of ten million "
        "rows is 400 MB before anything is done with it).",
        "The estimate goes over the samples once a round, three rounds here, since the regressors of a scale factor "
        "need rates that the map itself corrects; whitening, solving and the tests of the fit are in its time. The "
        "pass that it is held against only sums the regressors.",
        "Least squares without a noise model finds almost the same map here, with nothing to say of its error.",
    )
    return "\n".join([*lines, "", *(f"* {note}" for note in notes)]) + "\n"


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.split("\n\n")[0])
    parser.add_argument("--samples", type=int, default=10_000_000)
    parser.add_argument("--times", type=int, default=200)
    parser.add_argument("--rounds", type=int, default=3)
    parser.add_argument("--json", type=Path)
    parser.add_argument("--table", type=Path, help="write the table as Markdown")
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
            print(f"{case}, {method}: {min(found['seconds']):.2f} s", file=sys.stderr)
    when = datetime.now(UTC)
    machine = f"{when:%Y-%m-%d}, {os.cpu_count()} cores of {processor()}, NumPy {np.__version__}"
    text = table(results, machine, options.samples, options.rounds)
    print(text)
    if options.table:
        options.table.write_text(text, encoding="utf-8")
    if options.json:
        report = {"when": when.isoformat(timespec="seconds"), "machine": machine, "results": results}
        options.json.write_text(json.dumps(report, indent=1), encoding="utf-8")


def processor() -> str:
    """What the system calls its processor."""
    try:
        lines = Path("/proc/cpuinfo").read_text(encoding="utf-8").splitlines()
        return next(line.split(":", 1)[1].strip() for line in lines if line.startswith("model name"))
    except (OSError, StopIteration):
        return platform.processor() or platform.machine()


if __name__ == "__main__":
    main()
