"""How long an hour of an IMU at 1 kHz, six channels in a text table, takes to read and to judge.

    python experiments/benchmarks/recordings.py        # writes recordings.md, in some minutes

The record is simulated: at rest, 0.3 deg/√h. Every row of the table is a process of its own. Variants of the table hold
the same rows; what they add is at the worst place, in every block of rows or in every row.
"""

import os
import platform
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable
from pathlib import Path

import numpy as np

HERE = Path(__file__).parent
ROWS, HZ, BLOCK = 3_600_000, 1000.0, 100_000
HEADER = "t,gx,gy,gz,ax,ay,az"
MAP = 'format = "gradcal-columns/1"\ntime = { column = "t", unit = "s" }\n' + "".join(
    f'rate.{axis} = {{ column = "g{axis}", unit = "deg/s" }}\nforce.{axis} = {{ column = "a{axis}", unit = "m/s^2" }}\n'
    for axis in "xyz"
)
PLAIN = ("a plain table", "", lambda k, row: row)
VARIANTS: list[tuple[str, str, Callable[[int, str], str]]] = [
    PLAIN,
    ("a torn row in a thousand", "", lambda k, row: row[:30] if k % 1000 == 7 else row),
    ("a checksum", "", lambda k, row: f"{row}*7F"),
    ("decimal commas", '[csv]\ndelimiter = ";"\ndecimal = ","\n', lambda k, row: row.translate({44: 59, 46: 44})),
    (
        "accelerometer in every fourth row",
        "interpolate = true\n",
        lambda k, row: row if k % 4 == 0 else ",".join(row.split(",")[:4]) + ",,,",
    ),
]


def write(folder: Path, more: str, change: Callable[[int, str], str]) -> Path:
    """The table, and its map beside it."""
    rng, path = np.random.default_rng(3), folder / "hour.csv"
    with path.open("w", encoding="utf-8") as file:
        file.write(HEADER.replace(",", ";" if "delimiter" in more else ",") + "\n")
        for first in range(0, ROWS, BLOCK):
            k = np.arange(first, first + BLOCK)
            rate = rng.standard_normal((BLOCK, 3)) * 0.3 / 60.0 * np.sqrt(HZ)
            force = rng.standard_normal((BLOCK, 3)) * 0.02 + np.array([0.0, 0.0, 9.80665])
            for number, values in zip(k.tolist(), np.column_stack([k / HZ, rate, force]).tolist(), strict=True):
                file.write(change(number, ",".join(f"{value:.6f}" for value in values)) + "\n")
    (folder / "map.toml").write_text(MAP + more, encoding="utf-8")
    return path


def read(path: str) -> None:
    """Read the table alone."""
    from gradcal_jax import import_log
    from gradcal_jax.records.importers import parse_column_map

    text = (Path(path).parent / "map.toml").read_text(encoding="utf-8")
    assert len(import_log(path, parse_column_map(text)).time_s) == ROWS


def timed(arguments: list[str]) -> tuple[float, float, float]:
    """Seconds, those of the processor, and MB of a process."""
    began = time.perf_counter()
    with tempfile.TemporaryFile() as said:
        process = subprocess.Popen([sys.executable, *arguments], stdout=said)
        _, status, used = os.wait4(process.pid, 0)
        # 1: no drift shows; a program that cannot begin says nothing.
        code = os.waitstatus_to_exitcode(status)
        assert code == 0 or (code == 1 and said.seek(0, os.SEEK_END)), arguments
    return time.perf_counter() - began, used.ru_utime + used.ru_stime, used.ru_maxrss / 1024


def main() -> None:
    """The table."""
    rows = []
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        for words, more, change in VARIANTS:
            path = write(folder, more, change)
            commands = {"`import_log`": [__file__, str(path)]}
            if (words, more, change) == PLAIN:
                given = [str(path), "--columns", str(folder / "map.toml")]
                for command in ("allan", "instability"):
                    commands[f"`gradcal {command}`, three gyros"] = ["-m", "gradcal_jax", command, *given]
            for command, arguments in commands.items():
                seconds, busy, peak = timed(arguments)
                rows.append(f"| {words} | {command} | {seconds:.1f} | {busy:.1f} | {peak:.0f} |")
    text = (
        f"# Benchmark of recordings\n\n{time.strftime('%Y-%m-%d')}, {os.cpu_count()} cores, {platform.system()} "
        f"{platform.machine()}, Python {platform.python_version()}; `python experiments/benchmarks/recordings.py`. An "
        f"hour of six\nchannels and stamps at 1 kHz as text, {ROWS:,} rows, 245 MB, simulated; load "
        f"{os.getloadavg()[0]:.1f}.\n\n| table | work | seconds | of the processor | peak MB |\n|---|---|---|---|---|\n"
        + "\n".join(rows)
        + "\n"
    )
    (HERE / "recordings.md").write_text(text, encoding="utf-8")


if __name__ == "__main__":
    read(sys.argv[1]) if len(sys.argv) > 1 else main()
