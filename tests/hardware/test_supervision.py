"""Before and beside a run: the dry run, what is tried on the rig, the list, the status file, and the alarm."""

import io
import json
import os
import sys
import time

import pytest
from hardware_bench import Rig, gradcal_run, rig_with, short_recipe

from gradcal_jax.cli import main
from gradcal_jax.hardware.clock import RealClock, VirtualClock
from gradcal_jax.hardware.execute import run_session
from gradcal_jax.hardware.run_folder import RunFolder, new_folder
from gradcal_jax.hardware.supervision import read_status
from gradcal_jax.records.run_log import log

# Writes its last word into the file that is named before it.
ALARM = [sys.executable, "-c", "import sys; open(sys.argv[1], 'a').write(sys.argv[2] + '\\n')"]


def with_alarm(rig, heard):
    return rig_with(rig, alarm={"command": [*ALARM, str(heard)]})


def is_untold(lab):
    asked = all(text.endswith("?") or "?," in text for text in lab.chamber.commands)
    return asked and lab.axis.state(0.0) == (0.0, 0.0)


def test_a_dry_run_says_what_every_device_is_told_and_tells_them_nothing(tmp_path, capsys):
    with Rig(RealClock()) as lab:
        assert gradcal_run(tmp_path, lab.rig, "--dry-run") == 0
        said = capsys.readouterr().out
        assert "chamber: 24 to 28 degC, ramps up to 2 K/min" in said
        assert "up to 200 deg/s, 0 to 360 deg" in said
        assert "nothing was moved" in said
        assert gradcal_run(tmp_path, lab.rig, "--dry-run", "--json") == 0
        assert json.loads(capsys.readouterr().out)["problems"] == []
        assert is_untold(lab)
        chamber = lab.rig.chamber.model_dump(mode="json", exclude_unset=True) | {"never_above": "26 degC"}
        assert gradcal_run(tmp_path, rig_with(lab.rig, chamber=chamber), "--dry-run") != 0
        assert "sets 28 degC; the chamber accepts -50 to 26" in capsys.readouterr().out
    assert gradcal_run(tmp_path, lab.rig, "--dry-run") != 0  # nobody answers any more
    assert "cannot be opened" in capsys.readouterr().out


class Keyboard(io.StringIO):
    def isatty(self):
        return True


@pytest.mark.parametrize(("keyboard", "words"), [(Keyboard, "nothing was moved"), (io.StringIO, "with --yes")])
def test_the_list_is_confirmed_or_nothing_begins(tmp_path, capsys, monkeypatch, keyboard, words):
    monkeypatch.setattr(sys, "stdin", keyboard("no\n"))
    with Rig(RealClock()) as lab:
        assert gradcal_run(tmp_path, with_alarm(lab.rig, tmp_path / "heard"), "-o", str(tmp_path / "run")) != 0
        said = capsys.readouterr()
        for text in ("24 to 28 degC", "up to 200 deg/s", '"hold"', "command that an alarm executes: "):
            assert text in said.out
        assert words in said.err
        assert not (tmp_path / "run").exists()
        assert is_untold(lab)


def is_warm(status):
    return bool(status.get("course_c")) and status["chamber"]["air_c"] > 24.5


def test_who_and_what_are_kept_and_the_status_tells_how_a_run_stands(tmp_path, capsys):
    seen = []
    with Rig(VirtualClock()) as lab:
        about = {"operator": "A. Person", "note": "second try"}
        run = new_folder(tmp_path / "run", short_recipe(2.0), lab.rig, simulated={}, about=about)

        def look(progress):
            # (A thread of its own writes the file: the run waits once, with warm air, until the file says so.)
            end = time.monotonic() + 20.0 * (is_warm(progress.as_status()) and not any(map(is_warm, seen)))
            while True:
                # The file is replaced whole: whoever reads it at any time finds all of it.
                if (run.path / "status.json").exists():
                    seen.append(read_status(run.path))
                if time.monotonic() > end or any(map(is_warm, seen)):
                    return
                time.sleep(0.05)

        result = run_session(run, lab.clock, on_progress=look)
    assert (result.exit_status, result.verified_safe) == ("success", True)
    last = read_status(run.path)
    assert (last["exit_status"], last["state"], last["simulated"]) == ("success", "safe", True)
    samples, lost = last["samples"]["imu1"]
    assert (samples > 1000, lost) == (True, 0)
    running = [status for status in seen if status["state"] == "running"]
    assert any(is_warm(status) for status in running)
    assert RunFolder(run.path).notes()["about"] == about
    assert log(run.path).provenance["operator"] == "A. Person"
    assert main(["rig", "watch", str(run.path)]) == 0
    assert "ended: success" in capsys.readouterr().out
    (run.path / "status.json").write_text(json.dumps(running[0] | {"at_s": time.time() - 300.0}))
    assert main(["rig", "watch", str(run.path)]) != 0
    assert "the run has not written its status for" in capsys.readouterr().err
    assert main(["rig", "watch", str(tmp_path)]) != 0
    assert "not the folder of a run" in capsys.readouterr().err


def test_an_alarm_of_the_chamber_calls_the_command_of_the_rig_file(tmp_path):
    with Rig(VirtualClock()) as lab:
        rig = with_alarm(lab.rig, tmp_path / "heard")
        run = new_folder(tmp_path / "run", short_recipe(2.0), rig, simulated={})

        def alarm(progress):
            if progress.steps_done == 1:
                lab.chamber.raise_alarm(18)

        result = run_session(run, lab.clock, on_progress=alarm)
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
