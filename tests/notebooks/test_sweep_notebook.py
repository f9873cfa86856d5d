"""The notebook that reads sweeps with xarray, the one of the repository and one of its own."""

import numpy as np
import pytest
from notebook_cells import check_as_executed, executed, printed, run_cells

NAME = "a_sweep_read_with_xarray"


def test_it_is_committed_as_executed():
    said = check_as_executed(NAME, pictures=2)
    assert "complete: 195 points, 0 of them failed" in said
    assert "12 points, 0 of them failed" in said


def test_its_cells_run_with_a_smaller_sweep(monkeypatch):
    names, said = run_cells(NAME, monkeypatch, SLOPES=["1 K/min"], NOISES=["0.02 deg", "0.05 deg"])
    made = names["made"]["full_range_mean_of_max"]
    assert float(made.sel(reading_noise=0.05, slope=1.0)) == pytest.approx(84.9, abs=0.05)
    assert "2 points, 0 of them failed" in said
    # What it concludes: nearly in proportion to the noise of a reading.
    assert float(made[0, 1] / made[0, 0]) == pytest.approx(2.5, rel=0.15)
    assert np.all(np.diff(names["left"].sel(encoder_error=1.0, gradient=1.0)) > 0.0)


@pytest.mark.evidence
@pytest.mark.filterwarnings("ignore::DeprecationWarning")  # of the kernel's own machinery
def test_executed_anew_the_sweep_says_the_same():
    before, after = executed(NAME)
    assert printed(after) == printed(before)
