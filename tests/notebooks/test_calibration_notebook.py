"""The notebook of a run and its calibration is committed as executed, and comes out alike anew."""

import re

import pytest
from notebook_cells import FOLDER, check_as_executed, executed, printed, run_cells

NAME = "calibration_from_a_run"
SHOWS = (FOLDER.parent / "docs/demo.md").read_text(encoding="utf-8")


def test_the_calibration_is_committed_as_executed():
    said = check_as_executed(NAME, pictures=1)
    assert "success; everything left verified safe: True" in said
    assert "simulated: True" in said


@pytest.mark.long
def test_its_cells_run_and_page_and_calibration_say_the_same(monkeypatch):
    names, said = run_cells(NAME, monkeypatch)
    told, verdict = names["told"], names["verdict"]
    assert told.achieved == verdict.judged
    assert told.predicted == names["recipe"].prediction.requirements[0].decisive
    assert f"{told.achieved:.3g} achieved" in said
    assert names["chance"] > 1e-3

    told_by_demo = list(names["numbers"].values())
    limit, planned, achieved, paper = sorted(told_by_demo)
    assert told_by_demo == [paper, planned, limit, achieved]
    for value in told_by_demo:
        assert f" {value:.4g} ppm" in said
        assert f" {value:.1f}" in SHOWS
    assert said[said.index("the paper's plan") :] in check_as_executed(NAME, pictures=1)


@pytest.mark.evidence
@pytest.mark.filterwarnings("ignore::DeprecationWarning")  # of the kernel's own machinery
def test_the_run_and_its_calibration_come_out_alike():
    """Plan and recipe to the digit; what the rehearsal's threads touch to a fifth of a standard deviation."""
    before, after = ([text for text, _ in printed(notebook)] for notebook in executed(NAME))
    found = next(place for place, text in enumerate(before) if "truth" in text)
    assert after[:found] == before[:found]
    rows = [
        re.findall(r"^(b\d\d) +(-?\d+) +([\d.]+) +([\d.]+) +(-?\d+) ", text[found], flags=re.M)
        for text in (before, after)
    ]
    assert len(rows[0]) == len(rows[1]) == 9
    for (name, value, std, predicted, truth), (again, now, std_now, *rest) in zip(*rows, strict=True):
        assert (again, *rest) == (name, predicted, truth)
        assert float(std_now) == pytest.approx(float(std), rel=0.02, abs=0.1)
        assert float(now) == pytest.approx(float(value), abs=0.2 * float(std) + 1.0)
