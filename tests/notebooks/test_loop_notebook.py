"""The notebook of a ramp that goes both ways: its plans come out alike, its simulated unit within its σ."""

import numpy as np
import pytest
from notebook_cells import check_as_executed, run_cells

NAME = "the_ramp_goes_both_ways"


def test_it_is_committed_as_executed_with_small_pictures():
    said = check_as_executed(NAME, pictures=1)
    assert "heats: True  cools: True  no worse: True" in said
    assert "simulated: True" in said


@pytest.mark.long
def test_its_cells_run_and_the_play_predicts_the_other_record(monkeypatch):
    names, said = run_cells(NAME, monkeypatch)
    before = check_as_executed(NAME, pictures=1)
    # What is predicted and searched, to the digit.
    end = "success;"
    assert said[: said.index(end)] == before[: before.index(end)]
    assert names["left"]["two ways"] < 0.1 * names["left"]["one way"]
    assert "heating against cooling" in names["without"].calibration.contradicted
    assert names["with_play"].calibration.contradicted == ()
    assert "a play of " in said
    size = abs(np.degrees(names["play"].value)) * 3600.0 * 10.0
    assert 5.0 < size < 15.0
    # The relays are no play, and the sensor drifts by 1 deg/h.
    assert names["rms"]["maps and play"] < 2.5
    assert names["rms"]["maps alone"] > 5.0
    assert said.endswith("bias of gyro x: only the mean of heating and cooling is exported; the hysteresis is lost\n")
