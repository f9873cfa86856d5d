"""The public names: each explained so that `help` is enough."""

import ast
import inspect
import json
import re
import subprocess
import sys
import typing
from collections import Counter
from collections.abc import Iterator
from pathlib import Path

import jax
import numpy as np
import pytest

import gradcal_jax as gj
from gradcal_jax.cli.app import build

CALLABLE = [name for name in gj.__all__ if name != "presets"]
UNITS = re.compile(r"\bSI\b|\bs\b|°C|\brad\b|rad/s|\bppm\b|deg/h|deg/s|\bunits?\b")
SHAPE = re.compile(r"`\(|\[[a-z]+(, [a-z ]+)*\]|\bShapes\s+broadcast\b")
# Commands for whoever sits at a terminal: text to copy, to print or to look words up in.
AT_A_TERMINAL = {"start", "demo", "new", "rig"}


@pytest.mark.parametrize("name", CALLABLE)
def test_the_help_of_a_public_name_says_what_it_does_in_which_units_and_its_errors(name):
    told = inspect.getdoc(getattr(gj, name))
    assert told is not None
    assert len(told.split()) >= 15
    assert re.search(r"\b(Errors:|Raises\b)", told), "no word of its errors"
    assert UNITS.search(told), "no word of units"


def hints_of(named: object) -> dict[str, object]:
    try:
        return typing.get_type_hints(named)
    except NameError:  # of what is imported for type checkers alone
        return inspect.get_annotations(named)


def parts(hint: object) -> Iterator[object]:
    yield hint
    for part in typing.get_args(hint):
        yield from parts(part)


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
            bare = any(part in (np.ndarray, jax.Array) for hint in hints.values() for part in parts(hint))
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
