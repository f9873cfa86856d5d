"""The notebook of a whole unit is committed as executed; its plans come out alike, its simulated unit within its σ."""

import numpy as np
import pytest
from notebook_cells import check_as_executed, run_cells
from scipy import stats

NAME = "an_imu_in_one_afternoon"


def test_it_is_committed_as_executed_with_small_pictures():
    said = check_as_executed(NAME, pictures=3)
    assert "success; everything left verified safe: True" in said
    assert "simulated: True" in said


@pytest.mark.long
def test_its_cells_run_and_find_the_hidden_unit(monkeypatch):
    names, said = run_cells(NAME, monkeypatch)
    before = check_as_executed(NAME, pictures=3)
    # What is predicted, to the digit.
    end = "success;"
    assert said[: said.index(end)] == before[: before.index(end)]
    size = len(names["names"])
    assert size == 45
    assert 1e-3 < stats.chi2.sf(names["squared"], size) < 0.999
    achieved, planned = (np.array([r.decisive for r in rows]) for rows in (names["report"].requirements, names["rows"]))
    assert np.max(np.abs(achieved / planned - 1.0)) < 0.1
    assert names["after"] < 0.01 * names["before"]
    # What the text says of six positions and of a plane.
    lost = {name: found.warnings for name, found in names["found"].items()}
    assert not any("says nothing" in sentence or "never" in sentence for sentence in lost["the whole plan"])
    assert any("accelerometer x never points up" in sentence for sentence in lost["tumble about one axis"])
    six = [r.decisive for r in names["found"]["six positions"].requirements]
    assert six[0] > 300.0 * names["rows"][0].decisive
    assert six[1] < names["rows"][1].decisive
    assert "static inline void gradcal_correct" in said
