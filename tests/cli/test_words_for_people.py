"""Help in the order of work, tables that fit, cures beside what cannot be observed, types behind the lazy names."""

import subprocess
import sys
from pathlib import Path

import pytest
from cyclopts import App

import gradcal_jax as gj
from gradcal_jax.cli import main
from gradcal_jax.cli.app import GROUPS, build
from gradcal_jax.tables.display import columns


def test_the_help_lists_every_command_once_in_the_order_of_work(capsys):
    assert main([]) == 0
    alone = capsys.readouterr().out
    assert main(["--help"]) == 0
    assert capsys.readouterr().out == alone
    listed = [c.name[0] if isinstance(c, App) else c.__name__ for _, commands in GROUPS for c in commands]
    assert sorted(listed) == sorted(name for name in build() if not name.startswith("-"))
    places = [alone.index(f"\n  {name}:") for name in listed]
    assert places == sorted(places)
    assert alone.index("Begin:") < alone.index("Execute a plan:") < alone.index("Calibrate:")


@pytest.mark.parametrize("preset", [n for n in gj.presets.names() if gj.parse_spec(gj.presets.text(n)).is_one_axis])
def test_tables_of_a_prediction_fit_eighty_columns(preset, tmp_path, capsys):
    path = tmp_path / "my.toml"
    path.write_text(gj.presets.text(preset), encoding="utf-8")
    assert main(["predict", str(path)]) in (0, 1)
    told = capsys.readouterr().out
    table = told.split("\n\n")[1].splitlines()
    assert table[0].startswith("requirement")
    assert max(map(len, table[: 1 + sum(line.endswith(("met", "missed")) for line in table)])) <= 80


def test_the_last_column_goes_on_below():
    rows = [("plan", "limited by"), ("a" * 30, "standstill offset 75%, scale-factor instability 15%, and more words")]
    lines = columns(rows, indent="").splitlines()
    assert max(map(len, lines)) <= 80
    assert lines[2].startswith(" " * 32)
    assert " ".join(line[32:].strip() for line in lines[1:]) == rows[1][1]
    assert columns([("x", "y" * 100)], indent="") == "x  " + "y" * 100


@pytest.mark.parametrize(
    ("change", "cure"),
    [
        ({}, "two distinct rates for four coefficients in rate: add a turn at another rate"),
        ({"plan.cycle.moves": [{"rest": "60 s", "read_every": "1 s"}]}, "the axis never turns: add turns"),
    ],
)
def test_what_cannot_be_observed_comes_with_its_cure(change, cure):
    moves = [
        {"rest": "10 s", "read_every": "1 s"},
        {"turns": 1, "peak_rate": "300 deg/s", "shape": "linear ramps"},
        {"rest": "10 s", "read_every": "1 s"},
        {"turns": -1, "peak_rate": "100 deg/s", "shape": "linear ramps"},
    ]
    spec = gj.parse_spec(gj.presets.text("paper-dynamic-gradient"))
    spec = gj.changed(spec, {"plan.cycle.moves": moves, "sensor.scale_factor.prior": None} | change)
    said = gj.check(spec)
    assert said
    blind = [sentence for sentence in said if "cannot observe" in sentence]
    assert blind
    assert all(cure in sentence for sentence in blind)


def test_temperatures_that_are_too_few_are_counted():
    spec = gj.parse_spec(gj.presets.text("paper-static-standard"))
    spec = gj.changed(spec, {"plan.temperatures": ["-30 degC", "70 degC"], "plan.soak": "2 h"})
    assert any("two temperatures for four coefficients in temperature: add two" in s for s in gj.check(spec))


def test_the_package_says_that_it_is_typed():
    assert (Path(gj.__file__).parent / "py.typed").exists()


def test_a_file_name_in_the_place_of_a_spec_is_told_how_it_is_read():
    """In a process of its own, without the checks of types that the tests switch on."""
    script = """
import gradcal_jax as gj
for call in ("predict", "check", "limit", "optimise", "sensitivity", "recipe", "timeline", "differentiable"):
    for wrong, words in (("design.toml", "gj.read_spec('design.toml')"), (5, "not int")):
        try:
            getattr(gj, call)(wrong)
        except TypeError as error:
            assert words in str(error), (call, str(error))
        else:
            raise AssertionError(call)
"""
    done = subprocess.run([sys.executable, "-c", script], capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stderr
