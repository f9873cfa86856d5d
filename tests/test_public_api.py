"""The public names: each explained so that `help` is enough."""

import ast
import inspect
import json
import re
import subprocess
import sys
from collections import Counter
from pathlib import Path

import pytest

import gradcal_jax as gj
from gradcal_jax.cli.app import build

CALLABLE = [name for name in gj.__all__ if name != "presets"]
UNITS = re.compile(r"\bSI\b|\bs\b|°C|\brad\b|rad/s|\bppm\b|deg/h|deg/s|\bunits?\b")
# Commands for whoever sits at a terminal: text to copy, to print or to look words up in.
AT_A_TERMINAL = {"start", "demo", "new", "rig"}


@pytest.mark.parametrize("name", CALLABLE)
def test_the_help_of_a_public_name_says_what_it_does_in_which_units_and_its_errors(name):
    told = inspect.getdoc(getattr(gj, name))
    assert told is not None
    assert len(told.split()) >= 15
    assert re.search(r"\b(Errors:|Raises\b)", told), "no word of its errors"
    assert UNITS.search(told), "no word of units"


def test_functions_have_the_names_of_commands():
    commands = {name for name in build() if not name.startswith("-")}
    assert commands - AT_A_TERMINAL <= set(gj.__all__)
    for name in commands - AT_A_TERMINAL:
        assert inspect.isfunction(getattr(gj, name)), name
        assert getattr(gj, name).__name__ == name


@pytest.mark.long
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


def test_no_two_public_classes_have_one_name():
    trees = [ast.parse(path.read_text(encoding="utf-8")) for path in Path(gj.__file__).parent.rglob("*.py")]
    names = Counter(node.name for tree in trees for node in ast.walk(tree) if isinstance(node, ast.ClassDef))
    assert len(names) > 300
    assert [name for name, count in names.items() if count > 1 and not name.startswith("_")] == []
