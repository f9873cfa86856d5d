"""The notebook that compares the standard with the gradient method by a designed sweep."""

import numpy as np
import pytest
from notebook_cells import check_as_executed, executed, printed, run_cells

NAME = "standard_against_gradient"


def test_it_is_committed_as_executed():
    assert "64 plans predicted, 0 failed" in check_as_executed(NAME, pictures=2)


def test_its_cells_run_with_fewer_points_and_say_what_it_concludes(monkeypatch):
    names, said = run_cells(NAME, monkeypatch, POINTS=16)
    assert "16 plans predicted, 0 failed" in said
    exponents = dict(zip(names["factors"], names["exponents"], strict=False))
    assert exponents["fast_rate"] < -1.0 < 0.0 < exponents["slope"]
    for label, points in names["rows"].items():
        hours, left = np.array(points).T
        assert np.all(np.diff(hours) > 0.0)
        # More time helps the gradient method, and the standard one by a fifteenth at most.
        assert left[-1] / left[0] < 0.4 if label.startswith("gradient") else left[-1] / left[0] > 0.93


@pytest.mark.evidence
@pytest.mark.filterwarnings("ignore::DeprecationWarning")  # of the kernel's own machinery
def test_executed_anew_it_says_the_same():
    before, after = executed(NAME)
    assert printed(after) == printed(before)
