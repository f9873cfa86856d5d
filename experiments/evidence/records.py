"""Which rule catches which record of the zoo (tests/records/recording_zoo.py): `records.md`.

    python experiments/evidence/records.py

A rule is the kind of a finding, the function that asks a question, or the beginning of a note of the noise's fit. A
record that a rule catches alone would pass in silence without it.
"""

import importlib
import re
import sys
import tempfile
import time
from collections import Counter, defaultdict
from pathlib import Path

import jax
import numpy as np

ROOT = Path(__file__).resolve().parents[2]
sys.path.insert(0, str(ROOT / "tests" / "records"))

from recording_zoo import ZOO, N, Recorded  # noqa: E402
from test_recording_zoo import WITHIN, looked_at  # noqa: E402

from gradcal_jax.records.importers import import_log  # noqa: E402

OUTCOMES = ("right", "right, with a note", "flagged", "asked", "silently wrong")


def judged(record: Recorded) -> tuple[str, list[str]]:
    """The outcome of a record, and the rules that caught it."""
    try:
        walk, error, said = looked_at(import_log(record.path, record.columns))
    except ValueError as question:
        # (What adds the file's name raises anew.)
        first = question.__context__ if isinstance(question.__context__, ValueError) else question
        trace, function = first.__traceback__, ""
        while trace is not None:
            # The innermost function of the package, without those that only name the file or raise.
            path, name = trace.tb_frame.f_code.co_filename, trace.tb_frame.f_code.co_name
            if "gradcal_jax" in path and name not in ("naming", "question", "quietly"):
                function = f"{Path(path).stem}.{name.strip('_')}"
            trace = trace.tb_next
        return "asked", [function]
    right = abs(walk - N) < WITHIN * error and error < 0.2 * walk
    rules = list(dict.fromkeys(rule_of(one) for one in said))
    if right:
        return ("right, with a note" if said else "right"), rules
    return ("flagged" if said else "silently wrong"), rules


def rule_of(said: str) -> str:
    """The words of a note without its figures and names."""
    plain = re.sub(r"^gyro \w+( of \w+)?: ", "", said)
    words = re.sub(r"[-+]?\d[\d.e+-]*( (rows?|%|ms|s|Hz)\b)?", "…", plain).split()
    return " ".join(words[:7])


def report() -> str:
    """The table in Markdown."""
    outcomes, caught = Counter[str](), defaultdict[str, list[tuple[str, bool]]](list)
    for name, write in ZOO.items():
        with tempfile.TemporaryDirectory() as folder:
            outcome, rules = judged(write(Path(folder)))
        outcomes[outcome] += 1
        for rule in rules:
            caught[rule].append((name, len(rules) == 1))
    lines = [
        "# Which rule catches which record",
        "",
        f"{len(ZOO)} generated records of a gyro at rest (`tests/records/recording_zoo.py`): "
        + ", ".join(f"{outcomes[outcome]} {outcome}" for outcome in OUTCOMES)
        + ". A rule is the function that asks, or the words of a finding; **bold** are records that it catches alone.",
        "",
        "| rule | records | alone | which |",
        "|---|---|---|---|",
    ]
    for rule, records in sorted(caught.items(), key=lambda one: -len(one[1])):
        alone = int(np.sum([single for _, single in records]))
        which = "; ".join(f"**{name}**" if single else name for name, single in records)
        lines.append(f"| {rule.replace('|', '/')} | {len(records)} | {alone} | {which} |")
    return "\n".join(lines) + "\n"


if __name__ == "__main__":
    jax.config.update("jax_enable_x64", True)
    started, reports = time.monotonic(), importlib.import_module("all")
    (own,) = (one for one in reports.ALL if one.name == "records")
    own.path.write_text(reports.stamped(own, report(), time.monotonic() - started), encoding="utf-8")
