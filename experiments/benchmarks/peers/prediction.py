"""A whole prediction of the paper's dynamic gradient plan: its steps, and `predict` as a user calls it."""

import time
from pathlib import Path

import jax
import numpy as np

from gradcal_jax.information.plan_information import imu_information, imu_posterior
from gradcal_jax.information.prediction import predict as predict_spec
from gradcal_jax.information.residual import residual_of
from gradcal_jax.information.sensitivity import sensitivity
from gradcal_jax.model.build import build_imu
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
    built = build_imu(spec)
    quantity = residual_of(built, spec.requirement[0])

    def information():
        return imu_information(built.motion, built.model, built.body_nodes())[0]

    def mean_of_max():
        return quantity.statistic("mean of max", {})(information().root())

    line = built.motion.line
    return {
        "pieces": int(line.piece_count),
        "readings": int(np.sum(line.read)),
        "parameters": int(built.model.size),
        "ppm": float(mean_of_max()) * 1e6,
        "times": {
            "plan → information": _seconds(information),
            "plan → information → residual map → statistic": _seconds(mean_of_max),
            "compiled: derivatives in all figures of sensor, rig and plan": _seconds(lambda: sensitivity(spec)),
            "`build_imu(spec)`": _seconds(lambda: build_imu(spec)),
            "`imu_posterior(built)`": _seconds(lambda: imu_posterior(built)),
            "`predict(spec)` as called": _seconds(lambda: predict_spec(spec)),
        },
    }
