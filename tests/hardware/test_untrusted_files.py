"""Files that may come from anybody: rig files, lock folders, journals. Nothing is written by them, no traceback."""

import json
import re
import struct
import zlib

import pytest
from hardware_bench import parse_journal

from gradcal_jax.cli import main
from gradcal_jax.hardware.errors import HardwareError
from gradcal_jax.hardware.run_folder import sessions, steps_done
from gradcal_jax.spec.rig import TEMPLATE, parse_rig
from gradcal_jax.tables.problems import SpecError


def rig_at(port):
    return TEMPLATE.replace('"/dev/ttyUSB1"', json.dumps(port))


@pytest.mark.parametrize(
    "port",
    [
        "/dev/ttyUSB1",
        "COM3",
        "\\\\.\\COM12",
        "socket://192.168.0.7:10001",
        "rfc2217://chamber.lab:2217?ign_set_control&timeout=3",
    ],
)
def test_ports_that_a_rig_file_may_name(port):
    assert parse_rig(rig_at(port)).axis[0].port == port


@pytest.mark.parametrize(
    "port",
    [
        "spy:///dev/ttyUSB1?file=/home/me/.profile",
        "/x/spy:///dev/ttyUSB1?file=/home/me/.profile",
        "alt:///dev/ttyUSB1?class=PosixPollSerial",
        "loop://",
        "socket://192.168.0.7:10001?logging=debug",
        "notes.txt",
        "/dev/tty\nUSB",
    ],
)
def test_ports_that_it_may_not(port, tmp_path, capsys):
    with pytest.raises(SpecError, match="expected a device path"):
        parse_rig(rig_at(port))
    (tmp_path / "rig.toml").write_text(rig_at(port))
    assert main(["rig", "check", str(tmp_path / "rig.toml")]) == 2
    assert "expected a device path" in capsys.readouterr().err


def record(payload, kind=1, time_s=1.0):
    """A record whose checksum fits."""
    body = struct.pack("<BBId", kind, 0, len(payload), time_s) + payload
    return b"\xa7\x4a" + body + zlib.crc32(body).to_bytes(4, "little")


GOOD = {"event": "session", "number": 0, "wall_clock_s": 1.0, "simulated": False}


@pytest.mark.parametrize(
    "payload",
    [
        b"no json",
        b"[" * 100_000,
        b"[1, 2]",
        b'{"name": "without an event"}',
        b'{"event": 7}',
        json.dumps({"event": "step done", "number": "many"}).encode(),
        json.dumps({"event": "step done", "number": True}).encode(),
        json.dumps(GOOD | {"wall_clock_s": None}).encode(),
        json.dumps({"event": "angle", "axis": "x", "time_s": "now", "moving": False, "position_deg": 1.0}).encode(),
        json.dumps({"event": "configuration", "device": "unit1", "registers": []}).encode(),
    ],
)
def test_a_crafted_journal_is_a_sentence(payload):
    with pytest.raises(HardwareError, match="no run of this program wrote, at byte") as caught:
        parse_journal(record(json.dumps(GOOD).encode()) + record(payload))
    assert str(caught.value).endswith("Copy the original journal of the run again.")
    with pytest.raises(HardwareError, match="its time is not a number"):
        parse_journal(record(json.dumps(GOOD).encode(), time_s=float("nan")))
    contents = parse_journal(record(json.dumps(GOOD).encode()))
    assert (sessions(contents), steps_done(contents)) == (1, 0)


# ------------------------------------------------------------------- sizes, links, and texts that steer a terminal


def watched(folder, status, capsys):
    (folder / "status.json").write_text(json.dumps(status) if not isinstance(status, str) else status)
    result = main(["rig", "watch", str(folder)])
    told = capsys.readouterr()
    return result, told.out + told.err


def test_a_crafted_status_is_a_sentence(tmp_path, capsys):
    good = {
        "format": "gradcal-status/1", "simulated": True, "state": "safe", "steps": 2, "steps_done": 1, "step": "soak",
        "axes": {}, "samples": {}, "track_left_s": 1.0, "at_s": 1.0, "exit_status": "success", "reason": "",
        "verified_safe": True,
    }  # fmt: skip
    assert watched(tmp_path, good, capsys)[0] == 0
    for key, bad in (
        ("axes", [1]), ("samples", {"a": 1}), ("at_s", "now"), ("steps", None), ("chamber", 7),
    ):  # fmt: skip
        assert watched(tmp_path, good | {key: bad}, capsys)[0] == 2
    assert watched(tmp_path, "[" * 100_000, capsys)[0] == 2
    result, text = watched(tmp_path, good | {"step": "\x1b]0;owned\x07\x1b[2J"}, capsys)
    assert result == 0
    assert "\x1b" not in text


def test_a_title_with_control_characters_is_refused(tmp_path, capsys):
    titled = re.sub("(?m)^title .*", r'title = "\\u001b[2J"', TEMPLATE)
    (tmp_path / "rig.toml").write_text(titled)
    assert main(["rig", "check", str(tmp_path / "rig.toml")]) == 2
    (tmp_path / "rig.toml").write_text('"\\u001b[2J" = 1\n' + TEMPLATE)
    assert main(["rig", "check", str(tmp_path / "rig.toml")]) == 2
    told = capsys.readouterr()
    assert "control characters" in told.err
    assert "\x1b" not in told.out + told.err
