"""Notebooks use the public API alone."""

import ast

import pytest
from notebook_cells import FOLDER, committed

import gradcal_jax as gj
from gradcal_jax import plots


@pytest.mark.parametrize("name", sorted(path.stem for path in FOLDER.glob("*.ipynb")))
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
