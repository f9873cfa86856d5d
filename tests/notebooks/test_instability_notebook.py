"""The notebook of a real recording runs, and prints what it is committed with."""

import os
from pathlib import Path

import pytest
from notebook_cells import FOLDER, check_as_executed, executed, printed, run_cells

NAME = "instability_of_a_real_sensor"
DATA = Path(os.environ.get("GRADCAL_DATA", FOLDER.parents[1] / "shared" / "data"))
recorded = pytest.mark.skipif(not DATA.is_dir(), reason="the recorded data are not here: set GRADCAL_DATA")


def test_it_is_committed_as_executed_with_small_pictures():
    check_as_executed(NAME, pictures=2)


@recorded
def test_its_cells_say_the_same_of_one_axis(monkeypatch):
    monkeypatch.setenv("GRADCAL_DATA", str(DATA))
    _, said = run_cells(NAME, monkeypatch, AXES=("y",))
    lines = [line for line in said.splitlines() if line]
    assert len(lines) > 10
    assert set(lines) <= set(check_as_executed(NAME, pictures=2).splitlines())


@pytest.mark.evidence
@pytest.mark.filterwarnings("ignore::DeprecationWarning")  # of the kernel's own machinery
@recorded
def test_executed_anew_it_says_the_same(monkeypatch):
    monkeypatch.setenv("GRADCAL_DATA", str(DATA))
    before, after = executed(NAME)
    assert printed(after) == printed(before)
