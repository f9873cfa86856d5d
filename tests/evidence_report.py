"""Committed reports of evidence: tables whose rows are written one by one; rows that are not made anew stay."""

import fcntl
import os
import platform
import re
import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path

EVIDENCE = Path(__file__).parents[1] / "experiments" / "evidence"
Rows = list[list[str]]


def machine() -> str:
    """The computer in general words."""
    return f"{platform.system()} {platform.machine()}, {os.cpu_count()} cores, Python {platform.python_version()}"


@dataclass(frozen=True)
class ReportTable:
    """A report of one table below `head`; the first `keys` of its `columns` name a row; `foot` is made of all rows."""

    name: str
    head: str
    columns: tuple[str, ...]
    keys: int = 1
    foot: Callable[[Rows], str] = lambda rows: ""
    folder: Path = EVIDENCE

    @property
    def path(self) -> Path:
        return self.folder / f"{self.name}.md"

    def rows(self) -> Rows:
        """The cells of the rows as they stand in the file, in their order."""
        if not self.path.exists():
            return []
        lines = [line for line in self.path.read_text(encoding="utf-8").splitlines() if line.startswith("| ")]
        cells = [[cell.strip() for cell in line.strip("|").split(" | ")] for line in lines]
        return [row for row in cells if len(row) == len(self.columns) and row != list(self.columns)]

    def put(self, *rows: Sequence[str]) -> None:
        """Write rows, or replace those of the same name; the workers of a run do so in turn."""
        self.folder.mkdir(parents=True, exist_ok=True)
        with self.path.open("a") as file:
            fcntl.flock(file, fcntl.LOCK_EX)
            table = {tuple(row[: self.keys]): row for row in self.rows()}
            for row in rows:
                cells = [str(cell).replace("|", "/") for cell in row]
                table[tuple(cells[: self.keys])] = cells
            self._write([list(table[key]) for key in sorted(table)])

    def _write(self, rows: Rows) -> None:
        lines = ["| " + " | ".join(row) + " |" for row in (self.columns, *rows)]
        lines.insert(1, "|" + "---|" * len(self.columns))
        foot = self.foot(rows)
        text = f"{self.head}\n" + "\n".join(lines) + "\n" + (f"\n{foot}\n" if foot else "")
        self.path.write_text(text, encoding="utf-8")


PROOFS = """# Evidence of the long proofs

Made by `pytest -m evidence --report experiments/evidence/proofs.md`; what each proves is the name and the text of the
test. The figures of the hardware room are in [hardware.md](hardware.md).
"""


class EvidenceReport:
    """A pytest plugin that keeps a table of proofs in `path`: how many cases of each passed, when, in what time."""

    def __init__(self, path: str):
        columns = ("proof", "passed", "failed", "s", "date", "machine")
        self.table = ReportTable(Path(path).stem, PROOFS, columns, folder=Path(path).parent)
        self.found: dict[str, list[float]] = {}

    def pytest_runtest_logreport(self, report) -> None:
        """Count a case where its call ends, or where its setup fails."""
        name = re.sub(r"\[.*\]$", "", report.nodeid)
        passed, failed, seconds = self.found.setdefault(name, [0, 0, 0.0])
        passed += report.when == "call" and report.passed
        failed += report.failed
        self.found[name] = [passed, failed, seconds + report.duration]

    def pytest_sessionfinish(self) -> None:
        """Write the table, rows in the order of their names."""
        day = time.strftime("%Y-%m-%d")
        rows = [
            (f"`{name}`", f"{passed}", f"{failed}", f"{seconds:.0f}", day, machine())
            for name, (passed, failed, seconds) in self.found.items()
            if passed or failed
        ]
        self.table.put(*rows)
