"""From a spec or recipe to a calibration through the command line: recipe, simulated run, log, estimate; and what the
run's hidden truth says of it."""

import contextlib
import io
import itertools
import json
import shutil
import tomllib
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
from matrix_errors import ByData, by_data, deviations_of_elements, nees_of
from scipy.stats import chi2

import gradcal_jax as gj
from gradcal_jax.cli import main
from gradcal_jax.estimation.estimate import with_options
from gradcal_jax.estimation.fit_of_log import fit_readings
from gradcal_jax.estimation.log_rows import Options, imu_rows
from gradcal_jax.model.build import build_imu

# Of the simulated chamber's air behind its set point; and the ends of the pieces in which it approaches, in lags.
AIR_LAG_S = 40.0
_PIECES = np.array([0.25, 0.5, 0.75, 1.0, 1.25, 1.5, 2.0, 2.5, 3.0, 4.0, 5.0, 7.0, 10.0])


@dataclass(frozen=True)
class Chain:
    """Of one seed. `nees` of `degrees`: the calibration's errors in the file's covariance, of an IMU those that its
    model's own difference between truth and estimate amounts to; `squares`: of an IMU, the same by its log alone, in
    the place of the covariance; `elements`: in the covariance, of misalignments times scale factors; `fit`: χ² of the
    data and its degrees; `ratios`: of each requirement (by name), achieved over predicted; `sigmas`: of each
    parameter (of a misalignment times its sensor's scale factor), likewise, without what the estimate widens."""

    nees: float
    degrees: int
    squares: float | None
    elements: float
    fit: tuple[float, int]
    ratios: dict[str, float]
    sigmas: dict[str, float]
    printed: str = field(repr=False)


def widened(fit: tuple[float, int]) -> float:
    """By how much an estimate widens its results: for data that the model explains with a chance below 1 %."""
    statistic, degrees = fit
    return float(np.sqrt(statistic / degrees)) if chi2.sf(statistic, degrees) < 0.01 else 1.0


def say(*words: object) -> tuple[int, str]:
    """A command line in this process: exit status, and all that was printed."""
    heard = io.StringIO()
    with contextlib.redirect_stdout(heard), contextlib.redirect_stderr(heard):
        status = main([str(word) for word in words])
    return status, heard.getvalue()


def done(*words: object) -> str:
    """What a command prints that works, whether or not a target is met."""
    status, printed = say(*words)
    assert status in (0, 1), printed
    return printed


def recipe_of(path: Path, folder: Path) -> Path:
    """The recipe of a spec; a recipe is its own."""
    if tomllib.loads(path.read_text(encoding="utf-8"))["format"].startswith("gradcal-recipe"):
        return path
    done("optimise", path, "--steps", "0", "-o", folder / "recipe.toml", "--force")
    return folder / "recipe.toml"


def estimated(recipe: Path, run: Path, seed: int) -> tuple[dict[str, Any], list[Path], str]:
    """A simulated run of a recipe, its logs, and the calibration by the recipe, and what the estimate printed."""
    for words in (("run", recipe, "--simulate", "--seed", seed, "--json", "-o", run), ("log", run)):
        status, printed = say(*words)
        assert status == 0, printed
    logs = sorted(run.glob("*.nc"))
    printed = done("estimate", *logs, "--recipe", recipe, "-o", run / "calibration.toml")
    return tomllib.loads((run / "calibration.toml").read_text(encoding="utf-8")), logs, printed


def predicted_of(recipe: Path, folder: Path) -> dict[str, Any]:
    """`gradcal predict --json` of a recipe in a chamber whose air is as late as the simulated one's."""
    spec = gj.read_recipe(recipe).spec
    if spec.rig.chamber.control != "none" and hasattr(spec.schedule, "segments"):  # the standard method waits
        recipe = folder / "lagging.toml"
        gj.write_toml(_lagging(spec), recipe)
    return json.loads(done("predict", recipe, "--json"))


def _lagging(spec: gj.Spec) -> gj.Spec:
    """The programme is the course of the air: pieces of ramps, in the place of the set point's.

    At the end of a short or steep ramp that is some per cent of its temperatures; and two lags in series bend the
    beginning of a ramp otherwise than one does, which is all that tells dB/dT from a bias.
    """
    segments = spec.gradient_schedule.segments
    air = segments[0].temperature_start
    here = round(air, 6)
    programme: list[dict[str, Any]] = [{"soak": "1 s", "at": f"{here:.6f} degC", "used": False}]
    for segment in segments:
        slope = (segment.temperature_end - segment.temperature_start) / segment.duration
        # Of the air behind the set point: it goes to slope · lag, by the air's time constant.
        begins, ends = segment.temperature_start - air, slope * AIR_LAG_S
        times = [t for t in _PIECES * AIR_LAG_S if t < 0.999 * segment.duration]
        for since, until in itertools.pairwise([0.0, *times, segment.duration]):
            behind = ends + (begins - ends) * np.exp(-until / AIR_LAG_S)
            air = segment.temperature_start + slope * until - behind
            goal, lasts = round(float(air), 6), float(until - since)
            piece: dict[str, Any] = {"soak": f"{lasts!r} s", "used": segment.used}
            if abs(goal - here) >= 1e-4:
                rate = f"{abs(goal - here) / lasts * 60.0!r} K/min"
                piece = {"ramp_to": f"{goal:.6f} degC", "rate": rate, "used": segment.used}
                here = goal
            programme.append(piece)
    instead = {f"plan.{key}": None for key in ("temperature", "gradient", "soak")}
    return gj.changed(spec, instead | {"plan.programme": programme})


def chain(recipe: Path, predicted: dict[str, Any], folder: Path, seed: int) -> Chain:
    """A simulated run of the recipe, its log, and the estimate by the recipe."""
    run = folder / f"run{seed}"
    made, logs, printed = estimated(recipe, run, seed)
    (hidden,) = json.loads((run / "hidden_truth.json").read_text(encoding="utf-8"))["units"].values()
    values = {
        f"{channel['kind']}_{channel['axis']}.{name}": value
        for channel in made["channel"]
        for term in channel["term"]
        for name, value in term["coefficients"].items()
    }
    all_names = made["covariance"]["names"]
    names = [name for name in all_names if name in hidden and name in values]
    where = [all_names.index(name) for name in names]
    matrix = np.array(made["covariance"]["matrix"])[np.ix_(where, where)]
    found, true = (np.array([of[name] for name in names]) for of in (values, hidden))
    elements = nees_of(names, found, true, matrix)
    of_imu = _by_data(recipe, logs, hidden, names, matrix)
    nees, squares = (elements, None) if of_imu is None else (of_imu.nees, of_imu.squares)
    fit = (float(made["fit"][0]["statistic"]), int(made["fit"][0]["degrees"]))
    before = {row["name"]: row["std"] for row in predicted["parameters"]}
    scale = deviations_of_elements(names, found, matrix)
    sigmas = {name: s / before[name] for name, s in zip(names, scale, strict=True) if before.get(name)}
    asked = {row["name"]: row for row in predicted["requirements"]}
    ratios = {row["name"]: _ratio(row, asked[row["name"]]) for row in made.get("result", []) if "value" in row}
    shutil.rmtree(run)
    return Chain(nees, len(names), squares, elements, fit, ratios, sigmas, printed)


def _by_data(
    recipe: Path, logs: list[Path], hidden: dict[str, float], names: list[str], covariance: np.ndarray
) -> ByData | None:
    """Of an IMU; None: one sensor, whose model is linear."""
    spec, read = gj.read_recipe(recipe).spec, [gj.read_log(path) for path in logs]
    spec, options, _ = with_options(spec, read, Options())
    built = build_imu(spec)
    if len(built.model.channels) == 1:
        return None
    rows, _ = imu_rows(built, read, read[0].units[0], options)
    assert set(names) <= set(built.model.names())
    fit = fit_readings(built, read[0].units[0], rows, rows.temperature_c)
    return by_data(fit, hidden, names, covariance)


def _ratio(achieved: dict[str, Any], predicted: dict[str, Any]) -> float:
    key = achieved["statistic"].split(",")[0].replace(" ", "_")
    # The prediction's statistics are of the terms that the spec names.
    return float(achieved.get("named", achieved["value"]) / predicted.get("value", predicted.get(key)))
