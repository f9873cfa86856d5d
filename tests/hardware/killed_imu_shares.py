"""Shares of the evidence of `test_killed_imu_runs`, for a computer with many processors that does little else.

killed_imu_shares.py --seed 20 FOLDER     one run: its sums as FOLDER/20.json, and its folder where they are no usual
                                          ones (chance below 1 %)
killed_imu_shares.py FOLDER               the row of the report, of all sums there, which must pass
"""

import argparse
import json
import shutil
import tempfile
import time
from pathlib import Path

from hardware_evidence import machine
from test_killed_imu_runs import Sums, in_band, killed_run, quick, require_and_record


def make(seed: int, folder: Path) -> None:
    sums, began = Sums(), time.monotonic()
    folder.mkdir(parents=True, exist_ok=True)
    with tempfile.TemporaryDirectory() as here:
        killed_run(Path(here) / f"run{seed}", quick(2), 3, seed, sums)
        squares, degrees, nees, count = sums.together
        if not (in_band(squares, degrees) and in_band(nees, count)):
            shutil.copytree(Path(here) / f"run{seed}", folder / f"run{seed}", dirs_exist_ok=True)
    share = vars(sums) | {"took_s": time.monotonic() - began, "machine": machine()}
    (folder / f"{seed}.json").write_text(json.dumps(share) + "\n", encoding="utf-8")


def together(folder: Path) -> None:
    sums, took_s, on = Sums(), 0.0, ""
    for path in sorted(folder.glob("*.json")):
        share = json.loads(path.read_text(encoding="utf-8"))
        sums.kills.update(share["kills"])
        sums.guarded += share["guarded"]
        sums.seams += share["seams"]
        sums.each += [tuple(of) for of in share["each"]]
        took_s += share["took_s"]
        on = share["machine"]
    require_and_record(sums, took_s, on)


if __name__ == "__main__":
    parser = argparse.ArgumentParser()
    parser.add_argument("--seed", type=int)
    parser.add_argument("folder", type=Path)
    options = parser.parse_args()
    if options.seed is None:
        together(options.folder)
    else:
        make(options.seed, options.folder)
