"""Records without a fault give the figures that they gave before faults of recordings were looked for.

Rates and Allan deviations are as they were, to 1e-12. Those are 3e-16 apart, since squares are summed in other pieces;
the fit takes differences of nearly equal terms of them, and its coefficients move by up to 6e-8, which is less than a
millionth of their standard errors. The program that recorded them differs from itself by more, up to 3e-7, where its
sums run on one thread in place of two. The Direct Bound follows the fit's random walk.
"""

import json
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from gradcal_jax.identify.instability import at_rest, instability
from gradcal_jax.records.importers import import_log, parse_column_map

KEPT = json.loads(Path(__file__).with_name("sound_records.json").read_text(encoding="utf-8"))
RECORDS = {
    "1 Hz": (1.0, 4000, "s"),
    "10 Hz": (10.0, 9000, "ms"),
    "100 Hz": (100.0, 40000, "us"),
    "1 kHz": (1e3, 90000, "ns"),
}
DRIFT_DEG_PER_H, CORRELATION_S, WALK = 40.0, 60.0, 0.3


def write(name: str, folder: Path, *, warm: bool) -> tuple[Path, str]:
    """A text table of a drifting gyro at rest and its map; `warm`: its temperature rises, and its bias with it."""
    rate, rows, unit = RECORDS[name]
    rng = np.random.default_rng([rows, warm])
    steps = rng.standard_normal(rows) * DRIFT_DEG_PER_H / 3600.0
    kept, drift = np.exp(-1.0 / (rate * CORRELATION_S)), np.empty(rows)
    value = steps[0]
    for k in range(rows):
        value = kept * value + np.sqrt(1.0 - kept**2) * steps[k]
        drift[k] = value
    temperature = 20.0 + 30.0 * np.arange(rows) / rows + 0.01 * rng.standard_normal(rows)
    values = drift + 0.02 + WALK / 60.0 * np.sqrt(rate) * rng.standard_normal(rows) + warm * 1e-3 * (temperature - 20.0)
    stamps = np.rint(np.arange(rows) * {"s": 1.0, "ms": 1e3, "us": 1e6, "ns": 1e9}[unit] / rate).astype(np.int64) + 1000
    lines = zip(stamps.tolist(), values.tolist(), temperature.tolist(), strict=True)
    path = folder / f"{name.replace(' ', '')}.csv"
    path.write_text("t,gx,temp\n" + "".join(f"{t},{w:.9f},{c:.4f}\n" for t, w, c in lines), encoding="utf-8")
    text = 'format = "gradcal-columns/1"\nrate.x = { column = "gx", unit = "deg/s" }\n'
    text += f'time = {{ column = "t", unit = "{unit}" }}\n'
    return path, text + 'temperature = { column = "temp", unit = "degC" }\n' * warm


def figures(path: Path, columns: str) -> dict[str, Any]:
    """What `allan` and `instability` give for a record."""
    log = import_log(path, parse_column_map(columns))
    result = instability(at_rest(log, 0, lag=False))
    fit = result.allan_fit
    coefficients = fit.quantisation, fit.angle_random_walk, fit.bias_instability, fit.rate_random_walk
    return {
        "rows": log.rows_read,
        "interval": log.sample_interval_s,
        "rms": float(np.sqrt(np.mean(result.rest.rate**2))),
        "deviation": result.allan.deviation.tolist(),
        "coefficients": [coefficient.value for coefficient in coefficients],
        "errors": [coefficient.standard_error for coefficient in coefficients],
        "bound": [result.bound.drift_std, result.bound.correlation_time_s],
    }


@pytest.mark.parametrize("warm", [False, True])
@pytest.mark.parametrize("name", RECORDS)
def test_figures_of_sound_records_are_as_before(tmp_path, name, warm):
    kept = KEPT[f"{name}, warmed" if warm else name]
    now = figures(*write(name, tmp_path, warm=warm))
    assert now["rows"] == kept["rows"]
    for key in ("interval", "rms", "deviation"):
        np.testing.assert_allclose(now[key], kept[key], rtol=1e-12)
    off = np.abs(np.subtract(now["coefficients"], kept["coefficients"]))
    assert np.all(off <= 1e-6 * np.array(kept["errors"]))
    np.testing.assert_allclose(now["errors"], kept["errors"], rtol=1e-6)
    np.testing.assert_allclose(now["bound"], kept["bound"], rtol=1e-6)
