"""The notebook that sets the paper's numbers beside exact covariance."""

import re

import pytest
from notebook_cells import check_as_executed, executed, printed, run_cells

NAME = "the_paper_compared"


def test_it_is_committed_as_executed_with_the_known_answers():
    said = check_as_executed(NAME, pictures=3)
    for known in ("36.0 s", "0.190°", "0.380 deg/h", "138.9 ppm", "127.4 / 100.5", "84.9 / 42.8"):
        assert known in said
    assert re.search(r"standard method, 9 h +0\.279 +0\.372", said)
    assert re.search(r"the ramp alone +0\.402 +0\.775", said)
    assert re.search(r"not a cubic +0\.2", said)


def test_its_cells_say_the_same_today(monkeypatch):
    """Two readings of the gradient plan; the whole is evidence."""
    _, said = run_cells(NAME, monkeypatch, READINGS=2)
    before = check_as_executed(NAME, pictures=3)
    lines = said.splitlines()
    assert len(lines) >= 18
    assert set(lines) <= set(before.splitlines())


@pytest.mark.evidence
@pytest.mark.filterwarnings("ignore::DeprecationWarning")  # of the kernel's own machinery
def test_executed_anew_the_comparison_says_the_same():
    before, after = executed(NAME)
    assert printed(after) == printed(before)
