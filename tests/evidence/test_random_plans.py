"""Random plans of an axis and of a unit: what is predicted of each parameter is what is estimated from the plan's own
simulated run, within 5 % of every standard deviation.
"""

import time
from pathlib import Path

import numpy as np
import pytest
import tomlkit
from chain import Chain, chain, predicted_of, recipe_of
from evidence_report import ReportTable, Rows
from random_plans import KINDS, plan_of
from scipy.stats import chi2

import gradcal_jax as gj
from gradcal_jax.model.build import build_imu
from gradcal_jax.records.table_angles import MARGIN_S, SETTLED_S

# By how much an estimated standard deviation may differ from the predicted one.
MOST = 0.05
# Between two samples of the simulated unit.
SAMPLE_S = 0.008
PLANS = 20


def executed(kind: str, number: int, folder: Path, *, ideal: bool = False) -> Chain:
    """A plan's simulated run and estimate, whose data fit; `ideal`: of sensors that are hardly misaligned."""
    tables = plan_of(kind, number)
    if ideal:
        tables["sensor"]["gyro"]["misalignment"]["prior"] = "0.001 mrad"
    (folder / "spec.toml").write_text(tomlkit.dumps(tables), encoding="utf-8")
    recipe = recipe_of(folder / "spec.toml", folder)
    done = chain(recipe, predicted_of(recipe, folder), folder, seed=number)
    assert done.sigmas, done.printed
    assert chi2.sf(*done.fit) > 1e-4, f"the run's own data do not fit: χ² {done.fit[0]:.0f} of {done.fit[1]}"
    return done


def apart(done: Chain, most: float = MOST) -> dict[str, float]:
    """Of parameters by name the estimated standard deviation over the predicted one, where they differ."""
    return {name: round(float(ratio), 3) for name, ratio in done.sigmas.items() if abs(ratio - 1.0) > most}


def margins_of(kind: str, number: int) -> float:
    """By what share a standard deviation grows at most because a log counts the time beside a turn, in which the table
    may still settle, as a part of the turn: a random walk over a turn grows with the root of its time."""
    motion = build_imu(gj.parse_spec(tomlkit.dumps(plan_of(kind, number)))).motion
    begins = np.flatnonzero(np.diff(motion.axis, prepend=-2))
    lasts = np.add.reduceat(np.asarray(motion.line.duration), begins)[motion.axis[begins] >= 0]
    return float(np.sqrt(1.0 + (SETTLED_S + MARGIN_S + SAMPLE_S) / lasts.min())) - 1.0


_HEAD = """# Random plans: what is predicted is what is estimated

Made by `pytest -m evidence tests/evidence/test_random_plans.py`, which says what is drawn: recipe, run on simulated
devices, log and estimate by the command line. Of every parameter that the plan says anything of, the estimated standard
deviation over the predicted one, which may differ by 5 %; of a misalignment, that of its product with the scale factor.
A prediction is of an ideal sensor: where a misaligned one shows more (a gyro across the table's only axis senses a turn
by its misalignment alone, and then its scale factor), the plan is run again with sensors that are hardly misaligned.
A log counts 0.12 s beside each turn as a part of it, since the table may still settle; where turns are shorter than a
second, this is named, with what it adds at most. χ² of the run's own data.
"""


def _foot(rows: Rows) -> str:
    good, short = sum(row[3] == "–" for row in rows), sum("short turns" in row[3] for row in rows)
    more = sum("hardly misaligned" in row[3] for row in rows) - short
    words = f"{good} of {len(rows)} within 5 % in every parameter, {more} more if their sensors are hardly misaligned, "
    words += f"{short} more with the log's margins beside short turns"
    return f"{words}; {time.strftime('%Y-%m-%d')}."


_COLUMNS = ("plan", "parameters", "estimated over predicted", "beyond 5 %", "χ² of the data", "of")
REPORT = ReportTable("random_plans", _HEAD, _COLUMNS, foot=_foot)


@pytest.mark.long
@pytest.mark.parametrize(("kind", "number"), [("axis", 1), ("axis", 2), ("unit", 9)])
def test_what_is_predicted_is_what_is_estimated(kind: str, number: int, tmp_path: Path) -> None:
    assert not apart(executed(kind, number, tmp_path))


@pytest.mark.evidence
@pytest.mark.parametrize("number", range(1, PLANS + 1))
@pytest.mark.parametrize("kind", KINDS)
def test_twenty_plans_of_each_kind(kind: str, number: int, tmp_path: Path) -> None:
    done = executed(kind, number, tmp_path)
    ratios, beyond = list(done.sigmas.values()), apart(done)
    words = ", ".join(f"{name} {ratio}" for name, ratio in beyond.items())[:160] or "–"
    if beyond and kind == "unit":
        ideal = executed(kind, number, tmp_path, ideal=True)
        again = [ideal.sigmas[name] for name in beyond]
        beyond = apart(ideal)
        words += f"; hardly misaligned {min(again):.3f} … {max(again):.3f}"
        if beyond and not (beyond := apart(ideal, MOST + (margin := margins_of(kind, number)))):
            words += f"; short turns, +{margin:.3f} by the log's margins"
    statistic, degrees = done.fit
    span = f"{min(ratios):.3f} … {max(ratios):.3f}"
    REPORT.put((f"{kind} {number:02d}", len(ratios), span, words, f"{statistic:.0f}", degrees))
    assert not beyond
