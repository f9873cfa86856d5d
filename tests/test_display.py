"""Objects show themselves: `repr` fits a terminal, a tab lists our names."""

import dataclasses
import inspect
import re
import subprocess
import sys
import typing

import numpy as np
import pytest
import xarray

import gradcal_jax as gj
from gradcal_jax import identify
from gradcal_jax.design import optimise
from gradcal_jax.design import plan_limit as limit
from gradcal_jax.estimation import estimate
from gradcal_jax.identify import instability
from gradcal_jax.tables import display

LINES, WIDTH = 15, 80
WORDS = "a sentence that goes on and on, " * 40


def fits(value):
    shown = repr(value)
    lines = shown.splitlines()
    assert 1 <= len(lines) <= LINES
    assert max(map(len, lines)) <= WIDTH
    assert not re.search(r"0x[0-9a-f]{6}", shown)
    return shown


def hint_of(function):
    """What it returns; some name the classes of their results for type checkers alone."""
    names = {"xarray": xarray, "np": np}
    for home in (estimate, limit, optimise, instability, identify):
        names |= {name: value for name, value in vars(home).items() if inspect.isclass(value)}
    return typing.get_type_hints(function, localns=names)["return"]


def parts(hint):
    return [hint, *(inner for part in typing.get_args(hint) for inner in parts(part))]


def public_classes():
    """Every class of the package that a public name is, or that a public function returns, in a list, too."""
    named = [getattr(gj, name) for name in gj.__all__ if name != "presets"]
    returned = [hint_of(function) for function in named if inspect.isfunction(function)]
    found = {p for hint in [*named, *returned] for p in parts(hint) if inspect.isclass(p)}
    ours = {kind for kind in found if kind.__module__.startswith("gradcal_jax") and not issubclass(kind, Exception)}
    return sorted(ours, key=lambda kind: kind.__name__)


def large(kind):
    """An object of a class with large contents in every field, made without its checks."""
    entries = [WORDS, np.zeros((1000, 50)), tuple(range(5000)), {f"key {i}": WORDS for i in range(300)}, [WORDS] * 9]
    if hasattr(kind, "model_fields"):
        return kind.model_construct(**{n: entries[i % 5] for i, n in enumerate(kind.model_fields)})
    if hasattr(kind, "_fields"):
        return kind._make(entries[i % 5] for i, _ in enumerate(kind._fields))
    made = object.__new__(kind)
    for i, field in enumerate(dataclasses.fields(kind)):
        object.__setattr__(made, field.name, entries[i % 5])
    return made


@pytest.mark.parametrize("kind", public_classes(), ids=lambda kind: kind.__name__)
def test_the_repr_of_every_public_class_fits_whatever_it_holds(kind):
    if hasattr(kind, "_shown"):  # with lines of its own: below, with real contents
        assert kind.__repr__ is display.summary
    else:
        assert kind.__name__ in fits(large(kind))


def test_results_of_functions_are_among_the_classes():
    assert len(public_classes()) >= 21


@pytest.mark.parametrize("preset", ["paper-dynamic-gradient", "paper-static-standard", "two-axis-table"])
def test_specs_predictions_and_recipes_show_what_they_are(preset):
    spec = gj.parse_spec(gj.presets.text(preset))
    prediction = gj.predict(spec)
    assert spec.title[:60] in fits(spec)
    shown = fits(prediction)
    assert prediction.title[:60] in shown
    for row in prediction.requirements[:5]:
        assert row.name in shown
        assert display.amount(row.judged, row.unit) in shown
    if preset == "paper-dynamic-gradient":
        recipe = gj.make_recipe(spec)
        assert fits(recipe).startswith("Recipe: Berman")
        assert str(recipe).count("\n") > 25


def test_a_repr_imports_nothing_heavy():
    script = """
import sys
import gradcal_jax as gj
spec = gj.parse_spec(gj.presets.text("tactical-mems"))
print(repr(spec)[:5], sorted({"jax", "matplotlib", "scipy", "xarray", "pandas"} & set(sys.modules)))
"""
    done = subprocess.run([sys.executable, "-c", script], capture_output=True, text=True, check=False)
    assert done.stdout.strip() == "Spec: []", done.stderr


def test_a_tab_lists_our_names():
    spec = gj.parse_spec(gj.presets.text("tactical-mems"))
    names = [name for name in dir(spec) if not name.startswith("_")]
    assert names == sorted(names)
    assert {"sensor", "rig", "plan", "requirement", "schedule"} <= set(names)
    assert not [name for name in names if name.startswith("model_") or name in ("json", "dict", "copy", "construct")]
