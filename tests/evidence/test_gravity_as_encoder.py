"""IMUs without an encoder: a box that a hand turns, simulated by physics, against what the plan predicts.

The IMUs are those of `gravity_units.py`, estimated share by share; what is missing of them is no part of the report.
`NEES` is the squared error of all of an IMU's coefficients in units of their covariance, χ² with as many degrees of
freedom where the covariance is true: the errors that the difference of what the model expects of truth and estimate
amounts to (`matrix_errors.by_data`). Without an encoder a plan hardly tells how all sensors are turned together, which
times misalignments changes the coefficients of scale factors; a correction by the whole matrix is right all the same.
So scale factors are judged by what a correction leaves of a rate along each axis.
"""

import json
import time
from functools import cache
from pathlib import Path

import numpy as np
import pytest
from gravity_units import SPOILT, outcome, scene
from scipy.stats import chi2

FOLDER = Path(__file__).parents[2] / "experiments" / "evidence" / "gravity"
# Enough IMUs for a band of the mean NEES of 7 %.
FEWEST = 30


@cache
def found(spoilt: float) -> list[dict]:
    files = sorted(FOLDER.glob(f"{spoilt:g}deg_*.jsonl"))
    return [json.loads(line) for file in files for line in file.read_text(encoding="utf-8").splitlines()]


def band(degrees: int, count: int) -> tuple[float, float]:
    """95 % of the mean of so many NEES."""
    low, high = chi2.ppf([0.025, 0.975], degrees * count) / count
    return float(low), float(high)


@pytest.mark.evidence
@pytest.mark.parametrize("spoilt", SPOILT)
def test_imus_turned_by_hand_are_as_well_known_as_predicted(spoilt):
    """Mean NEES, the data's χ² of the truth, and NEES of the scale factors within their 95 % bands; σ within 10 % of
    the prediction; no residual larger than the noise."""
    rows = found(spoilt)
    assert len({row["seed"] for row in rows}) == len(rows) >= FEWEST
    whole = rows[0]["coefficients"]
    for key, degrees in (("nees", whole), ("squares", whole), ("nees_scale", len(rows[0]["scale"]))):
        low, high = band(degrees, len(rows))
        assert low < np.mean([row[key] for row in rows]) < high, key
    assert np.all(np.abs(np.mean([row["sigma"] for row in rows], axis=0) - 1.0) < 0.1)
    assert abs(np.mean([row["residual"] for row in rows]) - 1.0) < 0.02


@pytest.mark.evidence
def test_the_shares_are_of_this_program():
    """One IMU of each, estimated again."""
    for spoilt in SPOILT:
        row = found(spoilt)[0]
        again = outcome(scene(), row["seed"], spoilt)
        assert again["nees"] == pytest.approx(row["nees"], rel=1e-4)


@pytest.mark.evidence
def test_the_report():
    """Of the same IMUs."""
    lines: list[str] = []
    for spoilt in SPOILT:
        rows = found(spoilt)
        cells = [f"{spoilt:g}", f"{len(rows)}"]
        whole = rows[0]["coefficients"]
        for key, degrees in (("nees", whole), ("squares", whole), ("nees_scale", len(rows[0]["scale"]))):
            low, high = band(degrees, len(rows))
            cells.append(f"{np.mean([row[key] for row in rows]):.2f} ({low:.2f} … {high:.2f})")
        ratio = np.mean([row["sigma"] for row in rows], axis=0)
        cells.append(f"{ratio.min():.3f} … {ratio.max():.3f}")
        cells.append(f"{np.mean([row['residual'] for row in rows]):.4f}")
        lines.append(f"| {' | '.join(cells)} |")
    text = "\n".join([
        "# IMUs without an encoder", "",
        "Made by `tests/evidence/gravity_units.py` (shares in `gravity/`) and `pytest -m evidence",
        "tests/evidence/test_gravity_as_encoder.py`: simulated IMUs of the preset `no-encoder`, turned by hand; every",
        "turn ends off the plan's angle by a draw of the stated standard deviation. NEES: mean, with the 95 % band of",
        "it, of all of an IMU's coefficients, by what the model expects of truth and estimate; by data: χ² of the",
        "truth by the log alone; scale factors: of what a correction leaves of a rate along each gyro, 10 and 40 °C,",
        "which, unlike the coefficients, does not depend on how all sensors are turned together. IMUs that were not",
        "estimated in the machine's time are not counted.", "",
        "| spoilt by, deg | IMUs | NEES | by data | NEES, scale factors | σ over the predicted | χ² over degrees |",
        "|---|---|---|---|---|---|---|", *lines, "", time.strftime("%Y-%m-%d"), "",
    ])  # fmt: skip
    (FOLDER.parent / "gravity.md").write_text(text, encoding="utf-8")
