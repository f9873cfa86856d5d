"""64 IMUs at 250 Hz in one simulated run: rows lost, and time and memory of the logs and of the joint estimate.

`PYTHONPATH=.:tests/hardware python tests/evidence/sixty_four_imus.py FILE` writes one JSON file.
"""

import json
import resource
import sys
import tempfile
import time
from pathlib import Path

import jax
import numpy as np
from fixture_batches import CONSTANT, SIX
from imu_bench import made, short

from gradcal_jax.estimation.estimate import estimate_sensors
from gradcal_jax.hardware import execute
from gradcal_jax.records import run_log
from gradcal_jax.spec.changes import changed

COUNT, RATE_HZ, CYCLES = 64, 250.0, 2


def peak_gb() -> float:
    return resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 2**20


def main() -> None:
    """The run, its logs and its estimate."""
    jax.config.update("jax_enable_x64", True)
    places = [{"name": f"place{k + 1}", **SIX[k % 6]} for k in range(COUNT)]
    spec = changed(short(CYCLES), CONSTANT | {"rig.table.place": places})
    with tempfile.TemporaryDirectory() as place:
        folder = Path(place) / "run"
        begun = time.perf_counter()
        assert execute.run(made(spec), folder, simulate=True, seed=1, sample_rate_hz=RATE_HZ).exit_status == "success"
        ran, after_run = time.perf_counter() - begun, peak_gb()
        begun = time.perf_counter()
        logs = [run_log.log(folder, one["name"]) for one in places]
        logged = time.perf_counter() - begun
    lost = sum(int(np.count_nonzero(~np.isfinite(log.rate_rad_per_s[0]).all(axis=1))) for log in logs)
    # A row that did not come leaves a step of two periods.
    gaps = sum(int(np.count_nonzero(np.diff(log.time_s) > 1.5 / RATE_HZ)) for log in logs)
    begun = time.perf_counter()
    reports = estimate_sensors(spec, logs)
    estimated = time.perf_counter() - begun
    result = {
        "imus": len(reports), "rate_hz": RATE_HZ, "rows": sum(len(log.time_s) for log in logs), "rows_lost": lost,
        "gaps": gaps, "run_s": ran, "log_s": logged, "estimate_s": estimated, "peak_gb_of_run": after_run,
        "peak_gb": peak_gb(), "contradicted": sum(bool(r.calibration.contradicted) for r in reports),
    }  # fmt: skip
    Path(sys.argv[1]).write_text(json.dumps(result, indent=1) + "\n", encoding="utf-8")


if __name__ == "__main__":
    main()
