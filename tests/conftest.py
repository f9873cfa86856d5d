"""Strict JAX for every test; shape and dtype annotations are checked here and nowhere else, where there are any.

That takes as long again as what it checks, so the core's own tests check and those of the rooms around it do not
(`_SURE`); GRADCAL_UNCHECKED=1 leaves it out everywhere, for proofs of thousands of estimates.
What JAX compiles is kept for all workers, processes and later runs: half of the time of a run is compiling.
"""

import fcntl
import os
from collections.abc import Callable
from functools import partial
from importlib.metadata import version
from pathlib import Path

os.environ.setdefault("JAX_PLATFORMS", "cpu")
os.environ.setdefault("JAX_COMPILATION_CACHE_DIR", str(Path(__file__).parents[1] / ".pytest_cache" / "jax"))
os.environ.setdefault("JAX_PERSISTENT_CACHE_MIN_COMPILE_TIME_SECS", "0")
# Most programs run for less time than XLA takes to optimise them. (An unknown flag ends the process: the emitters are
# those of JAX 0.10.)
os.environ["XLA_FLAGS"] = (
    "--xla_backend_optimization_level=0 --xla_llvm_disable_expensive_passes=true "
    + ("--xla_cpu_use_fusion_emitters=false " if version("jax").startswith("0.10.") else "")
    + os.environ.get("XLA_FLAGS", "")
)
# As in the command line: OpenBLAS's threads, which share out products of some tens of columns, wait for one another.
# With several workers on few cores that took four times as long as an estimate.
os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")

import jax
import jaxtyping
import matplotlib
import pytest

matplotlib.use("Agg")
jax.config.update("jax_enable_x64", True)
jax.config.update("jax_numpy_rank_promotion", "raise")
jax.config.update("jax_numpy_dtype_promotion", "strict")
# Where each operation was called from is a third of the time of lowering a program, and nothing reads it.
jax.config.update("jax_traceback_in_locations_limit", 0)


def _typed_once(fn, *, typechecker, jaxtyped=jaxtyping.jaxtyped):
    """The import hook's decorator: a function within a function would be decorated anew in every call, though nothing
    is checked; that took a tenth of the time of an estimate."""
    local = "<locals>" in getattr(fn, "__qualname__", "")
    return fn if local and jaxtyping.config.jaxtyping_disable else jaxtyped(fn, typechecker=typechecker)


# What takes a whole spec; the core's other modules take arrays.
_OF_SPECS = {
    "build",
    "prediction",
    "error_budget",
    "residual",
    "plan_information",
    "gears",
    "sensitivity",
    "verdicts",
    "plan_sentences",
    "cycle_plan",
    "visits",
    "cycle_rounding",
    "programme_rounding",
    "pose_search",
    "optimise",
    "searching",
    "plan_objective",
    "plan_limit",
    "instability",
}

if not os.environ.get("GRADCAL_UNCHECKED"):
    package = Path(__file__).parents[1] / "gradcal_jax"
    core = ["gradcal_jax.linalg", "gradcal_jax.motion"] + [
        f"gradcal_jax.{room}.{path.stem}"
        for room in ("design", "identify", "information", "model")
        for path in (package / room).glob("*.py")
        if path.stem not in _OF_SPECS and path.stem != "__init__"
    ]
    jaxtyping.jaxtyped = lambda *, typechecker: partial(_typed_once, typechecker=typechecker)
    jaxtyping.install_import_hook(core, "beartype.beartype")


_ROOMS = ("design", "identify", "imu", "information", "model", "motion", "numbers")
"""Rooms whose tests check the core's annotations; others use the core by ways that these have checked."""
_SURE = {
    "imu": ("estimate", "recording", "logs", "read_tables", "several", "late_terms", "without_encoder", "known_plans"),
    "test_display.py": ("display",),
    "test_docs.py": ("docs",),
    "design": ("pose_search", "free_course", "optimise", "imu_limit", "exact"),
}
"""The same of files of these rooms: of whole plans, whose figures have sources of their own, and of searches."""


@pytest.fixture(autouse=True, scope="module")
def _annotations(request):
    parts = request.path.relative_to(Path(__file__).parent).parts
    room, file = parts[0], parts[-1]
    sure = room not in (*_ROOMS, file) or any(word in file for word in _SURE.get(room, ()))
    jaxtyping.config.update("jaxtyping_disable", sure)


@pytest.fixture(scope="session")
def made_once(tmp_path_factory):
    """`made_once(name, make)`: the folder that `make(folder)` has filled, once for all workers; nobody writes in it."""
    base = tmp_path_factory.getbasetemp()
    root = base.parent if "PYTEST_XDIST_WORKER" in os.environ else base

    def made(name: str, make: Callable[[Path], object]) -> Path:
        with (root / f"{name}.lock").open("w") as lock:
            fcntl.flock(lock, fcntl.LOCK_EX)
            folder, begun = root / f"shared-{name}", root / f"begun-{name}"
            if not folder.exists():
                begun.mkdir()
                make(begun)
                begun.rename(folder)
        return folder

    return made


@pytest.fixture(scope="session")
def axis_run(made_once) -> Path:
    """`recipe.toml`, its simulated `run`, and in this a calibration of known numbers: of a gyro's axis."""
    import report_samples

    return made_once("axis", report_samples.write)


@pytest.fixture(scope="session")
def imu_run(made_once) -> Path:
    """`recipe.toml` and its simulated `run` with two IMUs (`imu_bench.short`)."""
    import imu_bench

    return made_once("imu", imu_bench.write)


def pytest_addoption(parser):
    parser.addoption("--report", metavar="FILE", help="write what the long proofs (-m evidence) gave into this file")


def pytest_configure(config):
    if (path := config.getoption("--report")) is not None and not hasattr(config, "workerinput"):
        from evidence_report import EvidenceReport

        config.pluginmanager.register(EvidenceReport(path))
