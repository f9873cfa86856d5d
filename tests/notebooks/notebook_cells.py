"""Notebooks in the tests: as they are committed, executed anew as a whole, and cell by cell in this process."""

import contextlib
import io
import re
from pathlib import Path
from typing import Any

import matplotlib as mpl
import matplotlib.pyplot as plt
import pytest

nbformat = pytest.importorskip("nbformat")

FOLDER = Path(__file__).parents[2] / "notebooks"
# What only the machine that executed a notebook has.
MACHINE = re.compile(r"/(home|root|tmp|work|Users|var)/|\\\\Users\\\\")


def committed(name: str) -> Any:
    """The notebook as it is in the repository."""
    return nbformat.read(FOLDER / f"{name}.ipynb", as_version=4)


def printed(notebook: Any) -> list[tuple[str, int]]:
    """What each cell prints, and how many pictures it draws."""
    found = []
    for cell in notebook.cells:
        outputs = cell.get("outputs", [])
        text = "".join(o["text"] for o in outputs if o["output_type"] == "stream" and o["name"] == "stdout")
        found.append((text, sum("image/png" in o.get("data", {}) for o in outputs)))
    return found


def check_as_executed(name: str, pictures: int) -> str:
    """Sound, small, executed from the first cell to the last without an error; all that it prints."""
    notebook = committed(name)
    nbformat.validate(notebook)
    code = [cell for cell in notebook.cells if cell.cell_type == "code"]
    assert [cell.execution_count for cell in code] == list(range(1, len(code) + 1))
    assert not any(o["output_type"] == "error" or o.get("name") == "stderr" for cell in code for o in cell.outputs)
    assert sum(count for _, count in printed(notebook)) == pictures
    assert (FOLDER / f"{name}.ipynb").stat().st_size < 300_000
    assert not MACHINE.search((FOLDER / f"{name}.ipynb").read_text(encoding="utf-8"))
    return "".join(text for text, _ in printed(notebook))


def executed(name: str) -> tuple[Any, Any]:
    """The notebook as committed, and as a kernel of its own executes it now."""
    nbclient = pytest.importorskip("nbclient")
    before, after = committed(name), committed(name)
    nbclient.NotebookClient(
        after, timeout=600, kernel_name="python3", resources={"metadata": {"path": str(FOLDER)}}
    ).execute()
    return before, after


def run_cells(
    name: str, monkeypatch: pytest.MonkeyPatch, *, without: str = "\0", only: str = "", **settings: object
) -> tuple[dict[str, Any], str]:
    """Run a notebook's code here: its names, and what it prints.

    `settings` in the place of those of its cell of that tag; `without` the cells that have this in them; after the
    imports, `only` the cells of this tag.
    """
    monkeypatch.chdir(FOLDER)
    names: dict[str, Any] = {"__name__": "notebook"}
    text = io.StringIO()
    with contextlib.redirect_stdout(text), mpl.rc_context():
        for number, cell in enumerate(committed(name).cells):
            tags = cell.metadata.get("tags", [])
            if cell.cell_type != "code" or without in cell.source:
                continue
            if only and only not in tags and "import gradcal_jax" not in cell.source:
                continue
            lines = "\n".join(line for line in cell.source.splitlines() if not line.startswith("%"))
            exec(compile(lines, f"{name}, cell {number + 1}", "exec"), names)
            if "settings" in tags:
                assert set(settings) <= set(names)
                names |= settings
        plt.close("all")
    return names, text.getvalue()
