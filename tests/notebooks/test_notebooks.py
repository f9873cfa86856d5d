"""Notebooks are committed as executed, run again from the first cell to the last, and use the public API alone."""

import ast
import re
from pathlib import Path

import pytest

import gradcal_jax as gj
from gradcal_jax import plots

nbformat = pytest.importorskip("nbformat")
FOLDER = Path(__file__).parents[2] / "notebooks"
NAMES = sorted(path.stem for path in FOLDER.glob("*.ipynb"))
# What only the machine that executed a notebook has.
MACHINE = re.compile(r"/(home|root|tmp|work|Users|var)/")


def committed(name):
    """The notebook as it is in the repository."""
    return nbformat.read(FOLDER / f"{name}.ipynb", as_version=4)


@pytest.mark.parametrize("name", NAMES)
def test_a_notebook_imports_no_inner_room(name):
    """`gradcal_jax` and its `plots`, and of them what their `__all__` names."""
    cells = [cell.source for cell in committed(name).cells if cell.cell_type == "code"]
    code = ast.parse("\n".join(line for cell in cells for line in cell.splitlines() if not line.startswith("%")))
    imported = {ast.unparse(node) for node in ast.walk(code) if isinstance(node, ast.Import | ast.ImportFrom)}
    ours = {line for line in imported if "gradcal_jax" in line}
    # The base of a class of one's own (docs/how-to/own-term.md).
    own = "from gradcal_jax.model import OwnTerm, constant_function"
    assert ours <= {"import gradcal_jax as gj", "from gradcal_jax import plots", own}
    used = [n for n in ast.walk(code) if isinstance(n, ast.Attribute) and isinstance(n.value, ast.Name)]
    assert {n.attr for n in used if n.value.id == "gj"} <= set(gj.__all__)
    assert {n.attr for n in used if n.value.id == "plots"} <= set(plots.__all__)


@pytest.mark.parametrize("name", NAMES)
def test_a_notebook_is_committed_as_executed(name):
    notebook = committed(name)
    nbformat.validate(notebook)
    code = [cell for cell in notebook.cells if cell.cell_type == "code"]
    assert [cell.execution_count for cell in code] == list(range(1, len(code) + 1))
    assert not any(o["output_type"] == "error" or o.get("name") == "stderr" for cell in code for o in cell.outputs)
    assert any("image/png" in o.get("data", {}) for cell in code for o in cell.outputs)
    assert (FOLDER / f"{name}.ipynb").stat().st_size < 300_000
    assert not MACHINE.search((FOLDER / f"{name}.ipynb").read_text(encoding="utf-8"))


@pytest.mark.long
@pytest.mark.filterwarnings("ignore::DeprecationWarning")  # of the kernel's own machinery
@pytest.mark.parametrize("name", NAMES)
def test_a_notebook_runs(name):
    nbclient = pytest.importorskip("nbclient")
    resources = {"metadata": {"path": str(FOLDER)}}
    nbclient.NotebookClient(committed(name), timeout=600, kernel_name="python3", resources=resources).execute()
