"""The notebook of a run and its calibration is committed as executed, and comes out alike anew."""

import re
from pathlib import Path

import pytest
from test_instability_notebook import printed

nbformat = pytest.importorskip("nbformat")
nbclient = pytest.importorskip("nbclient")

NOTEBOOK = Path(__file__).parents[2] / "notebooks" / "calibration_from_a_run.ipynb"


def test_the_calibration_is_committed_as_executed():
    committed = nbformat.read(NOTEBOOK, as_version=4)
    nbformat.validate(committed)
    code = [cell for cell in committed.cells if cell.cell_type == "code"]
    assert [cell.execution_count for cell in code] == list(range(1, len(code) + 1))
    assert not any(output["output_type"] == "error" for cell in code for output in cell.outputs)
    said = "".join(text for text, _ in printed(committed))
    assert "success; everything left verified safe: True" in said
    assert "simulated: True" in said
    assert sum(count for _, count in printed(committed)) == 1
    assert NOTEBOOK.stat().st_size < 300_000


@pytest.mark.evidence
@pytest.mark.filterwarnings("ignore::DeprecationWarning")  # of the kernel's own machinery
def test_the_run_and_its_calibration_come_out_alike():
    """Plan and recipe to the digit; what the rehearsal's threads touch to a fifth of a standard deviation."""
    committed = nbformat.read(NOTEBOOK, as_version=4)
    before = [text for text, _ in printed(committed)]
    found = next(place for place, text in enumerate(before) if "truth" in text)
    client = nbclient.NotebookClient(
        committed, timeout=300, kernel_name="python3", resources={"metadata": {"path": str(NOTEBOOK.parent)}}
    )
    client.execute()
    after = [text for text, _ in printed(committed)]
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
