"""The folder of a run: made only for what can run, taken over only from a run that never began."""

from pathlib import Path

import pytest
from hardware_bench import short_recipe

from gradcal_jax.hardware.errors import HardwareError
from gradcal_jax.hardware.execute import run
from gradcal_jax.hardware.journal import Journal
from gradcal_jax.hardware.run_folder import RunFolderError, begin_session, new_folder
from gradcal_jax.spec.rig import TEMPLATE, RigFile, parse_rig


def rig_of(*axes: str) -> RigFile:
    rig = parse_rig(TEMPLATE)
    (table,) = rig.axis
    return rig.model_copy(update={"axis": tuple(table.model_copy(update={"name": name}) for name in axes)})


def test_a_rig_without_the_axis_leaves_no_folder_behind(tmp_path: Path) -> None:
    made = short_recipe()
    for _ in range(2):
        with pytest.raises(HardwareError, match="The recipe turns axis x, and the rig's axes are inner, outer"):
            run(made, tmp_path / "run", rig=rig_of("inner", "outer"))
    assert not (tmp_path / "run").exists()


def test_only_a_run_that_never_began_is_taken_over(tmp_path: Path) -> None:
    made, rig, path = short_recipe(), rig_of("x"), tmp_path / "run"
    folder = new_folder(path, made, rig, simulated={"seed": 1})
    Journal(folder.journal_path).close()
    assert not new_folder(path, made, rig).notes()["simulated"]
    assert not folder.journal_path.exists()
    with Journal(folder.journal_path) as journal:
        begin_session(journal, 0.0, 0, rig, simulated=False, first_step=0)
    with pytest.raises(RunFolderError, match="gradcal run --resume"):
        new_folder(path, made, rig)


@pytest.mark.parametrize("names", [("journal", "recipe.toml"), ("journal", "run.json", "recipe.toml", "notes.txt")])
def test_nothing_of_anybody_else_is_taken_away(names: tuple[str, ...], tmp_path: Path) -> None:
    for name in names:
        (tmp_path / name).write_text("of my own")
    with pytest.raises(RunFolderError, match="is not empty"):
        new_folder(tmp_path, short_recipe(), rig_of("x"))
    assert {entry.name: entry.read_text() for entry in tmp_path.iterdir()} == dict.fromkeys(names, "of my own")
