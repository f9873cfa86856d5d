"""How long an hour of a gyro at 1 kHz takes to import, from each kind of vehicle's log.

    python experiments/benchmarks/imports.py        # writes imports.md, in some minutes

The files are made by the tests' writers: a message a sample, which is the worst there is (PX4 packs several in one).
Each is read in a process of its own; its peak memory is the whole process's.
"""

import os
import platform
import resource
import subprocess
import sys
import tempfile
import time
from pathlib import Path

import numpy as np

HERE = Path(__file__).parent
sys.path.insert(0, str(HERE.parents[1] / "tests" / "records"))
ROWS = 3_600_000


def make(ending: str, folder: Path) -> Path:
    """The file, of `ROWS` samples 1 ms apart."""
    from vehicle_samples import dataflash, imu_rows, sensor_gyro, ulog

    stamps = 1000 * np.arange(ROWS, dtype=np.int64)
    rate = (np.random.default_rng(0).standard_normal((ROWS, 3)) * 1e-3).astype(np.float32)
    temperature = (30 + stamps * 1e-9).astype(np.float32)
    path = folder / f"a.{ending}"
    if ending == "ulg":
        return ulog(path, ("sensor_gyro", 0, sensor_gyro(stamps + 10**6, rate, temperature, 1)))
    return dataflash(path, imu_rows(stamps, 0, rate, temperature), {"INS_GYROFFS_X": 0.1})


def read(path: str) -> None:
    """Prints seconds (wall, processor) and MB."""
    from gradcal_jax.records.vehicle import read_vehicle_log

    began, busy = time.perf_counter(), time.process_time()
    log = read_vehicle_log(path)
    assert len(log.time_s) == ROWS
    peak = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1024
    print(f"{time.perf_counter() - began:.1f} {time.process_time() - busy:.1f} {peak:.0f}")


def main() -> None:
    """The table."""
    rows = []
    with tempfile.TemporaryDirectory() as folder:
        for ending, words in (("ulg", "ULog, `sensor_gyro`"), ("bin", "DataFlash, `IMU`")):
            path = make(ending, Path(folder))
            size = path.stat().st_size / 1e6
            found = subprocess.run(
                [sys.executable, __file__, str(path)], capture_output=True, text=True, check=True
            ).stdout.split()
            rows.append(f"| {words} | {size:.0f} | {found[0]} | {found[1]} | {found[2]} |")
            path.unlink()
    text = (
        f"# Benchmark of imports\n\n{time.strftime('%Y-%m-%d')}, {os.cpu_count()} cores, {platform.system()} "
        f"{platform.machine()}, Python {platform.python_version()}; `python experiments/benchmarks/imports.py`. An "
        f"hour at 1 kHz,\n3,600,000 messages; load {os.getloadavg()[0]:.1f}.\n\n"
        "| log | file, MB | seconds | of the processor | peak MB |\n|---|---|---|---|---|\n" + "\n".join(rows) + "\n"
    )
    (HERE / "imports.md").write_text(text, encoding="utf-8")


if __name__ == "__main__":
    read(sys.argv[1]) if len(sys.argv) > 1 else main()
