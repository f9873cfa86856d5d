"""The demo: one sitting whose numbers are the same on the terminal, in its files, its JSON, its page, a notebook."""

import inspect
import json
import os
import re
import shlex
import subprocess
import sys
from pathlib import Path

import pytest

from gradcal_jax.calibration import read_calibration
from gradcal_jax.cli import demo as room
from gradcal_jax.cli import main
from gradcal_jax.cli.app import build
from gradcal_jax.cli.recordings import Recording
from gradcal_jax.recipe.recipe import read_recipe

DATA = Path(os.environ.get("GRADCAL_DATA", Path(__file__).parents[3] / "shared" / "data"))
PROGRAM = "import sys; from gradcal_jax.cli import main; sys.exit(main())"


def demo(folder: Path, *words: str) -> str:
    """What a demo in a process of its own printed."""
    command = [sys.executable, "-c", PROGRAM, "demo", "-o", str(folder), *words]
    done = subprocess.run(command, capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stderr
    return done.stdout


def told(text: str, pattern: str) -> float:
    """A number that was told."""
    found = re.search(pattern, text)
    assert found is not None, (pattern, text)
    return float(found[1])


def test_a_demo_overwrites_nothing_and_names_the_data_that_it_misses(tmp_path, capsys):
    (tmp_path / "full").mkdir()
    (tmp_path / "full" / "mine.txt").write_text("kept", encoding="utf-8")
    assert main(["demo", "-o", str(tmp_path / "full")]) == 2
    assert "exists" in capsys.readouterr().err
    assert main(["demo", "-o", str(tmp_path / "a" / "b")]) == 2
    assert "make it first" in capsys.readouterr().err
    assert main(["demo", "-o", str(tmp_path / "new"), "--data", str(tmp_path)]) == 2
    assert "thermal_cycle.npz" in capsys.readouterr().err
    assert main(["demo", "-o", str(tmp_path / "new"), "--data", str(tmp_path), "--imu"]) == 2
    assert "use only one of them" in capsys.readouterr().err
    assert sorted(p.name for p in tmp_path.iterdir()) == ["full"]


CALLS = (
    (room.new, ("paper-dynamic-gradient",), {"output": "paper.toml"}),
    (room.optimise, (Path("a b.toml"),), {"output": Path("recipe.toml"), "steps": 60, "json": True}),
    (room.run, (Path("recipe.toml"),), {"simulate": True, "seed": 3, "output": Path("run")}),
    (room.report, ((Path("run"),),), {"output": Path("r.html"), "before": Path("p.toml"), "json": True}),
    (
        room.instability,
        (Path("record.npz"),),
        {"source": Recording(Path("columns.toml")), "axis": ("y",), "delta": "60 s", "json": True},
    ),
)


@pytest.mark.parametrize(("command", "arguments", "options"), CALLS)
def test_the_command_line_that_is_printed_makes_the_same_call(command, arguments, options):
    line = [command.__name__, *room._words(arguments, options)]
    called, bound, _ = build().parse_args(shlex.split(shlex.join(line)), exit_on_error=False, print_error=False)
    assert called is command
    assert bound.arguments == inspect.signature(command).bind(*arguments, **options).arguments


@pytest.mark.evidence
def test_the_demos_numbers_are_one_and_the_same(tmp_path, monkeypatch):
    folder = tmp_path / "demo"
    text = demo(folder)
    numbers = json.loads((folder / "demo.json").read_text(encoding="utf-8"))
    made, found = read_recipe(folder / "recipe.toml"), read_calibration(folder / "run" / "calibration.toml")
    page = (folder / "report.html").read_text(encoding="utf-8")
    row, result = made.prediction.requirements[0], found.result[0]
    assert row.name == result.name == "full range"

    paper = numbers["prediction"]["requirements"][0]["mean_of_max"]
    shown = numbers["report"]["requirements"][0]
    limit = next(entry for entry in numbers["limits"] if entry["name"] == "full range")["certified"]
    assert (shown["before"], shown["predicted"], shown["achieved"], shown["limit"]) == (
        pytest.approx(paper, rel=1e-9),
        row.decisive,
        result.value,
        limit,
    )
    assert numbers["recipe"]["fingerprint"] == made.fingerprint == found.provenance["recipe"]
    achieved = numbers["estimate"]["units"][0]["requirements"][0]["value"]
    assert achieved == result.value

    assert told(text, r"full range, mean of max: (\S+) ppm") == float(f"{paper:.4g}")
    assert told(text, r"full range: (\S+) ppm;") == float(f"{row.decisive:.4g}")
    assert told(text, r"leaves less than (\S+) ppm") == float(f"{limit:.4g}")
    assert told(text, r"full range: (\S+) ppm achieved") == float(f"{achieved:.4g}")
    assert told(text, r"achieved, (\S+) ppm predicted") == float(f"{row.decisive:.4g}")
    for value in (paper, row.decisive, limit, achieved):
        assert f"{value:.4g}\N{NO-BREAK SPACE}ppm" in page

    from notebook_cells import run_cells

    monkeypatch.setenv("GRADCAL_DEMO", str(folder))
    names, said = run_cells("calibration_from_a_run", monkeypatch, only="demo")
    assert list(names["numbers"].values()) == [pytest.approx(paper, rel=1e-9), row.decisive, limit, achieved]
    assert re.findall(r"(\S+) ppm", said) == [f"{value:.4g}" for value in (paper, row.decisive, limit, achieved)]

    # What is worth showing: far below the paper's plan, above what no plan can beat, and the truth within reach.
    assert limit < row.decisive < 4.0 < 80.0 < paper
    assert achieved == pytest.approx(row.decisive, rel=0.1)
    chi_squared, degrees, chance = numbers["report"]["agreement"]
    assert degrees == 16
    assert chi_squared > 1.0
    assert chance > 1e-4

    # Each step is a command of this program, named as it was run.
    commands = [shlex.split(line)[1] for line in re.findall(r"^ +\$ (gradcal .+)$", text, flags=re.M)]
    assert commands == ["new", "predict", "optimise", "limit", "run", "log", "estimate", "report"]
    assert set(commands) <= set(build())
    assert len(numbers["commands"]) == len(commands)


@pytest.mark.evidence
def test_the_demo_of_an_imu_finds_what_was_hidden(tmp_path):
    folder = tmp_path / "demo"
    text = demo(folder, "--imu")
    numbers = json.loads((folder / "demo.json").read_text(encoding="utf-8"))
    found = read_calibration(folder / "run" / "calibration.toml")
    page = (folder / "report.html").read_text(encoding="utf-8")
    results = {row.name: row for row in found.result}
    for row in numbers["report"]["requirements"]:
        assert row["achieved"] == results[row["name"]].value
        assert f"{row['name']}: {row['achieved']:.4g} " in text
        assert f"{row['achieved']:.4g}\N{NO-BREAK SPACE}" in page
        assert row["achieved"] == pytest.approx(row["predicted"], rel=0.25)
    assert numbers["optimisation"]["gain"] > 1.05
    chi_squared, degrees, chance = numbers["report"]["agreement"]
    assert degrees == 120
    assert chi_squared > 60.0
    assert chance > 1e-4
    commands = [shlex.split(line)[1] for line in re.findall(r"^ +\$ (gradcal .+)$", text, flags=re.M)]
    assert commands == ["new", "predict", "optimise", "run", "log", "estimate", "report"]


@pytest.mark.evidence
@pytest.mark.skipif(
    not (DATA / "tofupilot_imu_thermal_cycle.npz").exists(),
    reason="the recorded data are not here: set GRADCAL_DATA",
)
def test_a_recorded_sensor_gets_a_plan(tmp_path):
    folder = tmp_path / "demo"
    text = demo(folder, "--data", str(DATA))
    numbers = json.loads((folder / "demo.json").read_text(encoding="utf-8"))
    (channel,) = numbers["instability"]["channels"]
    made = read_recipe(folder / "recipe.toml")
    (drift,) = made.spec.sensor.gyro.drift
    assert float(drift.correlation_time) == pytest.approx(channel["correlation_time_s"], rel=1e-3)
    assert told(text, r"axis y: (\S+) deg/h") == float(f"{channel['drift_std_deg_per_h']:.4g}")
    row = made.prediction.requirements[0]
    assert told(text, r"full range: (\S+) ppm;") == float(f"{row.decisive:.4g}")
    before = numbers["report"]["requirements"][0]["before"]
    assert row.decisive < 0.8 * before
    assert told(text, r"by hand leaves (\S+) ppm") == float(f"{before:.4g}")
