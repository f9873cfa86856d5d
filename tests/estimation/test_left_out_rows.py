"""What an estimate that fails says of the rows that were left out before it."""

import numpy as np
import pytest

import gradcal_jax as gj
from gradcal_jax.records.log import Log, LogError
from gradcal_jax.spec import presets


def test_an_estimate_that_fails_names_the_rows_that_were_left_out():
    """A sensor that repeats its values at every held rate: no point is left, and the reason is said."""
    spec = gj.parse_spec(presets.text("paper-dynamic-standard"))
    rng = np.random.default_rng(1)
    rows, interval = 2000, 0.1
    held = np.repeat(np.radians([-300.0, -150.0, -10.0, 10.0, 150.0, 300.0] * 3), rows)
    count = len(held)
    rate = held + np.where(np.arange(count) % rows < 300, 1e-5 * rng.standard_normal(count), 0.0)
    log = Log(
        np.arange(count) * interval, rate[None, :, None], ("unit1",), ("x",), np.full((1, count), 20.0)
        + 0.01 * rng.standard_normal((1, count)), table_axes=("x",), table_rate_rad_per_s=held[:, None],
    )  # fmt: skip
    with pytest.raises(LogError, match=r"none of the plan's points .*; frozen: gyro x .* rows are left out"):
        gj.estimate(spec, log)
