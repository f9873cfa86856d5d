"""The report of the long proofs: how many cases of each passed, when, in what time. Rows that are not run anew stay."""

import os
import platform
import re
import time
from pathlib import Path

_HEAD = """# Evidence of the long proofs

Made by `pytest -m evidence --report experiments/evidence/proofs.md`; what each proves is the name and the text of the
test. The figures of the hardware room are in [hardware.md](hardware.md).

| proof | passed | failed | s | date | machine |
|---|---|---|---|---|---|
"""


class EvidenceReport:
    """A pytest plugin that keeps a table of proofs in `path`."""

    def __init__(self, path: str):
        self.path = Path(path)
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
        rows: dict[str, str] = {}
        if self.path.exists():
            for line in self.path.read_text(encoding="utf-8").splitlines():
                if match := re.match(r"\| `(tests/[^`]+)` \|", line):
                    rows[match[1]] = line
        machine = (
            f"{platform.system()} {platform.machine()}, {os.cpu_count()} cores, Python {platform.python_version()}"
        )
        for name, (passed, failed, seconds) in self.found.items():
            if passed or failed:
                cells = (f"`{name}`", f"{passed}", f"{failed}", f"{seconds:.0f}", time.strftime("%Y-%m-%d"), machine)
                rows[name] = f"| {' | '.join(cells)} |"
        self.path.write_text(_HEAD + "\n".join(rows[name] for name in sorted(rows)) + "\n", encoding="utf-8")
