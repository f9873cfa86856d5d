"""`gradcal demo`: the whole job in one sitting, each step by the command that does it alone.

Nothing is done here that the commands do not do: every step *is* a command line, run in this process, and every number
told is read from what that command wrote.
"""

import contextlib
import io
import json as json_format
from collections.abc import Mapping
from pathlib import Path
from typing import Any, Final

from gradcal_jax.cli.console import strong
from gradcal_jax.cli.output import Flag, Json, Output, as_json
from gradcal_jax.cli.status import DONE, NOT_AS_WISHED
from gradcal_jax.pages.plain_text import amount
from gradcal_jax.units import time_text

RECORDING: Final = "tofupilot_imu_thermal_cycle.npz"

# The paper's sensor and chamber, on a table whose acceleration it does not name: here one of 300 deg/s^2. Two turns a
# visit, two starts and 60 steps: so that the search takes a minute; more of each finds some per cent less.
_HEADLINE: Final[dict[str, object]] = {
    "title": "Berman's gyro, with a plan of its own",
    "rig.table.max_acceleration": "300 deg/s^2",
    "plan.cycle.moves": [
        {"rest": "8 s", "read_every": "1 s"},
        {"turn": "5400 deg", "peak_rate": "300 deg/s", "shape": "cosine ramps"},
        {"rest": "8 s", "read_every": "1 s"},
        {"turn": "-5400 deg", "peak_rate": "300 deg/s", "shape": "cosine ramps"},
        {"rest": "8 s", "read_every": "1 s"},
        {"turn": "3600 deg", "peak_rate": "150 deg/s", "shape": "cosine ramps"},
        {"rest": "7.28 s", "read_every": "1 s"},
        {"turn": "-3600 deg", "peak_rate": "150 deg/s", "shape": "cosine ramps"},
    ],
    "design.minimise": "full range",
    "design.free": ["duration", "peak_rate", "ramp"],
    "design.moves": 2,
    "design.starts": 2,
}
_STEPS: Final = "60"
# Plans that the short search for a whole unit tries.
_PLANS: Final = "150"

# Axis y, whose bias follows the temperature best. The recording names no units: time fits µs, white noise rad/s.
_COLUMNS: Final = """\
format      = "gradcal-columns/1"
skip_first  = 1                                      # an outlier
time        = { column = "timestamp_raw", unit = "us" }
temperature = { column = "temperature_C", unit = "degC" }
rate.x      = { column = "gyro", index = 0, unit = "rad/s" }
rate.y      = { column = "gyro", index = 1, unit = "rad/s" }
rate.z      = { column = "gyro", index = 2, unit = "rad/s" }
"""


def demo(
    *,
    output: Output = Path("gradcal-demo"),
    data: Path | None = None,
    imu: Flag = False,
    seed: int = 1,
    json: Json = False,
) -> int:
    """Do the whole job in about two minutes, from a spec to a calibrated sensor on simulated devices and a page of it.

    Each step says which command does it alone. With --imu it is a whole unit on a two-axis table: a better plan, the
    run, the calibration of all axes, in some minutes. With --data the sensor is a recorded one: its drift is found in
    a thermal cycle at rest, and a plan is designed for it. The exit status is 1 where a target is missed in the end.

    Parameters
    ----------
    output
        The folder for everything that is made.
    data
        A folder with the recorded thermal cycle, tofupilot_imu_thermal_cycle.npz.
    imu
        A whole unit, three gyros and three accelerometers.
    seed
        What the simulated devices' hidden errors are drawn by.
    json
        Print every number as JSON, as demo.json in the folder has it.
    """
    if data is not None and imu:
        raise ValueError("--data is of a recorded gyro, --imu of a whole unit: take one of them")
    if data is not None and not (data / RECORDING).is_file():
        raise ValueError(f"{data} has no {RECORDING}: name the folder with the recorded thermal cycle")
    if output.exists() and not (output.is_dir() and not any(output.iterdir())):
        raise ValueError(f"{output} exists; name a folder that does not, with -o")
    if not output.absolute().parent.is_dir():
        raise ValueError(f"there is no directory {output.parent}; make it first")
    output.mkdir(exist_ok=True)
    told = _Told(output, quiet=json)
    try:
        if data is not None:
            result = _recorded_sensor(told, (data / RECORDING).absolute())
        else:
            result = _whole_unit(told, seed) if imu else _whole_job(told, seed)
    except _Stopped as stopped:
        return stopped.status
    result = {"folder": str(told.folder), **result, "commands": told.commands}
    text = as_json(result)
    (told.folder / "demo.json").write_text(text + "\n", encoding="utf-8")
    if json:
        print(text)
    else:
        print(f"\nall of it lies in {output}; open {output / 'report.html'}")
    rows = result["report"]["requirements"]
    return DONE if all(row["verdict"] in (None, "met") for row in rows) else NOT_AS_WISHED


def _whole_job(told: "_Told", seed: int) -> dict[str, Any]:
    told.step("The paper's spec: its sensor, its table, its chamber, its plan")
    told.run("new paper-dynamic-gradient -o paper.toml")

    told.step("What the paper's plan will leave")
    paper = told.json("predict paper.toml --json")
    row, hours = paper["requirements"][0], time_text(paper["duration_s"])
    told.say(f"{row['name']}, {row['statistic']}: {amount(row['mean_of_max'], row['unit'])} in {hours}")

    told.step("A better plan for the same sensor in the same time, on a table of 300 deg/s^2")
    told.design("design.toml", _HEADLINE, "The paper's spec, with a [design].")
    found, recipe = told.optimise("design.toml")
    told.say(found["sentence"])

    told.step("What no plan can beat, proven")
    limits = told.json("limit recipe.toml --json", keep="limit.json")
    limit = next(entry for entry in limits if entry["name"] == recipe["name"])
    told.say(
        f"no plan on this rig in this time leaves less than {amount(limit['certified'], limit['unit'])}: "
        f"efficiency {limit['efficiency']:.0%}"
    )

    told.step("The run: simulated chamber, table and sensor on serial ports, hours of virtual time")
    told.run(f"run recipe.toml --simulate --seed {seed} -o run")
    told.step("Its log, from the raw bytes")
    told.run("log run")

    told.step("The calibration")
    estimate = told.json("estimate run/log.nc --recipe recipe.toml -o run/calibration.toml --json")
    (unit,) = estimate["units"]
    achieved = next(entry for entry in unit["requirements"] if entry["name"] == recipe["name"])
    chance = unit["channels"][0]["consistency"]["chi_squared"]["probability"]
    told.say(
        f"{achieved['name']}: {amount(achieved['value'], achieved['unit'])} achieved, "
        f"{amount(recipe['predicted'], recipe['unit'])} predicted; the data agree with the model (chance {chance:.2g})"
    )

    told.step("The page")
    report = told.json("report run -o report.html --before paper.toml --limits limit.json --json")
    told.agreement(report, 3)
    return {
        "prediction": paper,
        "recipe": recipe,
        "optimisation": found,
        "limits": limits,
        "estimate": estimate,
        "report": report,
    }


def _whole_unit(told: "_Told", seed: int) -> dict[str, Any]:
    told.step("A unit of three gyros and three accelerometers, and a plan for a two-axis table")
    told.run("new two-axis-table -o unit.toml")

    told.step("What that plan will leave of every quantity")
    before = told.json("predict unit.toml --json")
    for row in before["requirements"]:
        told.say(f"{row['name']}: {amount(row[row['statistic'].replace(' ', '_')], row['unit'])}")

    told.step("Better poses and moves in the same time: a short search")
    found = told.json(f"optimise unit.toml -o design.toml --steps {_PLANS} --json")
    told.say(f"{found['gain']:.2f} times better in the geometric mean of all, after {found['evaluations']} plans")
    told.run("recipe design.toml -o recipe.toml")

    told.step("The run: simulated chamber, table and unit on serial ports, hours of virtual time")
    told.run(f"run recipe.toml --simulate --seed {seed} -o run")
    told.step("Its log, from the raw bytes")
    told.run("log run")

    told.step("The calibration of all axes, and what the run says of the table")
    estimate = told.json("estimate run/log.nc --recipe recipe.toml -o run/calibration.toml --json")
    told.step("The page")
    report = told.json("report run -o report.html --json")
    for row in report["requirements"]:
        told.say(
            f"{row['name']}: {amount(row['achieved'], row['unit'])} achieved, "
            f"{amount(row['predicted'], row['unit'])} predicted"
        )
    told.agreement(report, 4)
    return {
        "prediction": before,
        "optimisation": found,
        "estimate": estimate,
        "report": report,
    }


def _recorded_sensor(told: "_Told", recording: Path) -> dict[str, Any]:
    from gradcal_jax.files.writing import write_whole

    told.step("A MEMS gyro at rest through one thermal cycle: its drift, by the paper's Direct Bound")
    write_whole(told.folder / "columns.toml", _COLUMNS)
    where = json_format.dumps(str(recording))
    instability = told.json(f"instability {where} --columns columns.toml --axis y --delta '60 s' --json")
    (channel,) = instability["channels"]
    walk, drift = channel["angle_random_walk_deg_per_sqrt_h"], channel["drift_std_deg_per_h"]
    lasting = channel["correlation_time_s"]
    told.say(f"axis y: {drift:.4g} deg/h with a correlation time of {lasting:.4g} s; random walk {walk:.4g} deg/√h")
    told.say("the recording names no units: it is read as µs and rad/s")

    told.step("A spec of that sensor, on the paper's rig; its maps are cubic, and their size is unknown")
    told.design(
        "sensor.toml",
        _HEADLINE
        | {
            "title": "The recorded gyro on the paper's rig",
            "sensor.name": "recorded thermal cycle, axis y, read as rad/s",
            "sensor.angle_random_walk": f"{walk:.4g} deg/sqrt(h)",
            "sensor.drift": [{"standard_deviation": f"{drift:.4g} deg/h", "correlation_time": f"{lasting:.4g} s"}],
            "requirement[0].target": None,
            # Against so much drift many short moves are best; the same in every visit is quicker to search.
            "design.moves": 6,
            "design.cycles": "alike",
        },
        "Noise as recorded; the rest is the paper's, with a [design].",
    )
    before = told.json("predict sensor.toml --json")
    row, hours = before["requirements"][0], time_text(before["duration_s"])
    told.say(f"a plan by hand leaves {amount(row['mean_of_max'], row['unit'])} of {row['name']} in {hours}")

    told.step("A plan designed for it")
    found, recipe = told.optimise("sensor.toml")

    told.step("The page")
    report = told.json("report recipe.toml -o report.html --before sensor.toml --json")
    return {
        "instability": instability,
        "prediction": before,
        "recipe": recipe,
        "optimisation": found,
        "report": report,
    }


class _Stopped(Exception):
    """A step's command failed; `status` is its exit status."""

    def __init__(self, status: int) -> None:
        super().__init__(status)
        self.status = status


class _Told:
    """Runs command lines in the folder, and tells of them. `commands`: those that were run."""

    def __init__(self, folder: Path, *, quiet: bool) -> None:
        self.folder = folder.absolute()
        self.commands: list[str] = []
        self._quiet = quiet
        self._number = 0

    def step(self, words: str) -> None:
        """Begin a step."""
        self._number += 1
        self.say(strong(f"\n{self._number}. {words}"), indent="")

    def say(self, text: str, *, indent: str = "   ") -> None:
        """A line for people; none where JSON is asked for."""
        if not self._quiet:
            print(indent + text, flush=True)

    def optimise(self, spec: str) -> tuple[dict[str, Any], dict[str, Any]]:
        """Search a plan for a spec; what the search says, and the requirement that the recipe was designed for."""
        from gradcal_jax.files.recipe import read_recipe

        found = self.json(f"optimise {spec} -o recipe.toml --steps {_STEPS} --json")
        made = read_recipe(self.folder / "recipe.toml")
        row = made.prediction.requirements[0]
        recipe = {"file": "recipe.toml", "fingerprint": made.fingerprint, "name": row.name, "statistic": row.statistic}
        self.say(f"{row.name}: {amount(row.decisive, row.unit)}; {found['structure']}")
        return found, recipe | {"predicted": row.decisive, "unit": row.unit}

    def design(self, name: str, changes: Mapping[str, object], header: str) -> None:
        """Write the paper's spec, changed, into the folder."""
        from gradcal_jax.files import changed, presets, to_toml
        from gradcal_jax.files.spec import parse_spec
        from gradcal_jax.files.writing import write_whole

        spec = changed(parse_spec(presets.text("paper-dynamic-gradient")), changes)
        write_whole(self.folder / name, to_toml(spec, header=header))

    def agreement(self, report: dict[str, Any], digits: int) -> None:
        """How far what was found is from what was hidden."""
        if (agreement := report["axes"][0]["agreement"]) is not None:
            chi, degrees, likely = agreement
            self.say(
                f"against the hidden truth: χ² {chi:.{digits}g} of {degrees} degrees for all coefficients together "
                f"(chance {likely:.2g})"
            )

    def run(self, line: str) -> str:
        """Run `gradcal LINE`; what it printed. Raises `_Stopped` where it failed."""
        import shlex

        from gradcal_jax.cli.app import run

        self.commands.append(f"gradcal {line}")
        self.say(f"$ gradcal {line}")
        printed = io.StringIO()
        # Short names, as whoever repeats the commands in that folder would type them.
        with contextlib.chdir(self.folder), contextlib.redirect_stdout(printed):
            status = run(shlex.split(line))
        if status not in (DONE, NOT_AS_WISHED):
            raise _Stopped(status)
        return printed.getvalue()

    def json(self, line: str, *, keep: str | None = None) -> Any:
        """Run a command that prints JSON, and read it; `keep`: write what it printed there, too."""
        text = self.run(line)
        if keep is not None:
            (self.folder / keep).write_text(text, encoding="utf-8")
        return json_format.loads(text)
