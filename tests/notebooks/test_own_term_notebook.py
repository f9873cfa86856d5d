"""The notebook with error classes of its own: they are predicted, and an estimate finds what was added."""

import pytest
from notebook_cells import check_as_executed, executed, printed, run_cells

NAME = "a_term_of_ones_own"


def test_it_is_committed_as_executed():
    assert "left in by apply: gyro_x.heating" in check_as_executed(NAME, pictures=1)


@pytest.mark.long
def test_its_cells_find_the_hysteresis_that_was_added(monkeypatch):
    names, said = run_cells(NAME, monkeypatch, ADDED=-30.0)
    assert names["value"] == pytest.approx(-30.0, abs=4.0 * names["deviation"])
    assert names["deviation"] < 2.0
    assert "added -30" in said
    stds = [row.std for row in names["after"].parameters if row.name.startswith("gyro_x.Magnetic")]
    assert len(stds) == 3
    assert max(stds) < 5.0 * names["DEG_PER_H"]


@pytest.mark.evidence
@pytest.mark.filterwarnings("ignore::DeprecationWarning")  # of the kernel's own machinery
def test_executed_anew_it_says_the_same():
    before, after = executed(NAME)
    assert printed(after)[1:4] == printed(before)[1:4]
