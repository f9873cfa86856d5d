"""The specs of `experiments/paper/` predict the figures that the design holds to be right, and the table says so."""

import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest

import gradcal_jax as gj

PAPER = Path(__file__).parents[2] / "experiments" / "paper"
NAMES = ("static_standard", "static_gradient", "dynamic_standard", "dynamic_gradient")


def left(name, **changes):
    """The requirement rows of one of the specs, with keys changed."""
    spec = gj.read_spec(PAPER / f"{name}.toml")
    changes = {key.replace("__", "."): value for key, value in changes.items()}
    return gj.predict(gj.changed(spec, changes) if changes else spec).requirements


@pytest.mark.parametrize("name", NAMES)
def test_the_specs_are_the_presets(name):
    preset = "paper-" + name.replace("_", "-")
    assert (PAPER / f"{name}.toml").read_text(encoding="utf-8") == gj.presets.text(preset)


@pytest.mark.parametrize(
    ("name", "changes", "mean", "largest"),
    [
        ("static_standard", {}, 0.279, 0.372),
        ("static_gradient", {}, 0.402, 0.775),
    ],
)
def test_what_is_left_of_the_bias(name, changes, mean, largest):
    (row,) = left(name, **changes)
    np.testing.assert_allclose([row.mean, row.max], [mean, largest], rtol=0.01)


@pytest.mark.parametrize(("estimator", "expected"), [("best linear", (103.3, 81.5)), ("least squares", (127.4, 100.5))])
def test_what_the_standard_method_leaves_of_the_scale_factor(estimator, expected):
    rows = left("dynamic_standard", plan__estimator=estimator)
    np.testing.assert_allclose([row.mean_of_max for row in rows], expected, rtol=0.01)


def test_what_the_gradient_method_leaves_of_the_scale_factor():
    full, reduced = left("dynamic_gradient")
    assert 84.0 <= full.mean_of_max <= 88.0
    assert 42.0 <= reduced.mean_of_max <= 44.0
    # The paper's 77 and 40 are not met by this reading of its text; the verdict says so.
    assert (full.target, full.verdict) == (pytest.approx(80.0), "missed")


def test_the_static_gain_is_time_and_not_accuracy():
    standard, ramp = (gj.predict(gj.read_spec(PAPER / f"static_{name}.toml")) for name in ("standard", "gradient"))
    assert ramp.duration_s < 0.3 * standard.duration_s
    assert ramp.requirements[0].mean > 1.3 * standard.requirements[0].mean


@pytest.mark.evidence
def test_the_committed_table_and_figures_are_what_the_script_makes(tmp_path):
    command = [sys.executable, str(PAPER / "reproduce.py"), "-o", str(tmp_path)]
    done = subprocess.run(command, capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stderr
    assert (tmp_path / "table.md").read_text(encoding="utf-8") == (PAPER / "table.md").read_text(encoding="utf-8")
    for number in range(1, 7):
        assert (tmp_path / f"figure{number}.png").read_bytes().startswith(b"\x89PNG")
        assert (PAPER / f"figure{number}.png").read_bytes().startswith(b"\x89PNG")
