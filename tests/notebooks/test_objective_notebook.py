"""The notebook with an objective of its own: the spec as a function, many sensors, a price for optimistix."""

import numpy as np
import pytest
from notebook_cells import check_as_executed, executed, printed, run_cells

NAME = "an_objective_of_your_own"


def test_it_is_committed_as_executed():
    assert "found: " in check_as_executed(NAME, pictures=1)


@pytest.mark.long
def test_its_cells_run_with_few_sensors_and_steps(monkeypatch):
    names, said = run_cells(NAME, monkeypatch, STEPS=30, DRAWS=20)
    assert "84.931" in said
    left = np.asarray(names["left"])
    assert left.shape == (20,)
    assert np.ptp(left) > 5.0
    assert float(names["euro"](names["found"])) < float(names["euro"](names["start"])) - 1.0


@pytest.mark.evidence
@pytest.mark.filterwarnings("ignore::DeprecationWarning")  # of the kernel's own machinery
def test_executed_anew_it_prints_the_same():
    before, after = executed(NAME)
    assert printed(after) == printed(before)
