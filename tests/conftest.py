"""Strict JAX for every test; shape and dtype annotations are checked here and nowhere else."""

import os

os.environ.setdefault("JAX_PLATFORMS", "cpu")

import jax
import jaxtyping
import matplotlib

matplotlib.use("Agg")
jax.config.update("jax_enable_x64", True)
jax.config.update("jax_numpy_rank_promotion", "raise")
jax.config.update("jax_numpy_dtype_promotion", "strict")

jaxtyping.install_import_hook("gradcal_jax", "beartype.beartype")


def pytest_addoption(parser):
    parser.addoption("--report", metavar="FILE", help="write what the long proofs (-m evidence) gave into this file")


def pytest_configure(config):
    if (path := config.getoption("--report")) is not None and not hasattr(config, "workerinput"):
        from evidence_report import EvidenceReport

        config.pluginmanager.register(EvidenceReport(path))
