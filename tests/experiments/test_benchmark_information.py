"""The benchmark at a size of nothing: every installed peer finds the information and the gradient that we find."""

import importlib.util
import json
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest

BENCHMARKS = Path(__file__).resolve().parents[2] / "experiments" / "benchmarks"
PACKAGES = {
    "ours": None,
    "celerite2_terms": "celerite2",
    "tinygp_quasisep": "tinygp",
    "dynamax_augmented": "dynamax",
    "filterpy_augmented": "filterpy",
}


def ask(method: str, unit: str) -> dict:
    """The information and the slopes that a method finds, in a process of its own as in the benchmark."""
    requests = [
        {"do": "open", "method": method, "count": 40, "parameters": 3, "unit": unit},
        {"do": "check"},
    ]
    done = subprocess.run(
        [sys.executable, str(BENCHMARKS / "peers" / "worker.py"), "2"],
        input="".join(json.dumps(r) + "\n" for r in requests),
        capture_output=True,
        text=True,
        timeout=300,
    )
    assert done.returncode == 0, done.stderr[-2000:]
    return json.loads(done.stdout.splitlines()[1])


@pytest.fixture(scope="module")
def problem():
    """The benchmark's own problem module, which is no part of the package."""
    source = importlib.util.spec_from_file_location("benchmark_problem", BENCHMARKS / "peers" / "problem.py")
    assert source is not None
    assert source.loader is not None
    module = importlib.util.module_from_spec(source)
    source.loader.exec_module(module)
    return module


@pytest.mark.parametrize("method", PACKAGES)
def test_agrees_with_the_recursion_in_extended_precision(method, problem):
    package = PACKAGES[method]
    if package and importlib.util.find_spec(package) is None:
        pytest.skip(f"{package} is not installed: pip install 'gradcal_jax[peers]'")
    # dynamax adds an absolute 1e-9 to the innovation's variance: a thousandth of the reading noise in rad², so in deg.
    unit, allowed = ("deg", 1e-5) if method == "dynamax_augmented" else ("rad", 1e-11)
    found = ask(method, unit)
    case = problem.make_problem(40, 3, unit)
    exact = problem.exact_information(case)
    assert problem.information_error(np.array(found["information"]), exact) < allowed
    if method != "filterpy_augmented":
        slopes = problem.exact_slopes(case)
        assert np.max(np.abs(np.array(found["slopes"]) - slopes)) < max(allowed, 1e-9) * np.max(np.abs(slopes))


def test_the_two_references_agree(problem):
    case = problem.make_problem(300, 5)
    assert problem.information_error(problem.dense_information(case), problem.exact_information(case)) < 1e-12
