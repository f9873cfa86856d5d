"""A whole prediction of the paper's dynamic gradient plan: the compiled chain, and `predict` as a user calls it."""

import time
from pathlib import Path

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np

from gradcal_jax.api import assemble, knowledge
from gradcal_jax.api import predict as predict_spec
from gradcal_jax.files.spec import read_spec
from gradcal_jax.information import contrasts, information

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
    grid = [jnp.asarray(g.ravel()) for g in np.meshgrid(temperatures, rates, indexing="ij")]

    def mean_of_max(plan, model):
        known = information(plan.timeline("x", built.thermal_lag), model)
        rows, _ = contrasts(model, "scale_factor", *grid)
        map_ = jnp.reshape(known.deviations(rows), requirement.grid)
        return jnp.mean(jnp.max(map_, axis=0))

    compiled = eqx.filter_jit(mean_of_max)
    slope = eqx.filter_jit(eqx.filter_value_and_grad(lambda both: mean_of_max(*both)))
    only_information = eqx.filter_jit(lambda plan, model: information(plan.timeline("x", built.thermal_lag), model))
    wait = jax.block_until_ready
    line = built.plan.timeline("x", built.thermal_lag)
    return {
        "pieces": int(line.piece_count),
        "readings": int(np.sum(np.asarray(line.read))),
        "parameters": int(built.model.columns.count),
        "ppm": float(compiled(built.plan, built.model)) * 1e6,
        "times": {
            "compiled: plan → information": _seconds(lambda: wait(only_information(built.plan, built.model))),
            "compiled: plan → information → residual map → statistic": _seconds(
                lambda: wait(compiled(built.plan, built.model))
            ),
            "compiled: the same with the gradient in all of plan, sensor and rig": _seconds(
                lambda: wait(slope((built.plan, built.model)))
            ),
            "`assemble(spec)`, not compiled": _seconds(lambda: assemble(spec)),
            "`knowledge(built)`": _seconds(lambda: knowledge(built)),
            "`predict(spec)` as called, second time": _seconds(lambda: predict_spec(spec)),
        },
    }
