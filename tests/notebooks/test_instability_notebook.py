"""The notebook of a real recording runs, and prints what it is committed with."""

import os
from pathlib import Path

import pytest

nbformat = pytest.importorskip("nbformat")
nbclient = pytest.importorskip("nbclient")

NOTEBOOK = Path(__file__).parents[2] / "notebooks" / "instability_of_a_real_sensor.ipynb"
FOLDER = Path(os.environ.get("GRADCAL_DATA", Path(__file__).parents[3] / "shared" / "data"))


def printed(notebook):
    """What each cell prints, and how many pictures it draws."""
    found = []
    for cell in notebook.cells:
        outputs = cell.get("outputs", [])
        text = "".join(o["text"] for o in outputs if o["output_type"] == "stream" and o["name"] == "stdout")
        found.append((text, sum("image/png" in o.get("data", {}) for o in outputs)))
    return found


def test_it_is_committed_as_executed_with_small_pictures():
    committed = nbformat.read(NOTEBOOK, as_version=4)
    nbformat.validate(committed)
    code = [cell for cell in committed.cells if cell.cell_type == "code"]
    assert [cell.execution_count for cell in code] == list(range(1, len(code) + 1))
    assert sum(count for _, count in printed(committed)) == 2
    assert NOTEBOOK.stat().st_size < 300_000
    assert not any(o["output_type"] == "error" for cell in code for o in cell.outputs)


@pytest.mark.evidence
@pytest.mark.filterwarnings("ignore::DeprecationWarning")  # of the kernel's own machinery
@pytest.mark.skipif(not FOLDER.is_dir(), reason="the recorded data are not here: set GRADCAL_DATA")
def test_executed_anew_it_says_the_same(monkeypatch):
    monkeypatch.setenv("GRADCAL_DATA", str(FOLDER))
    committed = nbformat.read(NOTEBOOK, as_version=4)
    before = printed(committed)
    client = nbclient.NotebookClient(
        committed, timeout=300, kernel_name="python3", resources={"metadata": {"path": str(NOTEBOOK.parent)}}
    )
    client.execute()
    assert printed(committed) == before
