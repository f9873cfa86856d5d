"""The public names: each explained so that `help` is enough, and the README's lines do the whole job with them."""

import inspect
import json
import re
import subprocess
import sys
import typing
from collections.abc import Iterator
from pathlib import Path

import jax
import numpy as np
import pytest

import gradcal_jax as gj
from gradcal_jax.cli.app import build
from gradcal_jax.files.recipe import read_recipe

README = (Path(__file__).parents[1] / "README.md").read_text(encoding="utf-8")
CALLABLE = [name for name in gj.__all__ if name != "presets"]
UNITS = re.compile(r"\bSI\b|\bs\b|°C|\brad\b|rad/s|\bppm\b|deg/h|deg/s|\bunits?\b")
SHAPE = re.compile(r"`\(|\[[a-z]+(, [a-z ]+)*\]|\bShapes\s+broadcast\b")
# Commands for whoever sits at a terminal: text to copy, to print or to look words up in.
AT_A_TERMINAL = {"start", "demo", "glossary", "new", "rig", "watch"}
# The paper's gyro with maps of degree one, for six minutes at room temperature.
SMALL = {
    "sensor.scale_factor.temperature.degree": 1,
    "sensor.scale_factor.rate.degree": 1,
    "rig.table.max_acceleration": "300 deg/s^2",
    "requirement": [
        {
            "name": "all rates",
            "quantity": "scale_factor",
            "temperature": ["20 degC", "26 degC"],
            "rate": ["-200 deg/s", "200 deg/s"],
            "grid": [11, 21],
        }
    ],
    "plan.temperature": ["20 degC", "26 degC"],
    "plan.soak": {"duration": "60 s", "used": False},
    "plan.cycle.moves": [
        {"rest": "20 s", "read_every": "1 s"},
        {"turn": "1080 deg", "peak_rate": "150 deg/s", "shape": "cosine ramps"},
        {"rest": "20 s", "read_every": "1 s"},
        {"turn": "-1080 deg", "peak_rate": "60 deg/s", "shape": "cosine ramps"},
    ],
    "plan.cycle.other_axes": None,
    "design": {
        "minimise": "all rates",
        "free": ["duration", "peak_rate", "ramp"],
        "moves": 2,
        "cycles": "alike",
        "starts": 1,
    },
}


@pytest.mark.parametrize("name", CALLABLE)
def test_the_help_of_a_public_name_says_what_it_does_in_which_units_and_its_errors(name):
    told = inspect.getdoc(getattr(gj, name))
    assert told is not None
    assert len(told.split()) >= 15
    assert re.search(r"\b(Errors:|Raises\b)", told), "no word of its errors"
    assert UNITS.search(told), "no word of units"


@pytest.mark.parametrize("name", [name for name in CALLABLE if inspect.isfunction(getattr(gj, name))])
def test_the_help_of_a_function_tells_its_parameters(name):
    """By their names; a first one or two that the sentence is about, and paths, explain themselves."""
    told = inspect.getdoc(getattr(gj, name)) or ""
    clear = {"spec", "specs", "log", "path", "recipe", "calibration", "model", "name", "text", "plan", "unit", "axis"}
    clear |= {"folder", "output", "job", "runner", "progress", "changes", "source", "runs", "seed", "known", "info"}
    clear |= {"quantity", "temperature", "rate", "limits", "columns", "target", "count"}
    given = {name for name in inspect.signature(getattr(gj, name)).parameters if name not in clear}
    missing = {name for name in given if not re.search(rf"`{name}`", told)}
    assert len(missing) <= 1, missing


def hints_of(named: object) -> dict[str, object]:
    try:
        return typing.get_type_hints(named)
    except NameError:  # of what is imported for type checkers alone
        return inspect.get_annotations(named)


def parts(hint: object) -> Iterator[object]:
    yield hint
    for part in typing.get_args(hint):
        yield from parts(part)


def is_array(hint: object, *, with_shape: bool) -> bool:
    """Whether an annotation is an array's; `with_shape`: also where it tells the shape itself."""
    if hasattr(hint, "dim_str"):
        return with_shape and hint.dim_str != ""
    return hint in (np.ndarray, jax.Array) or typing.get_origin(hint) is np.ndarray


def test_the_help_of_a_function_of_arrays_tells_their_shapes():
    functions = {name: getattr(gj, name) for name in CALLABLE if inspect.isfunction(getattr(gj, name))}
    of_arrays = {
        name
        for name, function in functions.items()
        if any(is_array(part, with_shape=True) for hint in hints_of(function).values() for part in parts(hint))
    }
    assert len(of_arrays) >= 3
    assert [name for name in sorted(of_arrays) if not SHAPE.search(inspect.getdoc(functions[name]) or "")] == []


def test_whatever_public_names_give_tells_the_shapes_of_its_arrays():
    """Results, what they are made of, and so on, field by field: in the annotation, or in words beside it."""
    waiting: list[object] = [getattr(gj, name) for name in CALLABLE]
    seen: set[object] = set()
    silent: list[str] = []
    while waiting:
        named = waiting.pop()
        if named in seen:
            continue
        seen.add(named)
        hints = hints_of(named)
        if inspect.isclass(named):
            bare = any(is_array(part, with_shape=False) for hint in hints.values() for part in parts(hint))
            if bare and not SHAPE.search(inspect.getsource(named)):
                silent.append(named.__name__)
        given = hints.values() if inspect.isclass(named) else [hints.get("return")]
        found = [part for hint in given for part in parts(hint) if inspect.isclass(part)]
        waiting += [part for part in found if part.__module__.startswith("gradcal_jax")]
    assert len(seen) > 100
    assert silent == []


def test_functions_have_the_names_of_commands():
    commands = {name for name in build() if not name.startswith("-")}
    assert commands - AT_A_TERMINAL <= set(gj.__all__)
    for name in commands - AT_A_TERMINAL:
        assert inspect.isfunction(getattr(gj, name)), name
        assert getattr(gj, name).__name__ == name


def test_a_name_of_a_command_is_its_function_whatever_was_imported_before():
    """No room of the package has the name of a command, so that no import of a module takes its place."""
    script = """
import importlib, json, pkgutil
import gradcal_jax as gj
for found in pkgutil.walk_packages(gj.__path__, "gradcal_jax."):
    importlib.import_module(found.name)
print(json.dumps([name for name in gj.__all__ if name != "presets" and not callable(getattr(gj, name))]))
"""
    done = subprocess.run([sys.executable, "-c", script], capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stderr
    assert json.loads(done.stdout.splitlines()[-1]) == []


def test_the_lines_of_the_readme_do_the_whole_job(tmp_path, monkeypatch, capsys):
    (lines,) = re.findall(r"```python\n(.+?)```", README, flags=re.S)
    assert 8 <= sum(1 for line in lines.splitlines() if "gj." in line) <= 10
    gj.write_toml(gj.changed(gj.parse_spec(gj.presets.text("paper-dynamic-gradient")), SMALL), tmp_path / "design.toml")
    monkeypatch.chdir(tmp_path)
    exec(compile(lines, "README.md", "exec"), {})
    before, now, limit = (float(number) for number in re.findall(r"([\d.]+) ppm", capsys.readouterr().out))
    made, found = read_recipe("run/recipe.toml"), gj.read_calibration("run/calibration.toml")
    page = Path("report.html").read_text(encoding="utf-8")
    assert limit < now < 0.8 * before
    assert made.prediction.requirements[0].decisive == pytest.approx(now, rel=1e-9)
    assert made.optimisation is not None
    assert f"{now:.4g} ppm" in gj.show(made)
    assert found.simulated
    assert found.provenance["recipe"] == made.fingerprint
    assert found.result[0].value == pytest.approx(now, rel=0.2)
    for value in (before, now, found.result[0].value):
        assert f"{value:.4g}\N{NO-BREAK SPACE}ppm" in page
