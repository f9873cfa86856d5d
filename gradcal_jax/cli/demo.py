"""`gradcal demo`: the whole job in one sitting, each step by the command that does it alone.

Nothing is done here that the commands do not do: every step calls a command's function and prints the command line that
calls it in the same way, and every number comes from that command's output.
"""

import contextlib
import io
import json as json_format
import shlex
from collections.abc import Callable, Iterator, Mapping
from pathlib import Path
from typing import Any, Final

from gradcal_jax.cli.estimate import estimate
from gradcal_jax.cli.instability import instability
from gradcal_jax.cli.log import log
from gradcal_jax.cli.new import new
from gradcal_jax.cli.optimise import optimise
from gradcal_jax.cli.output import DONE, NOT_AS_WISHED, Flag, Json, Output, as_json, strong
from gradcal_jax.cli.predict import limit, predict
from gradcal_jax.cli.recordings import Recording
from gradcal_jax.cli.report import report
from gradcal_jax.cli.run import run
from gradcal_jax.tables.display import amount
from gradcal_jax.units import time_text

RECORDING: Final = "tofupilot_imu_thermal_cycle.npz"

# The paper's sensor and chamber, on a table whose acceleration it does not name: here one of 300 deg/s^2. Two turns a
# visit, two starts and 60 steps: so that the search takes a minute; more of each finds some per cent less.
_HEADLINE: Final[dict[str, object]] = {
    "title": "Berman's gyro, with a plan of its own",
    "rig.table.axis[0].max_acceleration": "300 deg/s^2",
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
_STEPS: Final = 60
# Gradients of the short search for an IMU.
_IMU_STEPS: Final = 150

# The files of the demo, by the names under which its commands know them.
_PAPER, _RECIPE, _REPORT = Path("paper.toml"), Path("recipe.toml"), Path("report.html")
_RUN = Path("run")
_LOG, _CALIBRATION = _RUN / "log.nc", _RUN / "calibration.toml"

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
    """Run the whole procedure in about two minutes, from a spec to a calibrated (simulated) sensor and a report.

    Each step prints its command. With --imu, the sensor is an IMU on a two-axis table; the demo optimises the plan,
    runs it and calibrates all axes, in a few minutes. With --data, a recording of a real sensor is used: its drift is
    estimated from a thermal cycle at rest, and a plan is designed for this sensor. The exit status is 1 if the
    calibration misses a target.

    Parameters
    ----------
    output
        The folder for all files.
    data
        A folder with the recorded thermal cycle, tofupilot_imu_thermal_cycle.npz.
    imu
        Use an IMU (three gyros and three accelerometers) instead of one gyro.
    seed
        The seed of the simulated devices' errors; the estimate does not know these errors.
    json
        Print every number as JSON; the same text is in the file demo.json of the folder.
    """
    if data is not None and imu:
        raise ValueError("--data is for a recorded gyro, --imu for an IMU: use only one of them")
    if data is not None and not (data / RECORDING).is_file():
        raise ValueError(f"{data} has no {RECORDING}: name the folder with the recorded thermal cycle")
    if output.exists() and not (output.is_dir() and not any(output.iterdir())):
        raise ValueError(f"{output} exists; name another folder with -o")
    if not output.absolute().parent.is_dir():
        raise ValueError(f"there is no directory {output.parent}; make it first")
    output.mkdir(exist_ok=True)
    sitting = _Sitting(output, quiet=json)
    try:
        if data is not None:
            numbers = _recorded_sensor(sitting, (data / RECORDING).absolute())
        else:
            numbers = _whole_imu(sitting, seed) if imu else _whole_job(sitting, seed)
    except _Stopped as stopped:
        return stopped.status
    numbers = {"folder": str(sitting.folder), **numbers, "commands": sitting.commands}
    text = as_json(numbers)
    (sitting.folder / "demo.json").write_text(text + "\n", encoding="utf-8")
    if json:
        print(text)
    else:
        print(f"\nall files are in {output}; open {output / 'report.html'}")
    rows = numbers["report"]["requirements"]
    return DONE if all(row["verdict"] in (None, "met") for row in rows) else NOT_AS_WISHED


def _whole_job(sitting: "_Sitting", seed: int) -> dict[str, Any]:
    sitting.step("The paper's spec: sensor, table, chamber and plan")
    sitting.run(new, "paper-dynamic-gradient", output=str(_PAPER))

    sitting.step("The error that the paper's plan leaves")
    paper = sitting.numbers(predict, (_PAPER,))
    row, hours = paper["requirements"][0], time_text(paper["duration_s"])
    sitting.say(f"{row['name']}, {row['statistic']}: {amount(row['mean_of_max'], row['unit'])} in {hours}")

    sitting.step("A better plan for the same sensor in the same time, on a table of 300 deg/s^2")
    spec, limits = Path("design.toml"), Path("limit.json")
    sitting.design(spec, _HEADLINE, "The paper's spec, with a [design] section.")
    optimisation, designed = sitting.optimise(spec)
    sitting.say(optimisation["sentence"])

    sitting.step("A proven limit for all plans")
    bounds = sitting.numbers(limit, _RECIPE)
    (sitting.folder / limits).write_text(as_json(bounds) + "\n", encoding="utf-8")
    bound = next(entry for entry in bounds if entry["name"] == designed["name"])
    sitting.say(
        f"no plan of this duration on this rig leaves less than {amount(bound['certified'], bound['unit'])}: "
        f"efficiency {bound['efficiency']:.0%}"
    )

    calibration = sitting.calibration(seed, "table and sensor", "The calibration")
    (unit,) = calibration["units"]
    achieved = next(entry for entry in unit["requirements"] if entry["name"] == designed["name"])
    chance = next(test["chance"] for test in unit["tests"] if test["name"].startswith("chi-squared"))
    sitting.say(
        f"{achieved['name']}: {amount(achieved['value'], achieved['unit'])} achieved, "
        f"{amount(designed['predicted'], designed['unit'])} predicted; chi-squared test of the data against the model: "
        f"p = {chance:.2g}"
    )

    sitting.step("The page")
    page = sitting.numbers(report, (_RUN,), output=_REPORT, before=_PAPER, limits=limits)
    sitting.agreement(page, 3)
    return {
        "prediction": paper,
        "recipe": designed,
        "optimisation": optimisation,
        "limits": bounds,
        "estimate": calibration,
        "report": page,
    }


def _whole_imu(sitting: "_Sitting", seed: int) -> dict[str, Any]:
    spec = Path("imu.toml")
    sitting.step("An IMU of three gyros and three accelerometers, and a plan for a two-axis table")
    sitting.run(new, "two-axis-table", output=str(spec))

    sitting.step("The error of every quantity that this plan leaves")
    before = sitting.numbers(predict, (spec,))
    for row in before["requirements"]:
        sitting.say(f"{row['name']}: {amount(row[row['statistic'].replace(' ', '_')], row['unit'])}")

    sitting.step("Better poses and moves in the same time: a short search")
    optimisation, designed = sitting.optimise(spec, steps=_IMU_STEPS)
    sitting.say(f"the geometric mean of all residuals is smaller by a factor of {optimisation['gain']:.2f}")

    title = "The calibration of all axes, and the errors of the table estimated from the same log"
    calibration = sitting.calibration(seed, "table and IMU", title)
    sitting.step("The page")
    page = sitting.numbers(report, (_RUN,), output=_REPORT)
    for row in page["requirements"]:
        sitting.say(
            f"{row['name']}: {amount(row['achieved'], row['unit'])} achieved, "
            f"{amount(row['predicted'], row['unit'])} predicted"
        )
    sitting.agreement(page, 4)
    return {
        "prediction": before,
        "recipe": designed,
        "optimisation": optimisation,
        "estimate": calibration,
        "report": page,
    }


def _recorded_sensor(sitting: "_Sitting", recording: Path) -> dict[str, Any]:
    from gradcal_jax.tables.writing import write_whole

    sitting.step("A MEMS gyro at rest through one thermal cycle: its drift, by the paper's Direct Bound")
    columns, spec = Path("columns.toml"), Path("sensor.toml")
    write_whole(sitting.folder / columns, _COLUMNS)
    drifts = sitting.numbers(instability, recording, source=Recording(columns), axis=("y",), delta="60 s")
    (channel,) = drifts["channels"]
    walk, drift = channel["angle_random_walk_deg_per_sqrt_h"], channel["drift_std_deg_per_h"]
    lasting = channel["correlation_time_s"]
    sitting.say(f"axis y: {drift:.4g} deg/h with a correlation time of {lasting:.4g} s; random walk {walk:.4g} deg/√h")
    sitting.say("the recording states no units: times are assumed to be in µs, rates in rad/s")

    sitting.step("A spec of that sensor on the paper's rig; the maps are cubics without a prior")
    sitting.design(
        spec,
        _HEADLINE
        | {
            "title": "The recorded gyro on the paper's rig",
            "sensor.name": "recorded thermal cycle, axis y, read as rad/s",
            "sensor.gyro.angle_random_walk": f"{walk:.4g} deg/sqrt(h)",
            "sensor.gyro.drift": [{"standard_deviation": f"{drift:.4g} deg/h", "correlation_time": f"{lasting:.4g} s"}],
            "requirement[0].target": None,
            # Against so much drift many short moves are best; the same in every visit is quicker to search.
            "design.moves": 6,
            "design.cycles": "alike",
        },
        "The noise is that of the recording; everything except the [design] section is from the paper.",
    )
    before = sitting.numbers(predict, (spec,))
    row, hours = before["requirements"][0], time_text(before["duration_s"])
    sitting.say(f"a plan made by hand leaves {amount(row['mean_of_max'], row['unit'])} of {row['name']} in {hours}")

    sitting.step("A plan optimised for this gyro")
    optimisation, designed = sitting.optimise(spec)

    sitting.step("The page")
    page = sitting.numbers(report, (_RECIPE,), output=_REPORT, before=spec)
    return {
        "instability": drifts,
        "prediction": before,
        "recipe": designed,
        "optimisation": optimisation,
        "report": page,
    }


class _Stopped(Exception):
    """A step's command failed; `status` is its exit status."""

    def __init__(self, status: int) -> None:
        super().__init__(status)
        self.status = status


class _Sitting:
    """Calls commands in the folder and reports on them. `commands`: their command lines."""

    def __init__(self, folder: Path, *, quiet: bool) -> None:
        self.folder = folder.absolute()
        self.commands: list[str] = []
        self._quiet = quiet
        self._number = 0

    def step(self, title: str) -> None:
        """Begin a step."""
        self._number += 1
        self.say(strong(f"\n{self._number}. {title}"), indent="")

    def say(self, text: str, *, indent: str = "   ") -> None:
        """Print a line for people; none where JSON is asked for."""
        if not self._quiet:
            print(indent + text, flush=True)

    def optimise(self, spec: Path, steps: int = _STEPS) -> tuple[dict[str, Any], dict[str, Any]]:
        """Search a plan for a spec: the search's own record, and the requirement that the recipe was designed for."""
        from gradcal_jax.recipe.recipe import read_recipe

        record = self.numbers(optimise, spec, output=_RECIPE, steps=steps)
        plan = read_recipe(self.folder / _RECIPE)
        row = plan.prediction.requirements[0]
        self.say(f"{row.name}: {amount(row.decisive, row.unit)}; {record['structure']}")
        return record, {
            "file": str(_RECIPE),
            "fingerprint": plan.fingerprint,
            "name": row.name,
            "statistic": row.statistic,
            "predicted": row.decisive,
            "unit": row.unit,
        }

    def calibration(self, seed: int, devices: str, title: str) -> dict[str, Any]:
        """Run the recipe on simulated devices, make the log and estimate the calibration."""
        self.step(f"The run in virtual time, on simulated devices: chamber, {devices}")
        self.run(run, _RECIPE, simulate=True, seed=seed, output=_RUN)
        self.step("The log of the run, from the raw bytes")
        self.run(log, _RUN)
        self.step(title)
        return self.numbers(estimate, _LOG, recipe=_RECIPE, output=_CALIBRATION)

    def design(self, file: Path, changes: Mapping[str, object], header: str) -> None:
        """Write the paper's spec, changed, into the folder."""
        from gradcal_jax.spec import presets
        from gradcal_jax.spec.changes import changed
        from gradcal_jax.spec.spec import parse_spec
        from gradcal_jax.tables.writing import to_toml, write_whole

        spec = changed(parse_spec(presets.text("paper-dynamic-gradient")), changes)
        write_whole(self.folder / file, to_toml(spec, header=header))

    def agreement(self, page: dict[str, Any], digits: int) -> None:
        """Print how well the estimate agrees with the hidden truth."""
        if (agreement := page["agreement"]) is not None:
            chi, degrees, likely = agreement
            self.say(
                f"estimated minus true coefficients, all together: χ² = {chi:.{digits}g} with {degrees} degrees of "
                f"freedom, p = {likely:.2g}"
            )

    def run(self, command: Callable[..., int], *arguments: Any, **options: Any) -> str:
        """Call a command and return its output. Raises `_Stopped` where it failed."""
        line = shlex.join(["gradcal", command.__name__, *_words(arguments, options)])
        self.commands.append(line)
        self.say(f"$ {line}")
        output = io.StringIO()
        # In the folder, so that the names are as short as in a terminal there.
        with contextlib.chdir(self.folder), contextlib.redirect_stdout(output):
            status = command(*arguments, **options)
        if status not in (DONE, NOT_AS_WISHED):
            raise _Stopped(status)
        return output.getvalue()

    def numbers(self, command: Callable[..., int], *arguments: Any, **options: Any) -> Any:
        """Call a command with --json and return its numbers."""
        return json_format.loads(self.run(command, *arguments, **options, json=True))


def _words(arguments: tuple[Any, ...], options: Mapping[str, Any]) -> Iterator[str]:
    """A command's arguments and options as they are typed."""
    for argument in arguments:
        yield from map(str, argument) if isinstance(argument, tuple) else [str(argument)]
    for name, value in options.items():
        if isinstance(value, Recording):
            yield from ("--columns", str(value.columns))
        elif isinstance(value, tuple):
            yield from (word for each in value for word in (f"--{name}", each))
        else:
            yield "-o" if name == "output" else f"--{name}"
            yield from () if value is True else [str(value)]
