"""The notebook that designs a plan: prediction, search, limit, frontier, sensitivities."""

import numpy as np
import pytest
from notebook_cells import check_as_executed, executed, printed, run_cells

NAME = "designing_a_plan"


def in_order(names):
    """What has to hold of any design, however few the steps."""
    best, proof = names["best"], names["proof"]
    assert best.now < 0.8 * best.before
    assert proof.certified < best.now
    assert proof.value == pytest.approx(best.now, rel=1e-9)
    assert names["recipe"].prediction.requirements[0].decisive == pytest.approx(best.now, rel=1e-9)
    worth = {entry.figure: entry.percent for entry in names["worth"].rows}
    assert worth["reading noise"] > 0.2
    assert worth["time: ramp and turns last longer"] < 0.0


def test_it_is_committed_as_executed_and_its_search_converged():
    said = check_as_executed(NAME, pictures=3)
    assert "converged: " in said
    assert "no plan leaves less than" in said


@pytest.mark.evidence
def test_its_cells_run_with_a_short_search_and_no_frontier(monkeypatch):
    names, said = run_cells(NAME, monkeypatch, without="gj.frontier(", STEPS=20)
    in_order(names)
    assert f"-> {names['best'].now:.3g} ppm" in said


@pytest.mark.evidence
@pytest.mark.filterwarnings("ignore::DeprecationWarning")  # of the kernel's own machinery
def test_executed_anew_the_design_comes_out_alike():
    """The prediction and the proof to the digit; searches end where they end, to the digits that are printed."""
    before, after = executed(NAME)
    assert printed(after) == printed(before)


@pytest.mark.evidence
def test_with_all_its_steps_more_time_is_never_worse(monkeypatch):
    names, _ = run_cells(NAME, monkeypatch)
    in_order(names)
    assert names["best"].converged
    found = [point.plan.now for point in names["points"]]
    assert np.all(np.diff(found) < 0.0)
