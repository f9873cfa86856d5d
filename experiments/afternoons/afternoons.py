"""Makes docs/afternoons: three IMUs from `gradcal start` to the firmware's header, each in a fresh folder.

python experiments/afternoons/afternoons.py [PRESET …], in some fifteen minutes on two cores. All devices are simulated;
what is printed is what a terminal shows, and the minutes are those of the machine that ran it.
"""

import os
import re
import shlex
import subprocess
import sys
import tempfile
import time
from collections.abc import Iterator
from contextlib import ExitStack
from pathlib import Path

import numpy as np

import gradcal_jax
from gradcal_jax.hardware.journal import records_of
from gradcal_jax.hardware.run_folder import RunFolder
from gradcal_jax.records.sessions import sessions_of
from gradcal_jax.records.spool import SampleSpool

PAGES = Path(__file__).parents[2] / "docs" / "afternoons"
HEAD = """# {title}

{words}

This page was made by `experiments/afternoons/afternoons.py`. It shows every command, with its output, from an empty
folder to the C header for the firmware. **All devices are simulated**: for a real run, write `--rig mine/rig.toml`
instead of `--simulate`. The middle of long outputs is left out and marked `[…]`. The durations were measured on a busy
computer with two cores; the hours of the simulated chamber pass in virtual time.
{installed}
"""
COMMANDS = """\
gradcal start --preset {preset} -o mine
gradcal check mine/spec.toml
gradcal predict mine/spec.toml
gradcal optimise mine/spec.toml --until-met -o mine/recipe.toml
gradcal run mine/recipe.toml --simulate -o mine/run
gradcal log mine/run{recording}
gradcal estimate mine/run/log.nc --recipe mine/recipe.toml -o mine/run/calibration.toml
gradcal report mine/run -o mine/report.html --before mine/spec.toml
gradcal report mine/run --certificate --number K-1 -o mine/certificate.html
gradcal export mine/run/calibration.toml --format c-header -o mine/calibration.h
"""
MOST_LINES = 24
WORDS_A_MINUTE = 200
TUTORIAL = PAGES.parent / "tutorial.md"


def main(names: list[str]) -> None:
    PAGES.mkdir(exist_ok=True)
    for title, preset, words, own in DEVICES:
        if names and preset not in names:
            continue
        with tempfile.TemporaryDirectory() as folder:
            parts = [
                HEAD.format(title=title, words=words, installed=installed()),
                *afternoon(Path(folder), preset, own),
            ]
        (PAGES / f"{preset}.md").write_text("".join(parts), encoding="utf-8")
        print(f"{title}: done", file=sys.stderr)


def installed() -> str:
    """How the program that runs was installed, in a sentence."""
    where = Path(gradcal_jax.__file__)
    how = "was installed with pip in an environment of its own" if "site-packages" in where.parts else "is a checkout"
    return f"gradcal {gradcal_jax.__version__} {how}."


def afternoon(folder: Path, preset: str, own: bool) -> Iterator[str]:
    """The commands of one device, and what they print."""
    recording = " --recording imu.csv --columns mine/columns.toml" * own
    spent, words = 0.0, 0
    for line in COMMANDS.format(preset=preset, recording=recording).splitlines():
        if own and line.startswith("gradcal log"):
            recorded_by_itself(folder / "mine/run", folder / "imu.csv")
            # The template has counts in one column, as an example; this logger writes degrees per second in all.
            columns = folder / "mine/columns.toml"
            text, count = re.subn(r", scale = 0\.0305 \}.*", " }", columns.read_text(encoding="utf-8"))
            assert count == 1, "the template of a column map has changed"
            columns.write_text(text, encoding="utf-8")
            yield (
                "\n`imu.csv` is the recording of the IMU's own logger, with the times of its own clock; "
                "`mine/columns.toml` describes its columns.\n"
            )
        begun = time.monotonic()
        done = subprocess.run(
            [sys.executable, "-m", "gradcal_jax", *shlex.split(line)[1:]], cwd=folder, text=True, check=False,
            stdout=subprocess.PIPE, stderr=subprocess.STDOUT, env=os.environ | {"PYTHONUNBUFFERED": "1"},
        )  # fmt: skip
        took = time.monotonic() - begun
        spent += took
        words += len(done.stdout.split())
        shown = shortened(done.stdout.rstrip().splitlines())
        status = "" if done.returncode == 0 else f", status {done.returncode}"
        yield f"\n    $ {line}\n" + "".join(f"    {text}\n" if text else "\n" for text in shown)
        yield f"\n*{took:.0f} s{status}*\n"
    pages = len(TUTORIAL.read_text(encoding="utf-8").split())
    minutes = (words + pages) / WORDS_A_MINUTE
    yield (
        f"\nAll commands together took {spent / 60.0:.1f} min. Reading takes {minutes:.0f} min at {WORDS_A_MINUTE}\n"
        f"words a minute: [My IMU, tomorrow](../tutorial.md) has {pages} words, and the commands print\n"
        f"{words} words in full.\n"
    )


def shortened(lines: list[str]) -> list[str]:
    """The first and last lines of a long output; long lines folded."""
    folded = [part for line in lines for part in ([line] if len(line) <= 116 else wrapped(line))]
    if len(folded) <= MOST_LINES:
        return folded
    return [*folded[: MOST_LINES - 8], "[…]", *folded[-8:]]


def wrapped(line: str) -> list[str]:
    return re.findall(r".{1,112}(?:\s|$)", line)


def recorded_by_itself(run: Path, path: Path) -> None:
    """All samples of the run's IMU as its own logger keeps them: means of two, by a clock of its own."""
    folder = RunFolder(run)
    with ExitStack() as stack:
        samples = stack.enter_context(SampleSpool())
        for _ in sessions_of(records_of(folder.journal_path), folder.rig().imu[0], samples):
            pass
        rows = samples.read(0, len(samples))
    even = len(rows) // 2 * 2
    columns = [
        rows["device_s"],
        *np.moveaxis(rows["gyro_dps"], -1, 0),
        *np.moveaxis(9.80665 * rows["acceleration_g"], -1, 0),
    ]
    columns.append(rows["temperature_c"])
    means = [column[:even].reshape(-1, 2).mean(axis=1) for column in columns]
    means[0] = 1e3 * (means[0] + 4321.0)
    np.savetxt(path, np.stack(means, axis=1), delimiter=",", fmt="%.6f", comments="", header="t,gx,gy,gz,ax,ay,az,temp")


DEVICES = (
    (
        "A BMI088 on a table of ±170°",
        "bmi088",
        "The table has one axis and is home-made, with a stepper motor on a GRBL board; its cable allows ±170°. A\n"
        "person operates a fridge and a hair dryer at the planned times. The board of the IMU prints lines of text.\n"
        "There are three temperature ramps, and the mounting is changed between them.",
        False,
    ),
    (
        "An ICM-42688 with its own logger, on a GRBL stepper",
        "drone-imu",
        "The flight controller records the IMU with its own logger, and the run controls the table and the chamber.\n"
        "`gradcal log` compares the motion of the IMU with that of the table, and so aligns the recording with the\n"
        "clock of the run. The spec states how far the gyros are from the accelerometers (`lever_arm`), because\n"
        "this distance matters at the rates of this plan.",
        True,
    ),
    (
        "A tactical IMU on a two-axis table",
        "tactical-imu",
        "The rig has a two-axis table (Zaber), a chamber (Weiss) and an IMU that sends its samples continuously\n"
        "(STIM300). One temperature ramp is enough.",
        False,
    ),
)


if __name__ == "__main__":
    main(sys.argv[1:])
