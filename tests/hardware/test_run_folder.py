"""The folder of a run: made only for what can run, and what it began as: rig and recipe are remembered."""

import numpy as np
import pytest
from hardware_bench import short_recipe

from gradcal_jax import __version__
from gradcal_jax.hardware.errors import HardwareError, WrongIdentity
from gradcal_jax.hardware.execute import resume, run
from gradcal_jax.hardware.roles import Identity
from gradcal_jax.hardware.run_folder import RunFolder, RunFolderError, new_folder, prepare_resume
from gradcal_jax.hardware.simulate.lab import SimulatedAxis
from gradcal_jax.records.run_log import log
from gradcal_jax.spec.rig import TEMPLATE, parse_rig
from gradcal_jax.tables.writing import write_toml


def rig_of(*axes):
    rig = parse_rig(TEMPLATE)
    (table,) = rig.axis
    return rig.model_copy(update={"axis": tuple(table.model_copy(update={"name": name}) for name in axes)})


def test_a_rig_without_the_axis_leaves_no_folder_behind(tmp_path):
    made = short_recipe()
    for _ in range(2):
        with pytest.raises(HardwareError, match="The recipe turns axis x, and the rig's axes are inner, outer"):
            run(made, tmp_path / "run", rig=rig_of("inner", "outer"))
    assert not (tmp_path / "run").exists()


@pytest.fixture(scope="module")
def ended(tmp_path_factory):
    """A simulated run that was aborted in its last step, with data."""
    folder = tmp_path_factory.mktemp("runs") / "run"

    def stop(progress):
        if progress.steps_done == progress.steps - 1:
            raise HardwareError("enough")

    made = short_recipe(2.0)
    result = run(made, folder, simulate=True, on_progress=stop)
    assert result.reason == "enough"
    return folder


def test_another_run_has_another_folder(ended):
    folder = RunFolder(ended)
    assert prepare_resume(folder) > 0
    with pytest.raises(RunFolderError, match=r"gradcal run --resume .* or name a new folder"):
        new_folder(ended, folder.recipe(), folder.rig())


@pytest.mark.parametrize(
    ("file", "old", "new", "said"),
    [
        ("rig.toml", 'safe = "standby"', 'safe = "hold"', "another rig"),
        ("run.json", f'"version": "{__version__}"', '"version": "0.0.1"', "another version"),
        ("recipe.toml", '"a test"', '"another"', "another recipe"),
    ],
)
def test_a_run_does_not_go_on_as_another(ended, file, old, new, said):
    text = (ended / file).read_text()
    assert old in text
    try:
        (ended / file).write_text(text.replace(old, new))
        with pytest.raises(RunFolderError, match=said):
            resume(ended)
    finally:
        (ended / file).write_text(text)


def test_a_run_does_not_go_on_with_another_device(ended, monkeypatch):
    monkeypatch.setattr(SimulatedAxis, "identify", lambda self: Identity("simulated", "another axis"))
    commanded = list[str]()
    monkeypatch.setattr(SimulatedAxis, "safe", lambda self, how: commanded.append(how))
    with pytest.raises(WrongIdentity, match=r"x at .* is another device .*model 'another axis'"):
        resume(ended)
    assert not commanded


def test_a_log_is_decoded_as_the_run_was_configured(ended):
    before, text = log(ended), (ended / "rig.toml").read_text()
    rig = RunFolder(ended).rig()
    rig.imu[0].options["sample_rate"] = "500 Hz"
    try:
        write_toml(rig, ended / "rig.toml")
        after = log(ended)
    finally:
        (ended / "rig.toml").write_text(text)
    np.testing.assert_array_equal(after.time_s, before.time_s)
    np.testing.assert_array_equal(after.rate_rad_per_s, before.rate_rad_per_s)
