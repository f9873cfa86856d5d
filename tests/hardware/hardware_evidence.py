"""Figures of the long proofs, kept in a committed file: one row each, with its date and the command that made it."""

import os
import platform
import time
from pathlib import Path

REPORT = Path(__file__).parents[2] / "experiments" / "evidence" / "hardware.md"
_HEAD = """# Evidence of the hardware room

Made by `pytest -m evidence tests/hardware`; each row is written when its proof has passed. Every device is simulated:
byte for byte, over pseudo-terminals, but none of the figures comes from hardware.

| proof | figures | date | command | machine |
|---|---|---|---|---|
"""
_FOOT = """
Shown by tests, without figures:

* a full disk and too little space end a run (`test_journal_and_safety`, `test_runner`);
* a chamber's alarm, an axis' fault and pulled cables abort it and the rest is made safe (`test_runner`, a long proof);
* the wall clock stepped by years changes nothing (`test_journal_and_safety`, `test_clock_and_physics`);
* of two runs on one port the second is refused (`test_transport`);
* a port that leads to another device is a sentence with what was sent and what came back (`test_run_cli`);
* a host that sleeps in a turn, a stage that swallows one, samples that are lost: the step is made again, or the run
  ends and says so; an axis faster than it was told is stopped (`test_mishaps`);
* a guard that is killed is announced and replaced, a run that hangs is ended, and where a run's folder is moved or
  removed before the run is killed, the rig is made safe (`test_guard`);
* commands of every chamber, axis and unit that are lost, doubled, damaged or late once are noticed
  (`test_line_devices`, `test_frames`);
* somebody at the terminal of `gradcal run` turns a gimbal by hand, mistypes, gives up and goes on
  (`test_operator`, on a pseudo-terminal of its own).
"""


def machine():
    """The computer in general words."""
    return f"{platform.system()} {platform.machine()}, {os.cpu_count()} cores, Python {platform.python_version()}"


def record(proof, figure, test):
    """Write or replace the row of one proof."""
    rows = {}
    if REPORT.exists():
        for line in REPORT.read_text(encoding="utf-8").splitlines():
            cells = [cell.strip() for cell in line.strip("|").split("|")]
            if len(cells) == 5 and cells[0] not in ("proof", "---"):
                rows[cells[0]] = line
    cells = (proof, figure, time.strftime("%Y-%m-%d"), f"`pytest -m evidence {test}`", machine())
    rows[proof] = f"| {' | '.join(cells)} |"
    REPORT.parent.mkdir(parents=True, exist_ok=True)
    REPORT.write_text(_HEAD + "\n".join(rows[name] for name in sorted(rows)) + "\n" + _FOOT, encoding="utf-8")
