"""What the rooms at the bench import, seen in a process of their own: contracts on imports do not see an `__init__`."""

import json
import subprocess
import sys

import pytest

HEAVY = {"jax", "jaxlib", "equinox", "xarray", "pandas", "matplotlib", "scipy"}

EVERY_MODULE = """
import importlib, json, pkgutil, sys
names = [{room!r}]
room = importlib.import_module({room!r})
for found in pkgutil.walk_packages(getattr(room, "__path__", []), {room!r} + "."):
    importlib.import_module(found.name)
    names.append(found.name)
print(json.dumps([names, sorted({{name.split(".")[0] for name in sys.modules}})]))
"""


def in_a_fresh_process(script):
    done = subprocess.run([sys.executable, "-c", script], capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stderr
    return json.loads(done.stdout.splitlines()[-1])


@pytest.mark.parametrize(
    ("room", "least"),
    [
        ("gradcal_jax.hardware", 20),
        ("gradcal_jax.spec", 15),
        ("gradcal_jax.records", 15),
        ("gradcal_jax.calibration", 5),
        ("gradcal_jax.recipe", 3),
        ("gradcal_jax.cli", 7),
        ("gradcal_jax.units", 1),
    ],
)
def test_every_module_of_a_room_at_the_bench_loads_without_jax(room, least):
    names, loaded = in_a_fresh_process(EVERY_MODULE.format(room=room))
    assert len(names) >= least
    assert not HEAVY & set(loaded)


def test_the_formulas_load_without_any_array_library():
    _, loaded = in_a_fresh_process(EVERY_MODULE.format(room="gradcal_jax.formulas"))
    assert not (HEAVY | {"numpy"}) & set(loaded)


def test_what_is_logged_is_printed_by_no_handler_of_ours():
    script = """
import gradcal_jax, logging
logging.getLogger("gradcal_jax.records").warning("a fault")
print([type(handler).__name__ for handler in logging.getLogger("gradcal_jax").handlers], logging.getLogger().handlers)
"""
    done = subprocess.run([sys.executable, "-c", script], capture_output=True, text=True, check=False)
    assert (done.stdout, done.stderr) == ("['NullHandler'] []\n", "")


@pytest.mark.long
def test_the_public_names_load_on_first_use_and_all_exist():
    script = """
import json, sys
import gradcal_jax
before = "jax" in sys.modules
missing = [name for name in gradcal_jax.__all__ if not callable(getattr(gradcal_jax, name, None)) and name != "presets"]
print(json.dumps([before, missing, "jax" in sys.modules]))
"""
    assert in_a_fresh_process(script) == [False, [], True]


def test_a_spec_is_answered_without_scipys_larger_rooms():
    # They cost as much as all of JAX: what an estimate wants of them, a prediction does not.
    script = """
import json, sys
import gradcal_jax
names = ("check", "predict", "optimise", "limit", "sensitivity")
assert all(callable(getattr(gradcal_jax, name)) for name in names)
print(json.dumps([name for name in ("optimize", "signal", "stats") if f"scipy.{name}" in sys.modules]))
"""
    assert in_a_fresh_process(script) == []
