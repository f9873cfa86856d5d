"""A whole prediction of the paper's dynamic gradient plan: its steps, and `predict` as a user calls it."""

import time
from pathlib import Path

import jax
import numpy as np

from gradcal_jax.information import contrasts, information, posterior
from gradcal_jax.information.prediction import predict as predict_spec
from gradcal_jax.information.sensitivity import sensitivity
from gradcal_jax.model.build import assemble
from gradcal_jax.spec.spec import read_spec

_SPEC = Path(__file__).resolve().parents[2] / "paper" / "dynamic_gradient.toml"
_REPEATS = 15


def _seconds(task) -> list[float]:
    """The first call, which compiles, is left out."""
    task()
    found = []
    for _ in range(_REPEATS):
        begin = time.perf_counter()
        task()
        found.append(time.perf_counter() - begin)
    return found


def predict(asked: dict) -> dict:
    jax.config.update("jax_enable_x64", True)
    spec = read_spec(_SPEC)
    built = assemble(spec)
    requirement = spec.requirement[0]
    temperatures, rates = (
        np.linspace(*(float(x) for x in ends), size)
        for ends, size in zip((requirement.temperature, requirement.rate), requirement.grid, strict=True)
    )
    grid = [g.ravel() for g in np.meshgrid(temperatures, rates, indexing="ij")]

    def mean_of_max():
        known = information(built.trajectory(), built.model)
        rows, _, _ = contrasts(built.model, "scale_factor", *grid)
        return float(np.mean(np.max(known.deviations(rows).reshape(requirement.grid), axis=0)))

    line = built.trajectory()
    return {
        "pieces": int(line.piece_count),
        "readings": int(np.sum(line.read)),
        "parameters": int(built.model.size),
        "ppm": mean_of_max() * 1e6,
        "times": {
            "plan → information": _seconds(lambda: information(built.trajectory(), built.model)),
            "plan → information → residual map → statistic": _seconds(mean_of_max),
            "compiled: derivatives in all figures of sensor, rig and plan": _seconds(lambda: sensitivity(spec)),
            "`assemble(spec)`": _seconds(lambda: assemble(spec)),
            "`posterior(information(…))`": _seconds(lambda: posterior(information(built.trajectory(), built.model))),
            "`predict(spec)` as called": _seconds(lambda: predict_spec(spec)),
        },
    }
