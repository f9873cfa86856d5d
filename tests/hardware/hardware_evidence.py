"""Figures of the long proofs, kept in a committed file: one row each, with its date and the command that made it."""

import time
from pathlib import Path

REPORT = Path(__file__).with_name("evidence.md")
_HEAD = """# Evidence of the hardware room

Made by `pytest -m evidence tests/hardware`; each row is written when its proof has passed. Devices are simulated: over
pseudo-terminals, byte for byte, but none of the figures comes from hardware.

| proof | figure | date | command |
|---|---|---|---|
"""


def record(proof: str, figure: str, test: str) -> None:
    """Write or replace the row of one proof."""
    rows: dict[str, str] = {}
    if REPORT.exists():
        for line in REPORT.read_text(encoding="utf-8").splitlines():
            cells = [cell.strip() for cell in line.strip("|").split("|")]
            if len(cells) == 4 and cells[0] not in ("proof", "---"):
                rows[cells[0]] = line
    rows[proof] = f"| {proof} | {figure} | {time.strftime('%Y-%m-%d')} | `pytest -m evidence {test}` |"
    REPORT.write_text(_HEAD + "\n".join(rows[name] for name in sorted(rows)) + "\n", encoding="utf-8")
