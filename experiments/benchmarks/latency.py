"""How soon does a command answer? Processor and wall time of fresh processes, as ratios to `import jax`.

    python experiments/benchmarks/latency.py [--before CHECKOUT] [--only CASE …] [--output FILE]

Every case runs twice: *cold*, with an empty folder for what is compiled, and *warm*, again with the same folder and the
same spec. "New numbers": after the spec, warm, with another drift and other rates. "New sizes": warm, with more moves.
`--before`: an older checkout of this repository, whose package is measured in the same run, case by case in turn, so
that a disturbance of the machine falls on both. What it refuses (an option that it has not) is left out.
"""

import argparse
import os
import platform
import resource
import subprocess
import sys
import tempfile
import time
from pathlib import Path
from typing import NamedTuple

ROOT = Path(__file__).resolve().parents[2]
# Relative to a checkout: an older one reads its own files.
SPEC = Path("experiments") / "designs" / "headline.toml"
IMU = Path("experiments") / "imu" / "hand2.toml"
SWEEP = ROOT / "experiments" / "benchmarks" / "sweep.toml"
RECIPE = ROOT / "experiments" / "recipes" / "headline.toml"
GRADCAL = (sys.executable, "-c", "import sys; from gradcal_jax.cli import main; sys.exit(main(sys.argv[1:]))")


class Case(NamedTuple):
    """A command; `{s}` stands for the spec, `{imu}` for that of an IMU, `{o}` for a file to write. `until`: what
    ends it, seen so `often` in its output: an axis's first line says where random starts stand, the second one where
    the first descent ended."""

    name: str
    command: tuple[str, ...]
    spec: str = "same"
    until: str | None = None
    often: int = 2


CASES = (
    Case("import jax", (sys.executable, "-c", "import jax")),
    Case("gradcal --help", (*GRADCAL, "--help")),
    Case("check", (*GRADCAL, "check", "{s}")),
    Case("predict", (*GRADCAL, "predict", "{s}")),
    Case("predict, new numbers", (*GRADCAL, "predict", "{s}"), "numbers"),
    Case("predict, new sizes", (*GRADCAL, "predict", "{s}"), "sizes"),
    Case("optimise, first step", (*GRADCAL, "optimise", "{s}", "-o", "{o}", "--force"), until="ppm"),
    Case("optimise an IMU, first step", (*GRADCAL, "optimise", "{imu}", "-o", "{o}", "--force"), until="->", often=1),
    Case("optimise --quick", (*GRADCAL, "optimise", "{s}", "-o", "{o}", "--force", "--quick")),
    Case("optimise", (*GRADCAL, "optimise", "{s}", "-o", "{o}", "--force")),
    Case("limit", (*GRADCAL, "limit", "{s}")),
    Case("sensitivity", (*GRADCAL, "sensitivity", "{s}")),
    Case("sweep", (*GRADCAL, "sweep", str(SWEEP), "-o", "{o}", "--workers", "1")),
    Case("report", (*GRADCAL, "report", str(RECIPE), "-o", "{o}", "--force")),
)


class Times(NamedTuple):
    """Of a process and its children, s."""

    processor: float
    wall: float


def spec_of(case: Case, package: Path, folder: Path) -> Path:
    """The headline's spec of a checkout, or one that differs from it as the case says."""
    text = (package / SPEC).read_text(encoding="utf-8")
    if case.spec != "same":
        text = text.replace('"1 deg/h"', '"1.3 deg/h"').replace('"0.1 deg/sqrt(h)"', '"0.13 deg/sqrt(h)"')
    if case.spec == "sizes":
        lines = text.splitlines()
        turn = next(i for i, line in enumerate(lines) if line.lstrip().startswith("{ rest"))
        text = "\n".join([*lines[:turn], lines[turn], *lines[turn:]])
    path = folder / f"{case.spec}.toml"
    path.write_text(text, encoding="utf-8")
    return path


def timed(case: Case, package: Path, cache: Path, folder: Path) -> Times | None:
    """One run in a process of its own; None where it fails."""
    spec, output = spec_of(case, package, folder), folder / ("out.nc" if case.name == "sweep" else "out.toml")
    output = output.with_suffix(".html") if case.name == "report" else output
    output.unlink(missing_ok=True)
    command = [
        part.replace("{s}", str(spec)).replace("{imu}", str(package / IMU)).replace("{o}", str(output))
        for part in case.command
    ]
    environment = {**os.environ, "PYTHONPATH": str(package), "XDG_CACHE_HOME": str(cache), "JAX_PLATFORMS": "cpu"}
    before, begin = resource.getrusage(resource.RUSAGE_CHILDREN), time.perf_counter()
    process = subprocess.Popen(
        command, env=environment, cwd=folder, stdout=subprocess.DEVNULL, stderr=subprocess.PIPE, text=True
    )
    assert process.stderr is not None
    seen = 0
    for line in process.stderr:
        seen += case.until is not None and case.until in line
        if seen == case.often:
            process.kill()
            break
    process.stderr.close()
    status, wall = process.wait(), time.perf_counter() - begin
    after = resource.getrusage(resource.RUSAGE_CHILDREN)
    ends = seen == case.often if case.until else status in (0, 1)
    processor = after.ru_utime + after.ru_stime - before.ru_utime - before.ru_stime
    return Times(processor, wall) if ends else None


def table(found: dict[tuple[str, str, str], Times | None], packages: list[str]) -> str:
    """What has been measured, in Markdown."""
    unit = {which: found["import jax", which, "warm"] for which in packages}
    lines = [
        "# How soon a command answers",
        "",
        f"`python experiments/benchmarks/latency.py`: the headline's spec on {os.cpu_count()} cores "
        f"({platform.machine()}), Python {platform.python_version()}, at a load of {os.getloadavg()[2]:.1f}. "
        "Processor and wall time in s, in brackets as a ratio to `import jax`.",
        "",
        "| command | which | cold, processor | cold, wall | warm, processor | warm, wall |",
        "|---|---|---|---|---|---|",
    ]
    for name in dict.fromkeys(key[0] for key in found):
        for which in packages:
            row = [name, which]
            for state in ("cold", "warm"):
                times, one = found.get((name, which, state)), unit[which]
                row += ["", ""] if times is None or one is None else [
                    f"{t:.2f} ({t / o:.1f})" for t, o in zip(times, one, strict=True)
                ]  # fmt: skip
            lines.append(f"| {' | '.join(row)} |")
    return "\n".join(lines) + "\n"


def main() -> int:
    """Measure, and write a table."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--before", type=Path)
    parser.add_argument("--only", nargs="+", choices=[case.name for case in CASES])
    parser.add_argument("--output", type=Path, default=Path(__file__).with_suffix(".md"))
    given = parser.parse_args()
    packages = {"now": ROOT} | ({} if given.before is None else {"before": given.before.resolve()})
    cases = [case for case in CASES if given.only is None or case.name in ("import jax", *given.only)]
    found: dict[tuple[str, str, str], Times | None] = {}
    with tempfile.TemporaryDirectory() as scratch:
        for case in cases:
            for which, package in packages.items():
                # New numbers and sizes come after the spec itself: their folder is its.
                base = case.name.split(",")[0] if case.spec != "same" else case.name
                folder = Path(scratch) / which / base.replace(" ", "-")
                folder.mkdir(parents=True, exist_ok=True)
                for state in ("cold", "warm") if case.spec == "same" else ("warm",):
                    found[case.name, which, state] = timed(case, package, folder / "cache", folder)
                    print(case.name, which, state, found[case.name, which, state], flush=True)
            given.output.write_text(table(found, list(packages)), encoding="utf-8")
    return 0


if __name__ == "__main__":
    sys.exit(main())
