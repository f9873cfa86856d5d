"""Wrong ends and wrong words: what a run, its guard and its checks say of devices that answer otherwise."""

import json
import socket
import threading
import time
from pathlib import Path

import pytest
from hardware_bench import Rig, acting, events, running, short_recipe, short_track
from simulated_devices.faults import Spoils

from gradcal_jax.cli import main
from gradcal_jax.hardware import guard
from gradcal_jax.hardware.clock import RealClock
from gradcal_jax.hardware.errors import Disconnected
from gradcal_jax.hardware.execute import run_session
from gradcal_jax.hardware.guard import Guard, make_safe
from gradcal_jax.hardware.run_folder import new_folder
from gradcal_jax.hardware.setup import check_each, open_rig
from gradcal_jax.hardware.supervision import read_status
from gradcal_jax.spec.rig import rig_of
from gradcal_jax.tables.writing import write_toml

FORMAT = {"format": "gradcal-rig/1"}


# --------------------------------------------------------------------------------------------------- after the guard


def test_after_the_guard_the_status_says_how_it_ended(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    clock = RealClock()
    status = {"format": "gradcal-status/1", "at_s": time.time(), "simulated": False, "state": "running", "step": "turn"}
    status |= {"steps": 2, "steps_done": 1, "axes": {}, "samples": {}, "track_left_s": 100.0}
    with Rig(clock, on_terminals=True) as rig:
        write_toml(rig.rig, tmp_path / "rig.toml")
        (tmp_path / "status.json").write_text(json.dumps(status))
        guard.make_folder_safe(tmp_path, deadline_s=10.0)
        found = read_status(tmp_path)
        assert (found["exit_status"], found["state"], found["verified_safe"]) == ("lost", "safe", True)
        assert "the run has ended unexpectedly" in found["reason"]
        assert "the guard: the run has ended unexpectedly" in (said := capsys.readouterr().err)
        assert "everything is verified safe" in said
        # What cannot be made safe is said, too.
        rig.ports[0].unplug()
        guard.make_folder_safe(tmp_path, deadline_s=0.2)
        assert read_status(tmp_path)["state"] == "failed"
        assert "NOT VERIFIED SAFE: chamber" in capsys.readouterr().err
    assert main(["rig", "watch", str(tmp_path)]) == 3
    assert "ended: lost, the run has ended unexpectedly" in capsys.readouterr().out


def test_a_start_that_commanded_nothing_leaves_the_ports_to_the_next_one(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """The chamber is off: it can neither answer nor be verified safe, and nothing was commanded."""
    clock = RealClock()
    told: list[str] = []
    done, begun = Guard.done, Guard.begun
    monkeypatch.setattr(Guard, "done", lambda self: (told.append("done"), done(self)))
    monkeypatch.setattr(Guard, "begun", lambda self: (told.append("begun"), begun(self)))
    with Rig(clock) as rig:
        tables = rig.rig.model_dump(mode="json", exclude_unset=True)
        tables["chamber"]["options"]["reply_timeout"] = "0.1 s"
        run = new_folder(tmp_path / "run", short_recipe(1.0), rig_of(tables), simulated={})
        rig.ports[0].faults = lambda message: []
        result = run_session(run, rig_of(tables), clock, guard=True, safe_deadline_s=1.0)
        assert (result.begun, result.verified_safe) == (False, False)
        assert told == ["done"]
        open_rig(rig.rig, clock).close()


# -------------------------------------------------------------------------------------------------- what a check says


def test_a_device_that_is_asked_nothing_by_its_limits_has_to_answer_all_the_same() -> None:
    """A socket that accepts and says nothing, in the place of a chamber whose limits stand in its description."""
    with socket.create_server(("127.0.0.1", 0)) as mute:
        options = {"protocol": "cts", "reply_timeout": "0.1 s"}
        url = f"socket://127.0.0.1:{mute.getsockname()[1]}"
        chamber = {"driver": "lines", "port": url, "safe": "standby", "options": options}
        (report,) = check_each(rig_of({**FORMAT, "chamber": chamber}), RealClock())
    assert "did not answer" in report.problem


# ---------------------------------------------------------------------------------------------------------- messages


def test_a_run_that_never_began_is_not_called_sound(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    with Rig(RealClock()) as rig:
        tables = rig.rig.model_dump(mode="json", exclude_unset=True)
        tables["axis"][0]["serial_number"] = "another one"
        write_toml(rig_of(tables), tmp_path / "rig.toml")
        write_toml(short_recipe(), tmp_path / "recipe.toml")
        words = ["run", str(tmp_path / "recipe.toml"), "--rig", str(tmp_path / "rig.toml"), "-o", str(tmp_path / "r")]
        assert main([*words, "--yes"]) == 3
    said = capsys.readouterr().err
    assert "the run did not begin, and no command was sent: table at" in said
    assert "sound" not in said


def test_a_cable_that_is_in_again_is_used_to_make_safe() -> None:
    clock = RealClock()
    with Rig(clock) as rig, open_rig(rig.rig, clock) as bench:
        bench.axes["table"].home()
        bench.axes["table"].spin(60.0, 300.0)
        rig.ports[1].unplug()
        with pytest.raises(Disconnected):
            bench.axes["table"].read()
        again = threading.Timer(1.0, rig.ports[1].replug)
        again.start()
        outcomes = {outcome.name: outcome for outcome in make_safe(bench, clock, deadline_s=8.0)}
        again.join()
        assert outcomes["table"].verified, outcomes["table"].evidence
        assert rig.axis.state(clock.now())[1] == 0.0


# ------------------------------------------------------------------------------------------------------ late answers


def late(delay_s: float, begins: bytes = b"") -> Spoils:
    """Messages that begin so come so many seconds after they were sent."""
    return lambda message: [(delay_s if message.startswith(begins) else 0.0, message)]


def test_late_replies_are_said(tmp_path: Path) -> None:
    seen: list[str] = []
    with running(tmp_path, short_track()) as (rig, runner):
        rig.ports[0].faults = late(3.4)
        acting(runner, (lambda progress: bool(progress.remarks), lambda: runner.abort("enough")))
        look = runner.on_progress
        runner.on_progress = lambda progress: (seen.extend(progress.remarks), look(progress))
        runner.run()
    assert "ESPEC at" in seen[0]
    assert "late: raise reply_timeout" in seen[0]
    (event,) = events(tmp_path, "late reply")
    assert event.data["device"] == "chamber"
