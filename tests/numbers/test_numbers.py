"""Numbers that stay as they are: today's predictions and elasticities against those recorded beside this file.

`record.py` wrote them, and says which cases are known to be wrong: those are skipped with their reason until the
mistake is mended and they are recorded anew. A few cases are part of every run; `-m evidence` takes them all.
"""

import json
from pathlib import Path

import pytest

from gradcal_jax.api.prediction import predict
from gradcal_jax.api.sensitivity import sensitivity
from gradcal_jax.files import spec_of

HERE = Path(__file__).parent
PREDICTIONS = json.loads((HERE / "predictions.json").read_text(encoding="utf-8"))
ELASTICITIES = json.loads((HERE / "elasticities.json").read_text(encoding="utf-8"))

# One of each method, basis and reference, quick ones; and two whose bias hardly anything is known of: where sums let
# rounding grow, the first of them fails.
ALWAYS = {"static gradient 0", "static standard 1", "dynamic standard 1", "tactical 3", "hand 1"}
ALWAYS |= {"tactical 10", "consumer 6"}
ALWAYS_DERIVED = {"static gradient 0", "dynamic gradient 8"}


def _cases(record: dict, always: set[str]) -> list:
    assert always <= set(record)
    found = []
    for name in record:
        marks = [] if name in always else [pytest.mark.evidence]
        if reasons := PREDICTIONS[name]["changes"]:
            marks.append(pytest.mark.skip(reason="; ".join(reasons)))
        found.append(pytest.param(name, marks=marks))
    return found


def _close(values: dict, recorded: dict, tolerance: float) -> None:
    assert values.keys() == recorded.keys()
    for key, expected in recorded.items():
        if isinstance(expected, dict):
            _close(values[key], expected, tolerance)
        elif expected is None:
            assert values[key] is None, key
        else:
            assert values[key] == pytest.approx(expected, rel=tolerance, abs=0.0), key


@pytest.mark.parametrize("name", _cases(PREDICTIONS, ALWAYS))
def test_predictions_are_as_recorded(name):
    recorded = PREDICTIONS[name]
    answer = predict(spec_of(recorded["tables"]), limits=False)
    rows = {
        f"{r.name} / {r.axis}": {"mean of max": r.mean_of_max, "max": r.max, "mean": r.mean, "rms": r.rms}
        for r in answer.requirements
    }
    _close(rows, recorded["requirements"], 1e-12)
    # Coefficients of functions that are almost dependent carry rounding that what they predict together does not.
    _close({f"{p.name} / {p.axis}": p.std for p in answer.parameters}, recorded["parameters"], 1e-11)


@pytest.mark.parametrize("name", _cases(ELASTICITIES, ALWAYS_DERIVED))
def test_elasticities_are_as_recorded(name):
    rows: dict[str, dict[str, float]] = {}
    for row in sensitivity(spec_of(PREDICTIONS[name]["tables"])).rows:
        rows.setdefault(row.requirement, {})[row.figure] = row.percent
    recorded = ELASTICITIES[name]
    assert {k: set(v) for k, v in rows.items()} == {k: set(v) for k, v in recorded.items()}
    for requirement, figures in recorded.items():
        # Per cent for one per cent: a figure that hardly matters is compared with those that do.
        largest = max(abs(v) for v in figures.values())
        for figure, expected in figures.items():
            assert abs(rows[requirement][figure] - expected) <= 1e-9 * max(abs(expected), largest), figure
