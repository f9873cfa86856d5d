"""Make every report of evidence again, or say which of them are of an older program.

    python experiments/evidence/all.py             # what is stale, in turn; can be stopped and started again
    python experiments/evidence/all.py --status    # which reports are of today's rooms
    python experiments/evidence/all.py faults      # one report, in any case

Each report ends with a line that names commit, machine, duration and the digest of the rooms that it proves. A report
is stale if its digest is not that of the rooms as they stand: docstrings and comments do not count.
"""

import argparse
import ast
import hashlib
import os
import platform
import re
import subprocess
import sys
import time
from dataclasses import dataclass
from pathlib import Path

ROOT = Path(__file__).resolve().parents[2]
REPORTS = Path(__file__).resolve().parent
_STAMP = re.compile(r"^Program (\S+) \(rooms ([0-9a-f]{12})\), .*$\n?", re.MULTILINE)

PLANNING = ("model", "motion", "information", "design", "spec")
ESTIMATES = ("model", "motion", "information", "estimation", "records", "spec")
RUNS = (*ESTIMATES, "hardware", "recipe")


@dataclass(frozen=True)
class Report:
    """A committed report: its file, the tests or the script that write it, the rooms that it proves."""

    name: str
    tests: tuple[str, ...]
    rooms: tuple[str, ...]

    @property
    def path(self) -> Path:
        """The report's file."""
        return REPORTS / f"{self.name}.md"


ALL = (
    Report("faults", ("tests/evidence/test_injected_faults.py",), ESTIMATES),
    Report("presets", ("tests/evidence/test_every_preset.py",), RUNS),
    Report("random_plans", ("tests/evidence/test_random_plans.py",), RUNS),
    Report("tests_of_the_fit", ("tests/evidence/test_started_rigs.py",), RUNS),
    Report("gravity", ("tests/evidence/test_gravity_as_encoder.py",), RUNS),
    Report("records", ("experiments/evidence/records.py",), ("records", "identify")),
    Report("mutations", ("experiments/evidence/mutations.py",), (*RUNS, "calibration", "cli", "pages", "sweeps")),
    Report("hardware", ("tests/hardware",), RUNS),
    Report("proofs", ("tests", "--ignore=tests/evidence", "--ignore=tests/hardware"), (*RUNS, "design", "identify")),
)


def _without_docstrings(tree: ast.Module) -> ast.Module:
    for node in ast.walk(tree):
        if isinstance(node, ast.Module | ast.ClassDef | ast.FunctionDef | ast.AsyncFunctionDef):
            first = node.body[0] if node.body else None
            if isinstance(first, ast.Expr) and isinstance(first.value, ast.Constant):
                node.body = node.body[1:]
    return tree


def _digest_of_room(folder: Path) -> str:
    total = hashlib.sha256()
    for path in sorted(folder.rglob("*.py")):
        tree = _without_docstrings(ast.parse(path.read_text(encoding="utf-8")))
        total.update(f"{path.relative_to(folder)}\n{ast.dump(tree)}\n".encode())
    return total.hexdigest()


def digest_of_rooms(rooms: tuple[str, ...], known: dict[str, str] | None = None) -> str:
    """Twelve hexadecimal digits of the code of `rooms`, without docstrings and comments; `known`: rooms read before."""
    known = {} if known is None else known
    total = hashlib.sha256()
    for room in sorted(set(rooms)):
        if room not in known:
            known[room] = _digest_of_room(ROOT / "gradcal_jax" / room)
        total.update(f"{room} {known[room]}\n".encode())
    return total.hexdigest()[:12]


def stamp_of(report: Report) -> str | None:
    """The digest that stands in the report; None without a stamp or a file."""
    if not report.path.exists():
        return None
    stamp = _STAMP.search(report.path.read_text(encoding="utf-8"))
    return stamp[2] if stamp else None


def stale() -> list[Report]:
    """The reports of a program other than today's."""
    known: dict[str, str] = {}
    return [report for report in ALL if stamp_of(report) != digest_of_rooms(report.rooms, known)]


def _git(*words: str) -> str:
    return subprocess.run(["git", *words], cwd=ROOT, capture_output=True, text=True, check=True).stdout.strip()


def _commit() -> str:
    """Today's commit; "-dirty" where the program or its proofs differ from it (reports of this run do not count)."""
    dirty = _git("status", "--porcelain", "--", "gradcal_jax", "tests", "experiments/*.py")
    return _git("describe", "--always") + "-dirty" * bool(dirty)


def _machine() -> str:
    return f"{platform.system()} {platform.machine()}, {os.cpu_count()} cores, Python {platform.python_version()}"


def stamped(report: Report, text: str, seconds: float) -> str:
    """The text of a report with the line that names today's program, the machine and the duration."""
    program = f"Program {_commit()} (rooms {digest_of_rooms(report.rooms)}), {time.strftime('%Y-%m-%d')}"
    plain = _STAMP.sub("", text).rstrip("\n")
    return f"{plain}\n\n{program}, {_machine()}, {seconds:.0f} s.\n"


def make(report: Report) -> bool:
    """Run the report's proofs and stamp it; False, without a stamp, if a proof failed."""
    words = [sys.executable, "-m", "pytest", "-q", "-n", "2", "--dist", "worksteal", "-m", "evidence", *report.tests]
    if report.tests[0].startswith("experiments"):
        words = [sys.executable, *report.tests]
    if report.name == "proofs":
        words += ["--report", str(report.path)]
    digest, started = digest_of_rooms(report.rooms), time.monotonic()
    # Rows of an older program do not stay.
    report.path.unlink(missing_ok=True)
    passed = subprocess.run(words, cwd=ROOT, check=False).returncode == 0
    # (Of a program that changed meanwhile nothing is proven.)
    if not passed or not report.path.exists() or digest != digest_of_rooms(report.rooms):
        return False
    text = stamped(report, report.path.read_text(encoding="utf-8"), time.monotonic() - started)
    report.path.write_text(text, encoding="utf-8")
    return True


def main() -> int:
    """The command line; the exit status is the number of reports that are stale or failed."""
    parser = argparse.ArgumentParser(description=(__doc__ or "").splitlines()[0])
    parser.add_argument("names", nargs="*", help=f"reports: {', '.join(report.name for report in ALL)}")
    parser.add_argument("--status", action="store_true", help="say which reports are stale, and make none")
    asked = parser.parse_args()
    unknown = set(asked.names) - {report.name for report in ALL}
    if unknown:
        parser.error(f"no report named {', '.join(sorted(unknown))}")
    chosen = [report for report in ALL if report.name in asked.names] if asked.names else stale()
    if asked.status:
        old = stale()
        for report in ALL:
            state = "of an older program" if report in old else "of today's rooms"
            print(f"{report.name:20}{state}")
        return len(old)
    failed = [report.name for report in chosen if not make(report)]
    if failed:
        print(f"failed: {', '.join(failed)}", file=sys.stderr)
    return len(failed)


if __name__ == "__main__":
    sys.exit(main())
