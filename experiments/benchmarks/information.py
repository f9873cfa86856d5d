"""How quick is the information matrix, and how right? Side by side with other packages, each in a process of its own.

    python experiments/benchmarks/information.py [--quick] [--json FILE] [--only CASE …]

Cases: `small` (6000 readings × 16 parameters, Φ given: G and the gradient of log det G in Φ and in every duration),
`unit` (30 000 rows of a whole unit's six channels × 128, Φ given: processor time on one core), `hand2` (that plan of a
whole unit, compiled as a whole, on one core) and `predict` (the paper's dynamic gradient plan as a whole). Rounds go
through all methods in turn, so that a disturbance of the machine falls on all of them. Peers:
`pip install "gradcal_jax[peers]"`; what is not installed is left out, with the reason.
"""

import argparse
import json
import os
import platform
import statistics
import subprocess
import sys
from datetime import UTC, datetime
from pathlib import Path

HERE = Path(__file__).resolve().parent
METHODS = {
    "ours": "gradcal_jax, whiten",
    "ours_32": "gradcal_jax, vectors of 32 bytes at most (AVX2)",
    "ours_16": "gradcal_jax, vectors of 16 bytes (SSE2)",
    "floor": "floor: ΦᵀΦ of white rows",
    "celerite2_terms": "celerite2, semiseparable solver",
    "tinygp_quasisep": "tinygp, quasiseparable matrices",
    "dynamax_augmented": "dynamax, parameters in the state",
    "filterpy_augmented": "FilterPy, parameters in the state",
}


UNIT_METHODS = {
    "ours": "gradcal_jax, gram",
    "floor": "floor: ΦᵀΦ of white rows",
    "tinygp": "tinygp, quasiseparable matrices",
    "filterpy": "FilterPy, parameters in the state",
}


class Worker:
    """A method in its own process; `ask` sends one request and waits for its answer."""

    def __init__(self, cores: int):
        environment = {**os.environ, "JAX_PLATFORMS": "cpu"}
        if cores == 1:
            environment |= dict.fromkeys(("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "MKL_NUM_THREADS"), "1")
        command = [sys.executable, str(HERE / "peers" / "worker.py"), str(cores)]
        self._process = subprocess.Popen(
            command, stdin=subprocess.PIPE, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True, env=environment
        )

    def ask(self, **request) -> dict:
        assert self._process.stdin is not None
        assert self._process.stdout is not None
        try:
            print(json.dumps(request), file=self._process.stdin, flush=True)
            answer = self._process.stdout.readline()
        except BrokenPipeError:
            answer = ""
        if not answer:
            assert self._process.stderr is not None
            raise RuntimeError(f"{request} ended its process:\n{self._process.stderr.read()[-2000:]}")
        return json.loads(answer)

    def close(self) -> None:
        if self._process.stdin is not None:
            self._process.stdin.close()
        self._process.wait(timeout=60)
        for stream in (self._process.stdout, self._process.stderr):
            if stream is not None:
                stream.close()


def small(count: int, parameters: int, rounds: int, cores: int) -> dict:
    """Times of every method, forward and with gradient: a list of rounds, each a few repetitions."""
    workers, found = {}, {}
    for method in METHODS:
        worker = Worker(cores)
        opened = worker.ask(do="open", method=method, count=count, parameters=parameters, unit="rad")
        if "absent" in opened:
            print(f"{METHODS[method]}: left out, {opened['absent']}", file=sys.stderr)
            worker.close()
            continue
        workers[method] = worker
        found[method] = {"version": opened["version"], "gradient runs": opened["gradient runs"]}
    for method, worker in workers.items():
        tasks = ["forward"] if found[method]["gradient runs"] else ["forward", "gradient"]
        for task in tasks:
            first = worker.ask(do="time", task=task, repeats=3)["seconds"]
            found[method][task] = []
            # As many repetitions a round as fit into a quarter of a second.
            found[method][f"{task} repeats"] = max(1, min(100, int(0.25 / min(first))))
    for _ in range(rounds):
        for method, worker in workers.items():
            for task in ("forward", "gradient"):
                if task in found[method]:
                    repeats = found[method][f"{task} repeats"]
                    found[method][task].append(worker.ask(do="time", task=task, repeats=repeats)["seconds"])
    for worker in workers.values():
        worker.close()
    return found


def errors(count: int, parameters: int) -> dict:
    """Of every method against the recursion in extended precision, in rad and in deg: of G, and of its slopes."""
    sys.path.insert(0, str(HERE))
    import numpy as np
    from peers.problem import dense_information, exact_information, exact_slopes, information_error, make_problem

    found: dict = {"dense": {}}
    for unit in ("rad", "deg"):
        problem = make_problem(count, parameters, unit)
        exact, slopes = exact_information(problem), exact_slopes(problem)
        found["dense"][unit] = {"information": information_error(dense_information(problem), exact)}
        for method in METHODS:
            if method == "floor":
                continue
            worker = Worker(2)
            if "absent" not in worker.ask(do="open", method=method, count=count, parameters=parameters, unit=unit):
                answer = worker.ask(do="check")
                entry = {"information": information_error(np.array(answer["information"]), exact)}
                if answer["slopes"]:
                    scale = np.max(np.abs(slopes))
                    entry["slopes"] = float(np.max(np.abs(np.array(answer["slopes"]) - slopes)) / scale)
                found.setdefault(method, {})[unit] = entry
            worker.close()
    return found


def summary(rounds: list[list[float]]) -> tuple[float, float, float]:
    """Least, median, and the interquartile range as a share of the median, of all repetitions."""
    values = sorted(v for r in rounds for v in r)
    middle = statistics.median(values)
    quarter = statistics.quantiles(values, n=4) if len(values) > 1 else [middle] * 3
    return values[0], middle, (quarter[2] - quarter[0]) / middle


def small_table(found: dict, wrong: dict, cores: int, count: int, parameters: int) -> list[str]:
    """Lines of a table in Markdown; ratios are of the medians within this run."""
    rows = {}
    for method, entry in found.items():
        rows[method] = {task: summary(entry[task]) for task in ("forward", "gradient") if task in entry}
        if entry["gradient runs"]:
            least, middle, spread = rows[method]["forward"]
            runs = entry["gradient runs"]
            rows[method]["gradient"] = (least * runs, middle * runs, spread)
    ours = rows["ours"]
    threads = "one thread" if cores == 1 else "threads as each library likes, 2 cores"
    lines = [
        f"### {count} readings × {parameters} parameters, {threads}",
        "",
        "| method | forward ms: least / median (spread) | × ours "
        "| value + gradient ms: least / median (spread) | × ours "
        "| error of G, rad / deg | error of the gradient, rad / deg |",
        "|---|---|---|---|---|---|---|",
    ]

    def times(entry, task, star=""):
        least, middle, spread = entry[task]
        ratio = middle / ours[task][1]

        def text(v: float) -> str:
            return f"{v * 1e3:.3g}" if v < 100 else f"{v * 1e3:.1e}"

        return (
            f"{text(least)} / {text(middle)} ({spread:.0%}){star} | {ratio:.2g}"
            if ratio < 100
            else (f"{text(least)} / {text(middle)} ({spread:.0%}){star} | {ratio:.0f}")
        )

    def error(method, what):
        values = [wrong.get(method, {}).get(unit, {}).get(what) for unit in ("rad", "deg")]
        return " / ".join("–" if v is None else f"{v:.1e}" for v in values)

    for method, entry in rows.items():
        star = " *" if found[method]["gradient runs"] else ""
        lines.append(
            f"| {METHODS[method]} ({found[method]['version']}) "
            f"| {times(entry, 'forward')} | {times(entry, 'gradient', star)} "
            f"| {error(method, 'information')} | {error(method, 'slopes')} |"
        )
    lines.append(f"| dense generalised least squares, float64 | – | – | – | – | {error('dense', 'information')} | – |")
    return lines


def processor() -> str:
    """Model of the processor, as well as the system tells."""
    try:
        for line in Path("/proc/cpuinfo").read_text().splitlines():
            if line.startswith("model name"):
                return line.split(":", 1)[1].strip()
    except OSError:
        pass
    return platform.processor() or platform.machine()


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--quick", action="store_true", help="small sizes and few rounds: does it run at all?")
    parser.add_argument("--json", metavar="FILE", help="all single times, for other programs")
    parser.add_argument(
        "--only",
        nargs="+",
        choices=("small", "unit", "hand2", "predict"),
        default=("small", "unit", "hand2", "predict"),
    )
    parser.add_argument("--write", metavar="FILE", help="the table in Markdown, besides the screen")
    asked = parser.parse_args()
    count, parameters, rounds = (600, 8, 2) if asked.quick else (6000, 16, 12)
    command = "python experiments/benchmarks/information.py" + (" --quick" if asked.quick else "")
    lines = [
        "# Benchmark of the information matrix",
        "",
        f"{datetime.now(UTC):%Y-%m-%d}, {os.cpu_count()} cores of {processor()}, Python {platform.python_version()}; "
        f"`{command}`. Every method in a process of its own, rounds interleaved; the spread is the interquartile "
        "range. Ratios are of medians within this run.",
        "",
    ]
    record: dict = {"command": command, "processor": processor()}
    if "small" in asked.only:
        wrong = errors(count, parameters)
        record["errors"] = wrong
        for cores in (2, 1):
            found = small(count, parameters, rounds, cores)
            record[f"small, {cores} cores"] = found
            lines += [*small_table(found, wrong, cores, count, parameters), ""]
        lines += [*SMALL_NOTES, ""]
    if "unit" in asked.only:
        lines += [*whole_unit(record, asked.quick), ""]
    if "hand2" in asked.only:
        lines += [*hand2(record, asked.quick), ""]
    if "predict" in asked.only:
        lines += [*prediction(record), ""]
    text = "\n".join(lines)
    print(text)
    if asked.write:
        Path(asked.write).write_text(text)
    if asked.json:
        Path(asked.json).write_text(json.dumps(record, indent=1))


SMALL_NOTES = [
    "* Errors are against the textbook recursion in 80-bit precision: of G, the largest entry's as a share of "
    "√(GᵢᵢGⱼⱼ); of the gradient, its slopes in three random directions against central differences in the same "
    "precision, as a share of the largest.",
    "* The floor whitens nothing: it is the product ΦᵀΦ of given rows, log det and the gradient in Φ.",
    "* celerite2's *kernels* are sums of stationary exponentials and cannot say this model. Its low-level solver can, "
    "with one decay of zero and factors that depend on time; that is what is timed (C++ driver forward, its JAX "
    "operations for the gradient).",
    "* Ours goes through the instants in one scan of JAX and makes the product of the rows; a second scan, backwards, "
    "and some products give the gradient.",
    "* dynamax adds an absolute 1e-9 to the innovation's variance, which in radians is not small: hence its error, and "
    "hence the difference between rad and deg.",
    "* FilterPy has no gradient; the starred figure is its forward time × the N·p + N + 1 runs that one-sided "
    "differences take (extrapolated, not run).",
]


def whole_unit(record: dict, quick: bool) -> list[str]:
    """Rows of a whole unit: processor time of every method on one core, rounds interleaved."""
    count, parameters, rounds = (300, 12, 2) if quick else (30_000, 128, 7)
    workers, found = {}, {}
    for method, name in UNIT_METHODS.items():
        worker = Worker(1)
        opened = worker.ask(do="unit", method="imu_methods", what="open", of=method, count=count, parameters=parameters)
        if "absent" in opened:
            print(f"{name}: left out, {opened['absent']}", file=sys.stderr)
            worker.close()
            continue
        workers[method], found[method] = worker, opened | {"forward": [], "gradient": []}
    for number in range(rounds + 1):
        for method, worker in workers.items():
            for task in ("forward", "gradient") if method != "filterpy" else ("forward",):
                seconds = worker.ask(do="unit", method="imu_methods", what="time", task=task, repeats=1)["seconds"]
                if number:  # The first one compiles.
                    found[method][task].append(seconds)
    for worker in workers.values():
        worker.close()
    record["unit"] = found
    lines = [
        f"### A whole unit: {count} rows of six channels × {parameters} parameters, 16 states, processor time",
        "",
        "| method | forward ms: least / median (spread) | × ours | value + gradient ms: least / median (spread) "
        "| × ours |",
        "|---|---|---|---|---|",
    ]
    rows = {m: {t: summary(e[t]) for t in ("forward", "gradient") if e[t]} for m, e in found.items()}
    for method, row in rows.items():
        cells, star = [], "" if found[method]["share"] == 1.0 else " *"
        for task in ("forward", "gradient"):
            if task not in row:
                cells += ["–", "–"]
                continue
            least, middle, spread = row[task]
            share = found[method]["share"]
            cells += [f"{least / share * 1e3:.3g} / {middle / share * 1e3:.3g} ({spread:.0%}){star}"]
            cells += [f"{least / share / rows['ours'][task][0]:.2g}"]
        lines.append(f"| {UNIT_METHODS[method]} ({found[method]['version']}) | {' | '.join(cells)} |")
    return [
        *lines,
        "",
        "* On one core. The gradient is in Φ and in all durations. Ratios are of the least times within this run.",
        "* celerite2 cannot say these rows: its states decay one by one, and an integral that begins anew, or an "
        "encoder's error that is passed on, is no such decay. dynamax could, and would hold 30 000 covariances of "
        "144 × 144 for its result, 5 GB. The starred figure is of a hundredth of the rows, times a hundred.",
    ]


def hand2(record: dict, quick: bool) -> list[str]:
    """The plan `hand2`, compiled from its numbers to the standard deviations: processor time on one core."""
    worker = Worker(1)
    answer = worker.ask(do="hand2", method="imu_methods", repeats=2 if quick else 40)
    worker.close()
    record["hand2"] = answer
    rows = [(name, summary([answer[name]])) for name in ("forward", "gradient")]
    return [
        "### The plan hand2 of a whole unit, compiled as a whole, one core, processor time",
        "",
        "| what | ms: least / median (spread) |",
        "|---|---|",
        *(
            f"| {name} | {least * 1e3:.3g} / {middle * 1e3:.3g} ({spread:.0%}) |"
            for name, (least, middle, spread) in rows
        ),
        "",
        "* From all numbers of motion, geometry, noise and priors to the logarithms of the 132 standard deviations; "
        "the gradient is in all those numbers.",
    ]


def prediction(record: dict) -> list[str]:
    """The paper's dynamic gradient plan: its steps, and the whole of `predict` as a user calls it."""
    worker = Worker(2)
    answer = worker.ask(do="predict", method="prediction")
    worker.close()
    record["predict"] = answer
    lines = [
        "### The paper's dynamic gradient plan as a whole",
        "",
        f"{answer['pieces']} pieces, {answer['readings']} readings, {answer['parameters']} parameters.",
        "",
        "| what | ms: least / median (spread) |",
        "|---|---|",
    ]
    for name, seconds in answer["times"].items():
        least, middle, spread = summary([seconds])
        lines.append(f"| {name} | {least * 1e3:.3g} / {middle * 1e3:.3g} ({spread:.0%}) |")
    return lines


if __name__ == "__main__":
    main()
