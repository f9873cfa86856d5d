"""The command line from outside: statuses, sentences, plain text, and what a start-up may not import."""

import io
import os
import subprocess
import sys
import time

import pytest

from gradcal_jax.cli import main
from gradcal_jax.cli.progress import MovingLine
from gradcal_jax.spec import presets
from gradcal_jax.units import time_text

GRADCAL = "import sys; from gradcal_jax.cli import main; sys.exit(main())"


def python(*arguments, **keywords):
    return subprocess.run([sys.executable, *arguments], capture_output=True, text=True, check=False, **keywords)


@pytest.fixture
def spec(tmp_path):
    path = tmp_path / "my.toml"
    path.write_text(presets.text("paper-dynamic-gradient"), encoding="utf-8")
    return path


def test_the_package_runs_as_a_module_too():
    done = python("-m", "gradcal_jax", "start", "--list")
    assert (done.returncode, done.stdout) == (0, python("-c", GRADCAL, "start", "--list").stdout)
    wrong = python("-m", "gradcal_jax", "predict", "no.toml")
    assert wrong.returncode == 2
    assert wrong.stderr.startswith("gradcal: no.toml")


HEAVY = ("jax", "jaxlib", "equinox", "xarray", "matplotlib", "scipy", "h5netcdf", "jinja2")


@pytest.mark.parametrize(
    ("words", "absent"),
    [
        (["start", "--list"], HEAVY),
        (["check", "--files-only", "SPEC"], HEAVY),
        (["--help"], (*HEAVY, "numpy", "pydantic")),
    ],
)
def test_nothing_heavy_is_imported_before_it_is_needed(words, absent, spec):
    """In a fresh process: import contracts do not see what an `__init__` pulls in."""
    words = [word.replace("SPEC", str(spec)) for word in words]
    code = f"import sys; from gradcal_jax.cli import main; print(main({words})); sys.stdout.flush()"
    done = python("-c", f"{code}; print(sorted({{*{absent}}} & {{*sys.modules}}))")
    assert done.stdout.splitlines()[-2:] == ["0", "[]"], done.stderr


def test_start_writes_a_spec_that_checks(tmp_path):
    goal = tmp_path / "my.toml"
    assert main(["start", "rig-hand", "-o", str(goal)]) == 0
    assert goal.read_text(encoding="utf-8") == presets.text("rig-hand")
    assert main(["check", "--files-only", str(goal)]) == 0
    assert main(["start", "tactical-mems", "-o", str(goal), "--force"]) == 0
    assert goal.read_text(encoding="utf-8") == presets.text("tactical-mems")


def test_check_says_what_the_plan_does(spec, capsys):
    assert main(["check", "--files-only", str(spec)]) == 0
    out = capsys.readouterr().out
    assert "2 h 40 min in all: soak 1 h, temperature motion 1 h 40 min" in out
    assert "motion 1: begins with ramp 1, 17 times, one every 360 s" in out
    assert "then rest for 2 min (read every 1 s)" in out
    spec.write_text(presets.text("paper-dynamic-standard"), encoding="utf-8")
    assert main(["check", "--files-only", str(spec)]) == 0
    assert "9 h in all: soak 6 h, integration 3 h" in capsys.readouterr().out


def test_check_says_what_cannot_be_observed(spec, capsys):
    assert main(["check", str(spec)]) == 0
    assert "cannot be observed" not in capsys.readouterr().out
    # One rate, one way: four powers of the rate cannot be told apart.
    head, moves = spec.read_text().split("moves = [")
    rest, _, turn, *_ = moves.strip().splitlines()
    spec.write_text(f"{head}moves = [\n{rest}\n{turn}\n]\n", encoding="utf-8")
    assert main(["check", str(spec)]) == 0
    assert "note: the plan cannot observe " in capsys.readouterr().out


def test_a_terminal_of_few_letters_gets_no_traceback(spec):
    spec.write_text(spec.read_text().replace("Berman,", "Bérman √,"), encoding="utf-8")
    done = python("-c", GRADCAL, "check", "--files-only", str(spec), env={**os.environ, "PYTHONIOENCODING": "ascii"})
    assert (done.returncode, done.stderr) == (0, "")
    assert "B?rman" in done.stdout


def test_an_interrupt_ends_with_130(monkeypatch, capsys):
    def interrupted(path):
        raise KeyboardInterrupt

    monkeypatch.setattr("gradcal_jax.recipe.recipe.spec_or_recipe", interrupted)
    assert main(["check", "my.toml"]) == 130
    assert capsys.readouterr().err == "gradcal: interrupted\n"


@pytest.mark.parametrize(
    ("seconds", "words"),
    [(45.45, "45.45 s"), (120.0, "2 min"), (9600.0, "2 h 40 min"), (3601.0, "1 h 1 s"), (0.0, "0 s"), (36e4, "100 h")],
)
def test_times_are_said_as_people_say_them(seconds, words):
    assert time_text(seconds) == words


def test_away_from_a_terminal_a_line_is_printed_when_its_number_changes_or_after_half_a_minute(monkeypatch):
    now = [0.0]
    monkeypatch.setattr(time, "monotonic", lambda: now[0])
    stream = io.StringIO()
    with MovingLine(stream) as line:
        for second in range(100):
            now[0] = float(second)
            line.show(f"{second} s", number=second // 50)
    assert stream.getvalue().split("\n")[:-1] == ["0 s", "30 s", "50 s", "80 s"]
