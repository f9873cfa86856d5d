"""Before and beside a run: the dry run, what is tried on the rig, the list, the status file, and the alarm."""

import io
import json
import os
import sys
import time

import pytest
from hardware_bench import Rig, short_recipe

from gradcal_jax.cli import main
from gradcal_jax.hardware.clock import RealClock, VirtualClock
from gradcal_jax.hardware.execute import run_session
from gradcal_jax.hardware.run_folder import RunFolder, new_folder
from gradcal_jax.hardware.supervision import read_status
from gradcal_jax.records.run_log import log
from gradcal_jax.spec.rig import rig_of
from gradcal_jax.tables.writing import write_toml

SLOWER = {"rig.table.axis[0].max_acceleration": "300 deg/s^2"}
# Writes its last word into the file that is named before it.
ALARM = [sys.executable, "-c", "import sys; open(sys.argv[1], 'a').write(sys.argv[2] + '\\n')"]


@pytest.fixture
def made(tmp_path):
    write_toml(short_recipe(changes=SLOWER), tmp_path / "recipe.toml")
    return tmp_path / "recipe.toml"


def with_alarm(rig, heard):
    return rig_of(rig.model_dump(mode="json", exclude_unset=True) | {"alarm": {"command": [*ALARM, str(heard)]}})


def commands(lab):
    return [text for text in lab.chamber.commands if not text.endswith("?") and "?," not in text]


def test_a_dry_run_says_what_every_device_is_told_and_tells_them_nothing(made, tmp_path, capsys):
    with Rig(RealClock()) as lab:
        write_toml(lab.rig, tmp_path / "rig.toml")
        asked = ["run", str(made), "--rig", str(tmp_path / "rig.toml"), "--dry-run"]
        assert main(asked) == 0
        said = capsys.readouterr().out
        assert "chamber: 24 to 28 degC, ramps up to 2 K/min" in said
        assert "up to 200 deg/s, 0 to 360 deg" in said
        assert "nothing was moved" in said
        assert main([*asked, "--json"]) == 0
        found = json.loads(capsys.readouterr().out)
        assert found["problems"] == []
        assert (commands(lab), lab.axis.state(0.0)) == ([], (0.0, 0.0))
        tables = lab.rig.model_dump(mode="json", exclude_unset=True)
        tables["chamber"]["never_above"] = "26 degC"
        write_toml(rig_of(tables), tmp_path / "rig.toml")
        assert main(asked) != 0
        assert "sets 28 degC; the chamber accepts -50 to 26" in capsys.readouterr().out
    assert main(asked) != 0  # nobody answers any more
    assert "cannot be opened" in capsys.readouterr().out


class Keyboard(io.StringIO):
    def isatty(self):
        return True


@pytest.mark.parametrize(("keyboard", "words"), [(Keyboard, "nothing was moved"), (io.StringIO, "with --yes")])
def test_the_list_is_confirmed_or_nothing_begins(made, tmp_path, capsys, monkeypatch, keyboard, words):
    with Rig(RealClock()) as lab:
        write_toml(with_alarm(lab.rig, tmp_path / "heard"), tmp_path / "rig.toml")
        monkeypatch.setattr(sys, "stdin", keyboard("no\n"))
        asked = ["run", str(made), "--rig", str(tmp_path / "rig.toml"), "-o", str(tmp_path / "run")]
        assert main(asked) != 0
        said = capsys.readouterr()
        for text in ("24 to 28 degC", "up to 200 deg/s", '"hold"', "command that an alarm executes: "):
            assert text in said.out
        assert words in said.err
        assert not (tmp_path / "run").exists()
        assert (commands(lab), lab.axis.state(0.0)) == ([], (0.0, 0.0))


def test_who_and_what_are_kept_and_the_status_tells_how_a_run_stands(tmp_path, capsys):
    clock = VirtualClock()
    seen = []
    with Rig(clock) as lab:
        about = {"operator": "A. Person", "note": "second try"}
        run = new_folder(tmp_path / "run", short_recipe(2.0, changes=SLOWER), lab.rig, simulated={}, about=about)

        def look(progress):
            # The file is replaced whole: whoever reads it at any time finds all of it.
            if (run.path / "status.json").exists():
                seen.append(read_status(run.path))

        result = run_session(run, clock, on_progress=look)
    assert (result.exit_status, result.verified_safe) == ("success", True)
    last = read_status(run.path)
    assert (last["exit_status"], last["state"], last["simulated"]) == ("success", "safe", True)
    assert last["samples"]["unit1"][0] > 1000
    assert last["samples"]["unit1"][1] == 0
    running = [status for status in seen if status["state"] == "running"]
    assert running
    assert any(status["course_c"] and status["chamber"]["air_c"] > 24.5 for status in running)
    assert RunFolder(run.path).notes()["about"] == about
    assert log(run.path).provenance["operator"] == "A. Person"
    assert main(["rig", "watch", str(run.path)]) == 0
    said = capsys.readouterr().out
    assert "ended: success" in said
    (run.path / "status.json").write_text(json.dumps(running[0] | {"at_s": time.time() - 300.0}))
    assert main(["rig", "watch", str(run.path)]) != 0
    assert "the run has not written its status for" in capsys.readouterr().err
    assert main(["rig", "watch", str(tmp_path)]) != 0
    assert "not the folder of a run" in capsys.readouterr().err


def test_an_alarm_of_the_chamber_calls_the_command_of_the_rig_file(tmp_path):
    clock = VirtualClock()
    with Rig(clock) as lab:
        rig = with_alarm(lab.rig, tmp_path / "heard")
        run = new_folder(tmp_path / "run", short_recipe(2.0, changes=SLOWER), rig, simulated={})

        def alarm(progress):
            if progress.steps_done == 1:
                lab.chamber.raise_alarm(18)

        result = run_session(run, clock, on_progress=alarm)
    assert result.exit_status == "aborted"
    heard = wait_for(tmp_path / "heard")
    assert "aborted" in heard
    assert "18" in heard
    assert read_status(run.path)["exit_status"] == "aborted"


def wait_for(path):
    end = time.monotonic() + 20.0
    while not (path.exists() and os.path.getsize(path)) and time.monotonic() < end:
        time.sleep(0.1)
    time.sleep(0.1)
    return path.read_text()
