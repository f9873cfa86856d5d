"""Every feature of the program, for a spec of one gyro axis and for one of a whole IMU: the same command lines.

`FEATURES` is the table; test_features_of_plans.py and test_features_of_runs.py run it, and docs/reference/features.md
shows it: `python tests/cli/both_kinds.py > docs/reference/features.md`.
"""

from collections.abc import Iterator, Mapping
from dataclasses import dataclass, field

KINDS = ("axis", "IMU")


@dataclass(frozen=True)
class Feature:
    """A line of the table: `commands`, the same for both kinds; what the test looks at, in words; what it needs.

    `after`: features whose files it reads. `long`: kinds that take more than five seconds. `missing`: kinds
    without this feature, with the reason.
    """

    name: str
    commands: tuple[str, ...]
    shows: str
    after: tuple[str, ...] = ()
    long: tuple[str, ...] = ()
    missing: Mapping[str, str] = field(default_factory=dict[str, str])

    def cell(self, kind: str) -> str:
        """Of the table in the document."""
        if kind in self.missing:
            return f"no: {self.missing[kind]}"
        return "yes (long test)" if kind in self.long else "yes"


_AT = ' --temperature "18 degC"'
FORMATS = {"ardupilot": "", "px4": "", "c-header": "", "csv": "", "kalibr": _AT, "matrices": _AT}
_EXPORTS = (
    *(f"export run/calibration.toml --format {name}{more} -o {name}.txt" for name, more in FORMATS.items()),
    "new export-gains -o gains.j2",
    f"export run/calibration.toml --template gains.j2{_AT} -o gains.txt",
)
FEATURES = (
    # --- a plan before it is made
    Feature(
        "errors of a file",
        ("check wrong.toml",),
        "both errors of the file in one answer, each with its key and its line",
    ),
    Feature(
        "description of a plan", ("check spec.toml",), "terms, requirements, table, segments and moves of the plan"
    ),
    Feature(
        "timeline",
        ("check spec.toml --timeline readings --json",),
        "times of all readings, and the models of the sensors",
    ),
    Feature("prediction", ("predict spec.toml",), "a line for each requirement with its verdict"),
    Feature(
        "prediction as JSON",
        ("predict spec.toml --json",),
        "valid by the schema; the numbers of `gj.predict`; the covariance agrees with the standard deviations",
    ),
    Feature(
        "omitted terms",
        ("predict spec.toml --json", "predict strict.toml --json"),
        "the terms with their typical figures; they decide the verdict of a target that the named terms alone meet",
    ),
    Feature(
        "coverage, risk, chance",
        ("predict judged.toml --json",),
        "the rule of the verdict; the probabilities of errors within the target, and of wrong decisions",
    ),
    Feature(
        "error budget by source",
        ("predict spec.toml", "predict noisier.toml"),
        "angle random walk as the largest source, after it is thirty times as large",
    ),
    Feature(
        "sensitivity",
        ("predict spec.toml --sensitivity --json",),
        "the effect of more angle random walk, compared with a prediction for more of it",
        long=("IMU",),
    ),
    Feature("ranges of noise figures", ("predict uncertain.toml --json",), "a smallest and a largest residual"),
    Feature("lower limit of all plans", ("limit spec.toml --json",), "a limit below the residual of this plan"),
    Feature(
        "comparison of plans",
        ("predict spec.toml slower.toml --json",),
        "two predictions, the longer plan the better one",
    ),
    Feature(
        "Monte Carlo",
        ("predict spec.toml --monte-carlo 400 --json",),
        "residuals of simulated calibrations, within 15 % of the predicted ones",
    ),
    Feature(
        "plots",
        ("predict spec.toml --plot plan.png",),
        "a picture with more than a few colours",
        long=("IMU",),
    ),
    Feature(
        "hidden structure (discrepancy)",
        ("predict hidden.toml",),
        "a larger residual, limited by the discrepancy",
    ),
    Feature(
        "tests that notice structure",
        ("predict spec.toml --json",),
        "the size of structure that a test of the log detects",
    ),
    Feature(
        "scale-factor instability",
        ("predict unsteady.toml",),
        "a residual of the size of the instability, limited by it",
    ),
    Feature(
        "readings on the move",
        ("predict moving.toml --json", "check moving.toml --timeline readings --json"),
        "more readings than at rest, and a smaller residual of the bias",
    ),
    Feature(
        "missions and north",
        ("predict missions.toml --json",),
        "the heading at the end of a mission and north, each with the part of the sensor's own noise",
    ),
    Feature(
        "heating and cooling in one plan",
        ("predict both-ways.toml --json",),
        "residuals of the branches with a hysteresis, and the coefficient of its play",
    ),
    Feature(
        "standard method (held rates)",
        ("predict held.toml --json", "check held.toml"),
        "residuals of a plan of stable temperatures and held rates; of the IMU, of the gyro along the table's axis",
    ),
    Feature(
        "derivatives in Python",
        (),
        "`gj.differentiable`: the value of `predict` (of the IMU within 2 %); a derivative, compared with differences",
        long=("IMU",),
    ),
    # --- better plans
    Feature(
        "optimisation up to the targets",
        ("optimise better.toml --until-met --steps 40 -o met.toml --json",),
        "a plan that meets a target that the plan in the file misses; the prediction agrees",
        long=("IMU",),
    ),
    Feature(
        "optimisation",
        ("optimise spec.toml --steps 20 -o optimum.toml --json",),
        "a smaller residual; the prediction of the recipe agrees",
        long=KINDS,
    ),
    Feature(
        "optimisation for a mission",
        ("optimise missions.toml --steps 20 -o heading.toml --json",),
        "a smaller heading error",
        long=KINDS,
    ),
    Feature(
        "optimisation of a plan that notices structure",
        ("optimise seeing.toml --steps 20 -o seen.toml --json",),
        "a smaller residual, and a test of the log that detects the structure",
        long=KINDS,
    ),
    Feature(
        "shortest plan",
        ("optimise shortest.toml --steps 20 -o shortest-recipe.toml --json",),
        "a shorter plan that meets every target",
        long=KINDS,
    ),
    Feature(
        "residual against duration",
        ("optimise spec.toml --steps 20 --motion 4min,6min -o frontier --json",),
        "a smaller residual in a longer time; a recipe for each duration",
        long=KINDS,
    ),
    Feature(
        "sweep of predictions",
        ("sweep sweep.toml -o sweep.nc --workers 1 --json",),
        "a grid of a key and of whole sensors from files; its values are those of `predict`",
    ),
    Feature(
        "sweep of optimised plans",
        ("sweep designs.toml -o designs.nc --recipes designs --workers 1 --json",),
        "a recipe for each point, better than its first plan",
        long=KINDS,
    ),
    # --- a run and its calibration
    Feature(
        "recipe",
        ("optimise spec.toml --steps 0 -o recipe.toml", "check recipe.toml"),
        "a table of the chamber's steps and of the moves; the prediction of the recipe",
    ),
    Feature(
        "simulated run",
        ("run recipe.toml --simulate --seed 1 --json -o run", "rig watch run --once --json"),
        "a complete run that ends in a safe state; its hidden truth",
        after=("recipe",),
    ),
    Feature(
        "log of a run", ("log run --json",), "a log of all channels, marked as simulated", after=("simulated run",)
    ),
    Feature(
        "estimate",
        ("estimate run/log.nc --recipe recipe.toml -o run/calibration.toml --plot fit.png --json",),
        "the hidden truth, within the uncertainty; tests of the fit; a picture",
        after=("log of a run",),
    ),
    Feature(
        "result of each requirement",
        ("predict recipe.toml --json",),
        "the achieved residual of each requirement, within 25 % of the predicted one",
        after=("estimate",),
    ),
    Feature(
        "validation by a second run",
        (
            "optimise slower.toml --steps 0 -o second-recipe.toml",
            "run second-recipe.toml --simulate --seed 1 --json -o second",
            "log second",
            "validate run/calibration.toml second/log.nc --json",
        ),
        "the errors of another run of the same sensor are more than ten times smaller with the calibration",
        after=("estimate",),
        long=("IMU",),
    ),
    Feature(
        "correction of a log",
        ("apply run/calibration.toml run/log.nc -o corrected.nc --json",),
        "rates at rest whose scatter over temperature is more than ten times smaller",
        after=("estimate",),
    ),
    Feature(
        "import of a recording",
        (
            "log run --recording own.csv --columns columns.toml -o recorded.nc",
            "estimate recorded.nc --recipe recipe.toml -o recorded.toml",
        ),
        "a table of the sensor's own logger, aligned with the run: the calibration of the run's own log",
        after=("estimate",),
    ),
    Feature(
        "export, every format",
        _EXPORTS,
        "the bias or the scale factor of the calibration in each of six formats and in a template",
        after=("estimate",),
    ),
    Feature(
        "page",
        ("report recipe.toml -o plan.html --json", "report run -o page.html --json"),
        "the page of the plan and that of the calibration, with its numbers",
        after=("estimate",),
        long=("IMU",),
    ),
    Feature(
        "certificate and DCC",
        ("report run --certificate --rig rig.toml --number 7 --dcc certificate.xml -o certificate.html",),
        "a certificate that says that it is simulated; well-formed XML with the serial number",
        after=("estimate",),
    ),
    Feature(
        "several in one run, and a lot",
        (
            "run recipe.toml --simulate --seed 3 --units 3 --json -o several",
            "log several",
            *(f"estimate several/log-unit{k}.nc --recipe recipe.toml -o several/unit{k}.toml" for k in (1, 2, 3)),
            "lot several/unit1.toml several/unit2.toml several/unit3.toml --json",
        ),
        "a calibration of each; mean and spread of every map",
        after=("recipe",),
        long=KINDS,
    ),
    Feature(
        "stopped run, continued by a new plan",
        (
            "rig watch stopped --known --json",
            "optimise stopped --quick -o rest.toml --json",
            "predict rest.toml --json",
            "run rest.toml --resume stopped --json",
            "log stopped",
            "estimate stopped/log.nc --recipe rest.toml -o stopped/calibration.toml --json",
        ),
        "`[[done]]` in the new plan; a prediction that counts both parts; one log of both parts; the hidden truth",
        after=("recipe",),
        long=KINDS,
    ),
    # --- noise
    Feature(
        "Direct Bound",
        ("instability rest.nc --json",),
        "standard deviation and correlation time of a bound of the drift, for every gyro",
    ),
    Feature(
        "Allan deviation",
        (
            "allan rest.nc --json --plot allan.png",
            "allan rest.nc --format kalibr -o noise.yaml",
            "allan rest.nc --format ins -o noise.txt",
        ),
        "the white noise of every gyro and accelerometer of the record; a picture",
        long=("IMU",),
    ),
    # --- begin
    Feature(
        "first files",
        ("start --preset PRESET -o mine", "check --files-only mine/spec.toml", "predict mine/spec.toml --json"),
        "a spec, a rig file and a column map; a prediction of the spec",
    ),
    Feature(
        "specs of earlier versions",
        ("check --upgrade old.toml -o new.toml",),
        "the same spec in the current format",
        missing={"IMU": "the keys of its spec have not changed, so there is nothing to convert"},
    ),
    Feature(
        "calibrations of earlier versions",
        ("check --upgrade old-calibration.toml -o new-calibration.toml", "export new-calibration.toml --format csv"),
        "the same calibration in the current format",
    ),
)


def page() -> str:
    """docs/reference/features.md."""
    return "\n".join(_page()) + "\n"


def _page() -> Iterator[str]:
    yield "# Features of a gyro axis and of an IMU"
    yield ""
    yield "One program serves both: a spec of one gyro axis is a spec of an IMU with one gyro. For each feature, this"
    yield "page lists the commands and what a test checks: once for one gyro on a table of one axis, and once for three"
    yield "gyros and three accelerometers on a table of two axes. The commands are the same for both. All runs are"
    yield "simulated. The tests are `tests/cli/test_features_of_plans.py` and `tests/cli/test_features_of_runs.py`;"
    yield "`python tests/cli/both_kinds.py` makes this page."
    yield ""
    yield "| feature | commands | gyro axis | IMU | the test checks |"
    yield "|---|---|---|---|---|"
    for feature in FEATURES:
        commands = "<br>".join(f"`gradcal {line}`" for line in feature.commands) or "–"
        cells = (feature.name, commands, *(feature.cell(kind) for kind in KINDS), feature.shows)
        yield f"| {' | '.join(cells)} |"


if __name__ == "__main__":
    print(page(), end="")
