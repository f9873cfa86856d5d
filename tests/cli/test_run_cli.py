"""`gradcal rig`, `run` and `log` as users have them: statuses, sentences, Ctrl-C."""

import json
import os
import signal
import subprocess
import sys
import time
import tomllib
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

import pytest
from made_recipe import made_of
from simulated_devices.port_lab import SimulatedLab

from gradcal_jax.cli import main
from gradcal_jax.hardware.clock import RealClock
from gradcal_jax.hardware.journal import read_journal
from gradcal_jax.recipe.tracks import Stability
from gradcal_jax.records.log_file import read_log
from gradcal_jax.spec import presets
from gradcal_jax.spec.changes import changed
from gradcal_jax.spec.spec import parse_spec
from gradcal_jax.tables.writing import to_toml

CHANGES = """
"plan.temperature" = ["23 degC", "24 degC"]
"plan.gradient" = "2 K/min"
"plan.soak" = "2 s"
"rig.table.axis[0].travel" = "360 deg"  # all of which a plan may use
"plan.cycle.moves" = [
  { rest = "3 s", read_every = "1 s" },
  { turn = "360 deg", peak_rate = "200 deg/s", shape = "linear ramps" },
  { turn = "-360 deg", peak_rate = "200 deg/s", shape = "linear ramps" },
]
"""


def a_recipe(folder: Path) -> Path:
    quick = Stability.model_validate({"for_at_least": "20 s"})
    changes = tomllib.loads(CHANGES) | {"plan.cycle.other_axes": None}
    made = made_of(changed(parse_spec(presets.text("paper-dynamic-gradient")), changes), quick)
    path = folder / "recipe.toml"
    path.write_text(to_toml(made), encoding="utf-8")
    return path


def test_a_rehearsal_from_recipe_to_log(tmp_path, capsys):
    recipe, run = a_recipe(tmp_path), tmp_path / "run"
    assert main(["run", str(recipe), "--simulate", "--seed", "4", "-o", str(run)]) == 0
    said = capsys.readouterr().out
    assert "simulated devices: a rehearsal, not a measurement" in said
    assert "step 1 of" in said
    assert "chamber: safe (standby" in said
    assert "gyro_x.b00" in json.loads((run / "hidden_truth.json").read_text())["units"]["unit1"]
    assert main(["log", str(run)]) == 0
    assert "(simulated devices)" in capsys.readouterr().out
    first = (run / "log.nc").read_bytes()
    log = read_log(run / "log.nc")
    assert log.simulated
    assert main(["log", str(run), "-o", str(tmp_path / "again.nc")]) == 0
    assert len((tmp_path / "again.nc").read_bytes()) == len(first)
    assert (read_log(tmp_path / "again.nc").rate_rad_per_s == log.rate_rad_per_s).all()
    capsys.readouterr()
    assert main(["run", "--resume", str(run)]) == 2
    assert "is complete" in capsys.readouterr().err


@pytest.mark.long
def test_a_rig_is_checked_and_what_does_not_answer_is_said(tmp_path, capsys):
    path = tmp_path / "rig.toml"
    path.write_text(presets.template("rig.toml"), encoding="utf-8")
    assert main(["rig", "check", str(path)]) == 3
    # All of them, not the first alone.
    assert capsys.readouterr().out.count("cannot be opened") == 3
    with SimulatedLab(parse_spec(presets.text("paper-dynamic-gradient")), RealClock()) as lab:
        path.write_text(to_toml(lab.rig), encoding="utf-8")
        assert main(["rig", "check", str(path)]) == 0
        said = capsys.readouterr().out
        assert "STIM300" in said
        assert "every device answers as the rig file states" in said
        # The chamber's driver on the table's port: what was sent and what came back.
        wrong = to_toml(lab.rig).replace(lab.ports[0].url, "X").replace(lab.ports[1].url, lab.ports[0].url)
        wrong = wrong.replace('"X"', f'"{lab.ports[1].url}"')
        quick = wrong.replace("options = {", 'options = { reply_timeout = "0.3 s",', 1)
        assert quick != wrong
        path.write_text(quick, encoding="utf-8")
        assert main(["rig", "check", str(path), "--json"]) == 3
        reports = {entry["name"]: entry for entry in json.loads(capsys.readouterr().out)}
        problem = reports["chamber"]["problem"]
        assert problem.startswith("ESPEC at ")
        assert "was sent 'TYPE?" in problem
        assert "Check that the port belongs to this device" in problem
        assert "was sent '$I" in reports["x"]["problem"]


@pytest.mark.parametrize(
    ("words", "said"),
    [
        (["recipe.toml"], "the recipe or the output folder is missing"),
        (["recipe.toml", "-o", "run"], "name the rig with --rig RIG or use --simulate"),
        (["--resume", "run", "--simulate"], "--resume needs only the folder"),
        (["--resume", "run"], "is not the folder of a run"),
        (["recipe.toml", "--simulate", "-o", "run", "--sample-rate", "100 Hz"], "does not sample at 100 Hz"),
    ],
)
def test_slips_are_sentences(words, said, tmp_path, capsys, monkeypatch):
    a_recipe(tmp_path)
    monkeypatch.chdir(tmp_path)
    assert main(["run", *words]) == 2
    assert said in capsys.readouterr().err


@contextmanager
def on_terminal(recipe: Path, run: Path, *more: str, **streams: int) -> Iterator[tuple[subprocess.Popen, int]]:
    """The command in a process, and the other end of its terminal: each of the `streams` that is 0 is on it."""
    program = "import sys; from gradcal_jax.cli import main; sys.exit(main())"
    words = [sys.executable, "-c", program, "run", str(recipe), "--simulate", *more, "-o", str(run)]
    leader, follower = os.openpty()
    process = subprocess.Popen(words, **{name: value or follower for name, value in streams.items()}, text=True)
    os.close(follower)
    try:
        yield process, leader
    finally:
        process.kill()
        os.close(leader)


def until(run: Path, name: str) -> None:
    """Waits for an event in the journal."""
    journal, end = run / "journal", time.monotonic() + 120.0
    while not (journal.exists() and any(event.name == name for event in read_journal(journal).events)):
        assert time.monotonic() < end, f"no {name} in the journal"
        time.sleep(0.1)


@pytest.mark.parametrize("stdin", [0, subprocess.DEVNULL])
def test_ctrl_c_makes_safe_and_ends(tmp_path, stdin):
    recipe, run = a_recipe(tmp_path), tmp_path / "run"
    # Enough samples to be interrupted in the middle.
    many = ["--units", "8", "--sample-rate", "2000 Hz"]
    said = {"stdin": stdin, "stdout": subprocess.PIPE, "stderr": subprocess.PIPE}
    with on_terminal(recipe, run, *many, **said) as (process, _):
        until(run, "step begins")
        process.send_signal(signal.SIGINT)
        out, err = process.communicate(timeout=90.0)
    assert process.returncode == 130, err
    assert "chamber: safe" in out
    assert f"gradcal run --resume {run}" in err
    states = [event.data["state"] for event in read_journal(run / "journal").events if event.name == "state"]
    assert states == ["running", "aborting", "safe"]


def test_a_terminal_that_was_told_to_stop_stops_no_run(tmp_path):
    recipe, run = a_recipe(tmp_path), tmp_path / "run"
    with on_terminal(recipe, run, stdin=0, stdout=0, stderr=0, start_new_session=True) as (process, leader):
        said = b""
        while b"step 1 of" not in said:
            said += os.read(leader, 4096)
        os.write(leader, b"\x13")  # Ctrl-S
        until(run, "end")
        os.write(leader, b"\x11")  # Ctrl-Q
        while b"write the log" not in said:
            said += os.read(leader, 4096)
        assert process.wait(timeout=30.0) == 0
