"""What holds of every command: wrong files are sentences, numbers are to be had as JSON, colour is for terminals."""

import json
import re
import subprocess
import sys

import pytest

from gradcal_jax.cli import main
from gradcal_jax.cli.app import build
from gradcal_jax.spec import presets

# FILE: what is wrong in turn; OUT: a name that is free.
ARGUMENTS = {
    "apply": "FILE FILE -o OUT",
    "check": "FILE",
    "estimate": "FILE --spec FILE",
    "export": "FILE --format csv",
    "limit": "FILE",
    "log": "FILE",
    "noise": "FILE",
    "optimise": "FILE -o OUT",
    "predict": "FILE",
    "report": "FILE -o OUT",
    "rig check": "FILE",
    "rig watch": "FILE",
    "run": "FILE --simulate -o OUT",
    "start": "--preset FILE -o OUT",
    "sweep": "FILE -o OUT",
    "validate": "FILE FILE",
}
# These print words alone.
WITHOUT_NUMBERS = {"demo", "rig", "start"}


def test_every_command_is_tried():
    commands = [n for n in build() if not n.startswith("-")]
    assert {name.split()[0] for name in ARGUMENTS} == {*commands} - {"demo"}
    # Fifteen commands, and what asks the devices of a rig.
    assert len(commands) == 16


@pytest.mark.parametrize("command", ARGUMENTS)
def test_a_command_has_at_most_twelve_options(command):
    parts = command.split()
    app = build()[parts[0]] if len(parts) == 1 else build()[parts[0]][parts[1]]
    options = [a for a in app.assemble_argument_collection() if a.parameter.name and a.name.startswith("--")]
    assert len({a.field_info.name for a in options}) <= 12


@pytest.mark.parametrize("command", ARGUMENTS)
@pytest.mark.parametrize("wrong", ["missing", "folder", "bytes", "text"])
def test_a_wrong_file_is_a_sentence_and_status_2(command, wrong, tmp_path, capsys):
    path = tmp_path / "wrong.toml"
    if wrong == "folder":
        path.mkdir()
    elif wrong == "bytes":
        path.write_bytes(bytes(range(256)) * 4)
    elif wrong == "text":
        path.write_text('format = "gradcal-something/1"\n', encoding="utf-8")
    free = tmp_path / "free"
    words = [{"FILE": str(path), "OUT": str(free)}.get(word, word) for word in ARGUMENTS[command].split()]
    assert main([*command.split(), *words]) == 2
    told = capsys.readouterr()
    assert told.err.startswith("gradcal: ")
    assert "Traceback" not in told.err
    assert len(told.err) < 2000
    assert not free.exists()


def test_wrong_files_are_refused_before_jax_is_loaded(tmp_path):
    """Loading it takes seconds; who misspells a name waits for none."""
    words = {
        command: [*command.split(), *({"FILE": "missing.toml", "OUT": "free"}.get(w, w) for w in given.split())]
        for command, given in ARGUMENTS.items()
    }
    script = f"""
import sys
from gradcal_jax.cli import main
for command, words in {words!r}.items():
    assert main(words) == 2, command
    assert "jax" not in sys.modules, command
"""
    done = subprocess.run([sys.executable, "-c", script], cwd=tmp_path, capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stderr


@pytest.mark.parametrize("command", [name for name in build() if not name.startswith("-")])
def test_whatever_prints_numbers_prints_them_as_json_too(command, capsys):
    assert main([command, "--help"]) == 0
    assert ("--json" in capsys.readouterr().out) == (command not in WITHOUT_NUMBERS)


@pytest.mark.parametrize("command", ARGUMENTS)
def test_the_help_says_what_every_argument_and_option_is(command, capsys):
    assert main([*command.split(), "--help"]) == 0
    told = capsys.readouterr().out
    assert not re.search(r"\[default: (False|None|\(\)|\"\")\]", told)  # says nothing
    lines = re.findall(r"^  (?:-|[A-Z]{2}).*", told, re.MULTILINE)
    assert lines
    assert [line for line in lines if not re.search(r": [^\[\s]", line)] == []


@pytest.fixture
def spec(tmp_path):
    path = tmp_path / "my.toml"
    path.write_text(presets.text("paper-dynamic-gradient"), encoding="utf-8")
    return str(path)


def test_check_gives_its_numbers_as_json(spec, capsys):
    assert main(["check", "--files-only", "--json", spec]) == 0
    told = json.loads(capsys.readouterr().out)
    assert (told["duration_s"], told["soak_s"], told["motion_s"]) == (9600.0, 3600.0, 6000.0)
    assert told["requirements"] == ["full range", "reduced range"]
    assert told["unobservable"] is None


@pytest.mark.parametrize(
    ("terminal", "environment", "coloured"),
    [(True, {}, True), (True, {"NO_COLOR": "1"}, False), (True, {"TERM": "dumb"}, False), (False, {}, False)],
)
def test_a_terminal_gets_colour_unless_it_is_unwanted(terminal, environment, coloured, spec, capsys, monkeypatch):
    for name, value in ({"NO_COLOR": "", "TERM": "xterm"} | environment).items():
        monkeypatch.setenv(name, value)
    for stream in (sys.stdout, sys.stderr):
        monkeypatch.setattr(stream, "isatty", lambda: terminal)
    for words in (["check", "--files-only", spec], ["check", "none.toml"], *[["--help"]] * (not terminal)):
        main(words)
        assert ("\x1b[" in "".join(capsys.readouterr())) == coloured
