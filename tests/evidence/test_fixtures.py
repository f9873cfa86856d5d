"""A fixture of twelve IMUs in six orientations: what `fixture_batches.py` has found in batches, judged and reported."""

import json
import time
from functools import cache
from pathlib import Path

import numpy as np
import pytest
from fixture_batches import PLACES, batch, predicted_shares
from scipy.stats import chi2

pytestmark = pytest.mark.evidence

FOLDER = Path(__file__).parents[2] / "experiments" / "evidence" / "fixtures"
FEWEST = 20


@cache
def found() -> list[dict]:
    files = sorted(FOLDER.glob("*.jsonl"))
    return [json.loads(line) for file in files for line in file.read_text(encoding="utf-8").splitlines()]


def with_elements() -> list[dict]:
    """The batches whose errors are known by elements of the matrices, too: (1 + M) m in the place of m, which a plan
    may tell far better (`matrix_errors.nees_of`), so that only those of a linear covariance are χ²."""
    return [row for row in found() if "elements" in row]


def reached() -> np.ndarray:
    """Of every place: root mean square of the errors over the predicted standard deviations."""
    return np.sqrt(np.mean([row["squares"] for row in found()], axis=0))


def shares() -> tuple[list[str], np.ndarray, np.ndarray]:
    """Names of the table's errors, and σ by all IMUs over σ by one: estimated and predicted."""
    rows, predicted = [row["shares"] for row in found() if "shares" in row], predicted_shares()
    names = [name for name in predicted if name in rows[0]]
    return names, np.mean([[row[n] for n in names] for row in rows], axis=0), np.array([predicted[n] for n in names])


def test_every_place_errs_as_predicted():
    """Within 5 % at every place; χ² in the joint covariance, of elements, of every place within its 99 % band,
    Bonferroni's."""
    rows = found()
    assert len({row["seed"] for row in rows}) == len(rows) >= FEWEST
    # So few batches scatter by some more.
    assert np.all(np.abs(reached() - 1.0) < 0.05 * max(1.0, (200 / len(rows)) ** 0.5))
    of = with_elements()
    assert len(of) >= FEWEST
    for k in range(len(PLACES)):
        degrees = sum(row["degrees"][k] for row in of)
        low, high = chi2.ppf([0.005 / len(PLACES), 1.0 - 0.005 / len(PLACES)], degrees)
        assert low < sum(row["elements"][k] for row in of) < high, PLACES[k]["name"]
    count = len(PLACES) * len(rows)
    assert sum(row["named"] for row in rows) <= 0.01 * count + 4.0 * np.sqrt(0.01 * count)


def test_the_share_of_the_table_falls_as_predicted():
    _, estimated, predicted = shares()
    assert np.all(estimated < 1.0)
    np.testing.assert_allclose(estimated, predicted, rtol=0.03)


def test_the_shares_are_of_this_program():
    """One batch, run and estimated again."""
    row = found()[0]
    again = batch(row["seed"])
    np.testing.assert_allclose(again["nees"], row["nees"], rtol=1e-4)


def test_the_report():
    """Of the same batches."""
    rows, of, lines, ratio = found(), with_elements(), list[str](), reached()
    for k, place in enumerate(PLACES):
        whole, degrees = (sum(row["degrees"][k] for row in some) for some in (rows, of))
        low, high = chi2.ppf([0.005, 0.995], degrees)
        squares, plain = sum(row["elements"][k] for row in of), sum(row["nees"][k] for row in rows)
        figures = f"{ratio[k]:.3f} | {squares:.0f} | {degrees} | {low:.0f} … {high:.0f} | {plain:.0f} of {whole} |"
        lines.append(f"| {place['name']} | {figures}")
    of_table = ", ".join(f"{name} {a:.3f} ({b:.3f})" for name, a, b in zip(*shares(), strict=True))
    named = sum(row["named"] for row in rows)
    text = "\n".join([
        "# A fixture of twelve IMUs in six orientations", "",
        "Made by `tests/evidence/fixture_batches.py` (shares in `fixtures/`) and `pytest -m evidence",
        f"tests/evidence/test_fixtures.py`: {len(rows)} batches of a short plan on a two-axis table at a constant",
        "temperature, run on simulated devices and estimated together. Reached over predicted: root mean square of the",
        "errors of an IMU's own coefficients over the joint standard deviations that `predict` gives; χ²: in the",
        f"estimate's joint covariance with its 99 % band, of {len(of)} of the batches, by elements of the matrices:",
        "(1 + M) m in the place of m, which a plan may tell far better than M and m. Beside it of the coefficients",
        "themselves, of all batches: no χ² where that is so. Places of the same orientation are six apart.", "",
        "| place | reached over predicted | χ² | of | band | of coefficients |", "|---" * 6 + "|", *lines, "",
        f"Errors of the table, σ together over σ by one IMU, estimated (and predicted): {of_table}.", "",
        f"Named as a contradiction, where there is none: {named} of {len(PLACES) * len(rows)} IMUs (at 1 %).", "",
        time.strftime("%Y-%m-%d"), "",
    ])  # fmt: skip
    (FOLDER.parent / "fixtures.md").write_text(text, encoding="utf-8")
