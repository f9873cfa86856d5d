"""Sound records, regular and complete, and the noise figures and drifts of them, for `test_sound_records.py`.

    python tests/numbers/sound_records.py        # writes sound_records.json

What is kept there was written by the program before it looked for faults of recordings at all.
"""

import json
import sys
import tempfile
from pathlib import Path
from typing import Any

import numpy as np

HERE = Path(__file__).resolve().parent
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
    from gradcal_jax.identify import instability as work
    from gradcal_jax.records.importers import import_log, parse_column_map

    log = import_log(path, parse_column_map(columns))
    result = work.instability(work.at_rest(log, 0, lag="none"))
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


def cases() -> list[tuple[str, bool]]:
    """Names of the records, and whether they are warmed."""
    return [(name, warm) for name in RECORDS for warm in (False, True)]


def main() -> None:
    """Writes the figures."""
    import jax

    jax.config.update("jax_enable_x64", True)
    kept = {}
    with tempfile.TemporaryDirectory() as folder:
        for name, warm in cases():
            kept[f"{name}, warmed" if warm else name] = figures(*write(name, Path(folder), warm=warm))
    (Path(sys.argv[1]) if len(sys.argv) > 1 else HERE / "sound_records.json").write_text(
        json.dumps(kept, indent=1) + "\n"
    )


if __name__ == "__main__":
    main()
