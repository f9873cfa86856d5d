"""Wrong ends and wrong words: what a run, its guard and its checks say of devices that answer otherwise."""

import json
import os
import socket
import subprocess
import sys
import threading
import time
from pathlib import Path
from typing import Any

import pytest
from hardware_bench import Rig, cts_bench, espec_bench, espec_config, grbl_bench, short_recipe
from simulated_devices.faults import Faults
from simulated_devices.line_clock import LineClock
from simulated_devices.port import SimulatedPort

from gradcal_jax.cli import main
from gradcal_jax.cli.run import progress_text
from gradcal_jax.hardware import guard
from gradcal_jax.hardware.clock import RealClock
from gradcal_jax.hardware.drivers.lines import LinesConfig
from gradcal_jax.hardware.errors import Disconnected, PortTaken, Rejected, ReplyTimeout
from gradcal_jax.hardware.execute import run_session
from gradcal_jax.hardware.guard import Guard, make_safe
from gradcal_jax.hardware.journal import read_journal
from gradcal_jax.hardware.run_folder import new_folder
from gradcal_jax.hardware.runner import Runner, RunProgress, RunState
from gradcal_jax.hardware.setup import check_each, open_rig
from gradcal_jax.hardware.supervision import read_status
from gradcal_jax.hardware.transport import Transport
from gradcal_jax.spec.rig import rig_of
from gradcal_jax.tables.problems import SpecError
from gradcal_jax.tables.writing import write_toml

FORMAT = {"format": "gradcal-rig/1"}


# --------------------------------------------------------------------------------------------------- after the guard


def test_after_the_guard_the_status_says_how_it_ended(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    clock = RealClock()
    status = {"format": "gradcal-status/1", "at_s": time.time(), "simulated": False, "state": "running", "step": "turn"}
    status |= {"steps": 2, "steps_done": 1, "axes": {}, "samples": {}, "track_left_s": 100.0}
    with Rig(clock) as rig:
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


def test_a_taken_port_names_the_guard_that_holds_it(tmp_path: Path) -> None:
    clock = RealClock()
    with Rig(clock) as rig:
        write_toml(rig.rig, tmp_path / "rig.toml")
        rig.ports[0].faults = lambda message: []
        words = [sys.executable, "-m", "gradcal_jax.hardware.guard", str(tmp_path)]
        process = subprocess.Popen(words, stdin=subprocess.PIPE, stdout=subprocess.PIPE, stderr=subprocess.DEVNULL)
        assert process.stdin is not None
        assert process.stdout is not None
        try:
            assert process.stdout.readline() == b"ready\n"
            process.stdin.write(b"begun\n")
            process.stdin.close()
            said, end = "", time.monotonic() + 20.0
            while "guard" not in said and time.monotonic() < end:
                time.sleep(0.1)
                try:
                    open_rig(rig.rig, clock).close()
                except PortTaken as problem:
                    said = str(problem)
            assert f"the guard of the run {tmp_path}" in said
        finally:
            process.kill()
            process.wait()
            process.stdout.close()


# -------------------------------------------------------------------------------------------------- what a check says


def test_a_device_that_is_asked_nothing_by_its_limits_has_to_answer_all_the_same() -> None:
    """A socket that accepts and says nothing, in the place of a chamber whose limits stand in its description."""
    with socket.create_server(("127.0.0.1", 0)) as mute:
        options = {"protocol": "cts", "reply_timeout": "0.1 s"}
        url = f"socket://127.0.0.1:{mute.getsockname()[1]}"
        chamber = {"driver": "lines", "port": url, "safe": "standby", "options": options}
        (report,) = check_each(rig_of({**FORMAT, "chamber": chamber}), RealClock())
    assert "did not answer" in report.problem


def test_two_names_of_one_adapter_are_one_port(tmp_path: Path) -> None:
    with Rig(RealClock()) as rig:
        by_id = tmp_path / "by-id"
        by_id.symlink_to(rig.ports[1].url)
        axis = {"driver": "lines", "safe": "hold", "gravity_loaded": False, "options": {"protocol": "grbl"}}
        one, two = (axis | {"name": name, "port": str(port)} for name, port in (("a", rig.ports[1].url), ("b", by_id)))
        with open_rig(rig_of({**FORMAT, "axis": [one, two]}), RealClock()) as bench:
            assert bench.axes["a"].read().position_deg == bench.axes["b"].read().position_deg == 0.0
        chamber = {"driver": "lines", "port": str(by_id), "safe": "standby", "options": {"protocol": "espec"}}
        with pytest.raises(SpecError, match="two devices use this port"):
            rig_of({**FORMAT, "chamber": chamber, "axis": [one]})


@pytest.mark.parametrize("long", [False, True])
def test_a_cts_chamber_may_acknowledge_either_way(long: bool) -> None:
    with cts_bench(LineClock()) as (chamber, device, _):
        answer = device._answer

        def acknowledges(text: str) -> str:
            reply = answer(text)
            return {"a": "a0", "u": "u1", "d": "d1"}.get(reply, reply) if long else reply

        device._answer = acknowledges
        chamber.hold(40.0)
        assert chamber.ramp(30.0, 1.5) == pytest.approx(1.5)
        assert device.target_c == 30.0


def test_a_grbl_board_that_reports_inches_is_refused_unless_that_is_left_out() -> None:
    with grbl_bench(LineClock()) as (axis, device, _):
        device.settings[13] = 1.0
        with pytest.raises(Rejected, match=r"with \$13=1 the board reports inches"):
            axis.identify()
    config = LinesConfig(protocol="grbl", reply_timeout="0.2 s", require=False)
    with grbl_bench(LineClock(), config=config) as (axis, device, _):
        device.settings[13] = 1.0
        axis.identify()


def test_a_board_that_restarts_when_its_port_is_opened_is_given_its_time() -> None:
    clock = LineClock()
    began = clock.now()
    with grbl_bench(clock) as (axis, device, _):
        receive, heard = device.receive, list[float]()

        def deaf_at_first(data: bytes) -> list[bytes]:
            heard.append(clock.now())
            return receive(data) if clock.now() - began >= 2.0 else []

        device.receive = deaf_at_first
        axis.identify()
    assert heard[0] - began >= 2.5


# ---------------------------------------------------------------------------------------------------------- messages


def test_without_a_terminal_the_list_is_not_confirmed_by_itself(tmp_path: Path, capsys, monkeypatch) -> None:
    with Rig(RealClock()) as rig:
        write_toml(rig.rig, tmp_path / "rig.toml")
        write_toml(short_recipe(), tmp_path / "recipe.toml")
        with open(os.devnull) as nothing:
            monkeypatch.setattr(sys, "stdin", nothing)
            words = [
                "run",
                str(tmp_path / "recipe.toml"),
                "--rig",
                str(tmp_path / "rig.toml"),
                "-o",
                str(tmp_path / "r"),
            ]
            assert main(words) == 2
        assert "with --yes" in capsys.readouterr().err
        assert not (tmp_path / "r").exists()


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


def test_a_pause_states_its_reason(tmp_path: Path) -> None:
    clock = LineClock()
    runners: list[Runner] = []
    seen: list[str] = []

    def look(progress: RunProgress) -> None:
        if progress.state is RunState.RUNNING and progress.steps_done == 1 and not seen:
            seen.append("")
            runners[0].request("pause", "the operator heard something")
        elif progress.state is RunState.PAUSED:
            seen.append(progress_text(progress, False))
            assert progress.why == "the operator heard something"
            threading.Timer(0.5, lambda: runners[0].request("resume")).start()

    with Rig(clock) as rig:
        changes = {"rig.table.axis[0].max_acceleration": "300 deg/s^2"}
        run = new_folder(tmp_path / "run", short_recipe(2.0, changes=changes), rig.rig, simulated={})
        more = {"on_progress": look, "with_runner": runners.append, "wait_when_paused": True}
        assert run_session(run, rig.rig, clock, simulated=True, **more).exit_status == "success"
        assert "paused: the operator heard something; step" in seen[1]
    asked = [e.data["reason"] for e in read_journal(run.journal_path).events if e.name == "request"]
    assert asked[:1] == ["the operator heard something"]


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


def test_a_refusal_names_device_and_port() -> None:
    with espec_bench(LineClock()) as (chamber, device, port):
        device._command = lambda text: "PROTECT ON"
        with pytest.raises(Rejected, match=f"ESPEC at {port.url} was sent 'TEMP, S40.0.*PROTECT ON"):
            chamber.hold(40.0)
    with grbl_bench(LineClock()) as (axis, device, port):
        axis.home()
        device._jog_line = lambda _: b"error:15\r\n"
        with pytest.raises(Rejected, match=f"GRBL at {port.url} was sent .*error:15"):
            axis.spin(10.0, 100.0)


# ------------------------------------------------------------------------------------------------------ late answers


class Slow:
    """A chamber's line whose replies come so many real seconds after the request, each in its own time."""

    def __init__(self, port: SimulatedPort, delay_s: float) -> None:
        self._port, self._delay_s = port, delay_s

    def __call__(self, message: bytes) -> list[bytes]:
        if message:
            threading.Timer(self._delay_s, self._port.say, (message,)).start()
        return []


def port_of(device: Any) -> Transport:
    return device._exchange.transport


def test_a_reply_within_twice_the_time_out_counts_and_is_said_to_be_late() -> None:
    with espec_bench(RealClock(), config=espec_config(pause="0 s")) as (chamber, _, port):
        port.faults = Slow(port, 0.45)
        assert chamber._read("air")["air"] == "23.0"
        late = port_of(chamber).late
        assert f"ESPEC at {port.url} was sent 'TEMP?" in late
        assert "s late: raise reply_timeout" in late
        assert float(late.partition("answered ")[2].partition(" s late")[0]) == pytest.approx(0.15, abs=0.1)


def test_a_later_reply_counts_for_no_other_question() -> None:
    """The query fails, and what still comes is awaited before the next."""
    with espec_bench(RealClock(), config=espec_config(pause="0 s")) as (chamber, _, port):
        port.faults = Slow(port, 1.4)
        with pytest.raises(
            ReplyTimeout, match=r"did not answer in 0\.3 s.*ESPEC answered up to .*: raise reply_timeout"
        ):
            chamber._read("air")
        port.faults = None
        assert chamber.identify().firmware == "P3S1.10"


def test_an_acknowledgement_that_comes_too_late_is_said() -> None:
    with espec_bench(RealClock(), config=espec_config(after="0 s")) as (chamber, _, port):
        slow = Slow(port, 0.5)
        port.faults = lambda message: slow(message) if message.startswith(b"OK:TEMP") else [message]
        chamber.hold(40.0)
        time.sleep(0.5)
        chamber._read("air")
        assert "was sent 'TEMP, S40.0" in port_of(chamber).late


def test_replies_in_time_are_not_called_late_though_some_are_lost() -> None:
    with espec_bench(RealClock(), config=espec_config(pause="0 s")) as (chamber, _, port):
        port.faults = Faults(probability={"drop": 0.3}, seed=3)
        for _ in range(20):
            chamber._read("air")
        assert port_of(chamber).late == ""


def test_a_late_reply_is_not_taken_for_the_answer_to_the_next_question() -> None:
    """To "TYPE?" it comes in the second try; the second try's own reply arrives while "ROM?" is waited for, whose
    answer may be any text."""
    with espec_bench(RealClock(), config=espec_config(pause="0 s")) as (chamber, _, port):
        port.faults = Slow(port, 0.45)
        assert chamber.identify().firmware == "P3S1.10"


def test_late_replies_are_said_by_check_and_run(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    seen: list[str] = []
    with Rig(RealClock()) as rig:
        tables = rig.rig.model_dump(mode="json", exclude_unset=True)
        tables["chamber"]["options"]["reply_timeout"] = "0.2 s"
        write_toml(rig_of(tables), tmp_path / "rig.toml")
        rig.ports[0].faults = Slow(rig.ports[0], 0.3)
        assert main(["rig", "check", str(tmp_path / "rig.toml")]) == 0
        assert "s late: raise reply_timeout" in " ".join(capsys.readouterr().out.split())
        changes = {"rig.table.axis[0].max_acceleration": "300 deg/s^2"}
        run = new_folder(tmp_path / "run", short_recipe(1.0, changes=changes), rig_of(tables), simulated={})

        def look(progress: RunProgress) -> None:
            if progress.remarks:
                seen.append(progress_text(progress, False))
                runners[0].request("abort")

        runners: list[Runner] = []
        result = run_session(run, rig_of(tables), RealClock(), on_progress=look, with_runner=runners.append)
        assert seen, result.reason
    assert "ESPEC at" in seen[0]
    assert "late: raise reply_timeout" in seen[0]
    (event,) = (one for one in read_journal(run.journal_path).events if one.name == "late reply")
    assert event.data["device"] == "chamber"
