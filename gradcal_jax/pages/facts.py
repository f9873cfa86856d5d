"""Every number of a page, once: from the recipe, the run and the calibration, by the functions that commands use."""

import re
from typing import Any, Final, NamedTuple, cast

import numpy as np

from gradcal_jax import assemble
from gradcal_jax.assemble.achieved import Box, Term, found_map, grid_of, prior_map, standard_terms
from gradcal_jax.assemble.knowledge import PPM
from gradcal_jax.files import Spec, correction, exports
from gradcal_jax.files.calibration import AxisCalibration, Calibration, Result
from gradcal_jax.files.contracts import RequirementRow
from gradcal_jax.files.recipe import Recipe
from gradcal_jax.files.requirement import Requirement
from gradcal_jax.information import statistic
from gradcal_jax.information.residual import Statistic
from gradcal_jax.pages.coefficients import ParameterFact, agreement, parameters
from gradcal_jax.pages.course import Course, course_of
from gradcal_jax.pages.sources import Sources

# Of a residual: what shows in the digits of a page.
_SEEN: Final = 1e-3


class RequirementFact(NamedTuple):
    """A requirement before, as predicted, as achieved (1σ, in `unit`); None: not observable, or not there to tell.

    `verdict`: of what was achieved, otherwise of what is predicted; `limit`: proven for any plan.
    """

    name: str
    axis: str
    quantity: str
    statistic: str
    unit: str
    temperature_c: tuple[float, float] | None
    rate_dps: tuple[float, float] | None
    before: float | None
    predicted: float | None
    achieved: float | None
    target: float | None
    verdict: str | None
    limited_by: str | None
    limit: float | None


class AxisFact(NamedTuple):
    """What was found of one axis. `agreement`: χ² of found against hidden truth, its degrees, its chance."""

    axis: str
    terms: tuple[Term, ...]
    valid_temperature: tuple[str, str]
    valid_rate: tuple[str, str]
    unobservable: tuple[str, ...]
    agreement: tuple[float, int, float] | None


class ExampleFact(NamedTuple):
    """What a calibration makes of one reading: rates in deg/s."""

    axis: str
    temperature_c: float
    measured_dps: float
    bias_dps: float
    scale_factor_ppm: float
    corrected_dps: float


class ExportFact(NamedTuple):
    """A program that takes the calibration, and what it cannot carry."""

    target: str
    command: str
    losses: tuple[str, ...]


class MapFact(NamedTuple):
    """Residual maps of one requirement and axis, in order: before, predicted, achieved, as far as they are known."""

    name: str
    axis: str
    quantity: str
    maps: tuple[tuple[str, Box], ...]


class Facts(NamedTuple):
    """A whole page's numbers. `before_is`: what "before" means here; empty without it."""

    title: str
    simulated: bool
    before_is: str
    requirements: tuple[RequirementFact, ...]
    parameters: tuple[ParameterFact, ...]
    axes: tuple[AxisFact, ...]
    examples: tuple[ExampleFact, ...]
    exports: tuple[ExportFact, ...]
    assumed: tuple[tuple[str, str], ...]
    course: Course | None
    provenance: tuple[tuple[str, str], ...]
    notes: tuple[str, ...]
    maps: tuple[MapFact, ...]

    @property
    def verdict(self) -> str:
        """ "met", "missed" or "unobservable" of all requirements together; empty where none has a target."""
        found = {row.verdict for row in self.requirements}
        for word in ("unobservable", "missed", "met"):
            if word in found:
                return word
        return ""


def facts_of(sources: Sources) -> Facts:
    """Work out everything that a page says. Raises `ValueError` for a run that never began."""
    recipe, calibration = sources.recipe, sources.calibration
    course = None if sources.run is None else course_of(sources.run)
    before_is, requirements, maps = _requirements(sources)
    axes = () if calibration is None else tuple(_axis(axis, sources.hidden_truth) for axis in calibration.axis)
    notes = [*sources.notes]
    if recipe is not None:
        notes += [*recipe.notes, *recipe.prediction.warnings]
    notes += [
        f"axis {axis.axis}: the data say nothing of {', '.join(axis.unobservable)}"
        for axis in axes
        if axis.unobservable
    ]
    notes += _hidden_by_structure(requirements, maps)
    simulated = bool(course is not None and course.simulated) or bool(calibration is not None and calibration.simulated)
    title = (recipe.title if recipe is not None else None) or (calibration.title if calibration is not None else None)
    return Facts(
        title=title or "Calibration",
        simulated=simulated,
        before_is=before_is,
        requirements=tuple(requirements),
        parameters=tuple(parameters(recipe, calibration, sources.hidden_truth)),
        axes=axes,
        examples=() if calibration is None else tuple(_example(axis) for axis in calibration.axis),
        exports=() if calibration is None else tuple(_exports(calibration, sources.calibration_name)),
        assumed=tuple(_assumed(recipe, calibration)),
        course=course,
        provenance=tuple(_provenance(sources)),
        notes=tuple(dict.fromkeys(notes)),
        maps=tuple(maps),
    )


def as_tables(facts: Facts) -> dict[str, Any]:
    """The facts as plain numbers and texts for other programs; maps and tracks are left out."""
    course = facts.course
    done = None
    if course is not None:
        done = {
            name: value
            for name, value in course._asdict().items()
            if name not in ("chamber_s", "chamber_c", "angles", "waited", "devices")
        }
        done["waited"] = [row._asdict() for row in course.waited]
        done["devices"] = [row._asdict() for row in course.devices]
    return {
        "title": facts.title,
        "simulated": facts.simulated,
        "verdict": facts.verdict or None,
        "before_is": facts.before_is or None,
        "requirements": [row._asdict() for row in facts.requirements],
        "parameters": [row._asdict() for row in facts.parameters],
        "axes": [row._asdict() | {"terms": [term._asdict() for term in row.terms]} for row in facts.axes],
        "examples": [row._asdict() for row in facts.examples],
        "exports": [row._asdict() for row in facts.exports],
        "assumed": dict(facts.assumed),
        "run": done,
        "provenance": dict(facts.provenance),
        "notes": list(facts.notes),
    }


# ------------------------------------------------------------------------------------------------------- requirements


def _requirements(sources: Sources) -> tuple[str, list[RequirementFact], list[MapFact]]:
    recipe, calibration = sources.recipe, sources.calibration
    if recipe is None:
        assert calibration is not None
        maps = [_found_alone(axis, quantity) for axis in calibration.axis for quantity in _quantities(axis)]
        return "", [_result_alone(row) for row in calibration.result], maps
    built = assemble.assemble(recipe.spec)
    known = {channel: assemble.knowledge(built, channel) for channel in built.channels}
    other = _other_plan(sources.before)
    rows: list[RequirementFact] = []
    maps: list[MapFact] = []
    before_is = ""
    for row in recipe.prediction.requirements:
        requirement = next(r for r in recipe.spec.requirement if r.name == row.name)
        drawn: list[tuple[str, Box]] = []
        earlier = _before(other, recipe.spec, requirement, row.axis)
        if earlier is not None:
            before_is = "what the spec's priors say, without a calibration"
            if other is not None:
                before_is = f"the plan of {sources.before_name}, on the rig of that file"
            drawn.append(("before", earlier))
        values = assemble.residual_map(built, known[row.axis], requirement)
        drawn.append(("predicted", Box(*values, row.unit)))
        axis = _axis_of(calibration, row.axis)
        if axis is not None and requirement.quantity in _quantities(axis):
            _, deviation = found_map(axis, requirement.quantity, *grid_of(axis, requirement, requirement.quantity))
            drawn.append(("achieved", deviation))
        maps.append(MapFact(row.name, row.axis, row.quantity, tuple(drawn)))
        rows.append(_requirement(row, requirement, calibration, earlier, sources.limits))
    if not before_is and (given := _optimised_before(recipe)):
        before_is = "the plan that the optimisation began with"
        rows = [row._replace(before=given.get(row.name)) for row in rows]
    return before_is, rows, maps


def _hidden_by_structure(requirements: list[RequirementFact], maps: list[MapFact]) -> list[str]:
    """A calibration file has the covariance of its coefficients; what their structure may hide is in results alone."""
    names: list[str] = []
    for row, fact in zip(requirements, maps, strict=False):
        drawn = dict(fact.maps).get("achieved")
        if drawn is None or row.achieved is None or row.temperature_c is None:
            continue
        shown = statistic(cast("Statistic", row.statistic), drawn.values)
        if abs(shown - row.achieved) > _SEEN * row.achieved:
            names.append(f"{row.name} ({shown:.4g} {row.unit} in the map, {row.achieved:.4g} {row.unit} in the table)")
    if not names:
        return []
    return [
        "the achieved maps leave out what the results count besides the coefficients' covariance, such as a model "
        f"discrepancy: {', '.join(names)}"
    ]


def _requirement(
    row: RequirementRow,
    requirement: Requirement,
    calibration: Calibration | None,
    before: Box | None,
    limits: dict[str, float],
) -> RequirementFact:
    result = _result_of(calibration, row)
    return RequirementFact(
        row.name,
        row.axis,
        row.quantity,
        row.statistic,
        row.unit,
        row.temperature_c,
        row.rate_dps,
        None if before is None else _finite(statistic(requirement.statistic, before.values)),
        row.decisive,
        None if result is None else result.value,
        row.target,
        row.verdict if result is None else result.verdict,
        row.limited_by,
        limits.get(row.name),
    )


def _other_plan(spec: Spec | None):
    if spec is None:
        return None
    built = assemble.assemble(spec)
    return built, {channel: assemble.knowledge(built, channel) for channel in built.channels}


def _before(other, spec: Spec, requirement: Requirement, channel: str) -> Box | None:
    """The residual of another plan, or of none where the spec has priors, on the same box."""
    if other is None:
        return prior_map(spec, requirement)
    built, known = other
    section = built.spec.sensor.bias if requirement.quantity == "bias" else built.spec.sensor.scale_factor
    if channel not in known or section is None:
        return None
    return Box(*assemble.residual_map(built, known[channel], requirement), _unit(requirement.quantity))


def _optimised_before(recipe: Recipe) -> dict[str, float]:
    record = recipe.optimisation or {}
    objective, value = str(record.get("objective", "")), record.get("before")
    name = re.sub(r" \([^)]*\)$", "", objective)
    return {name: float(value)} if isinstance(value, float | int) and name else {}


def _result_of(calibration: Calibration | None, row: RequirementRow) -> Result | None:
    results = () if calibration is None else calibration.result
    return next((r for r in results if (r.name, r.axis, r.quantity) == (row.name, row.axis, row.quantity)), None)


def _result_alone(row: Result) -> RequirementFact:
    words = row.statistic.removesuffix(", 1 sigma")
    found = (None, None, None, None, row.value, row.target, row.verdict, None, None)
    return RequirementFact(row.name, row.axis, row.quantity, words, row.unit, *found)


def _found_alone(axis: AxisCalibration, quantity: str) -> MapFact:
    _, deviation = found_map(axis, quantity, *grid_of(axis, None, quantity))
    return MapFact("all that the data cover", axis.name, quantity, (("achieved", deviation),))


def _axis_of(calibration: Calibration | None, name: str) -> AxisCalibration | None:
    axes = () if calibration is None else calibration.axis
    return next((axis for axis in axes if axis.name == name), None)


def _quantities(axis: AxisCalibration) -> list[str]:
    return [name for name, part in (("scale_factor", axis.scale_factor), ("bias", axis.bias)) if part is not None]


def _unit(quantity: str) -> str:
    return "ppm" if quantity == "scale_factor" else "deg/h"


def _axis(axis: AxisCalibration, truth: dict[str, Any] | None) -> AxisFact:
    return AxisFact(
        axis.name,
        tuple(standard_terms(axis)),
        (str(axis.valid_temperature[0]), str(axis.valid_temperature[1])),
        (str(axis.valid_rate[0]), str(axis.valid_rate[1])),
        axis.unobservable,
        agreement(axis, (truth or {}).get(axis.name)),
    )


# -------------------------------------------------------------------------------------------- use, noise and provenance


def _example(axis: AxisCalibration) -> ExampleFact:
    """A reading at a third of the largest rate, at room temperature where that is covered."""
    cold, warm = (float(end) for end in axis.valid_temperature)
    at = 25.0 if cold <= 25.0 <= warm else 0.5 * (cold + warm)
    said_dps = float(f"{np.degrees(max(abs(float(end)) for end in axis.valid_rate)) / 3.0:.1g}")
    temperature, said = np.array([at]), np.array([np.radians(said_dps)])
    true = correction.correct(axis, said, temperature)
    return ExampleFact(
        axis.name,
        at,
        said_dps,
        float(np.degrees(correction.bias(axis, temperature)[0])),
        float(correction.scale_factor(axis, temperature, true)[0]) * PPM,
        float(np.degrees(true[0])),
    )


def _exports(calibration: Calibration, name: str) -> list[ExportFact]:
    endings = {"ardupilot": "parm", "px4": "params", "kalibr": "yaml", "c-header": "h", "csv": "csv"}
    found: list[ExportFact] = []
    for target in exports.FORMATS:
        warm = _example(calibration.axis[0]).temperature_c
        option = f' --temperature "{warm:g} degC"' if target == "kalibr" else ""
        command = f"gradcal export {name} --format {target}{option} -o calibration.{endings.get(target, 'txt')}"
        try:
            done = exports.export(calibration, target, temperature_c=warm if option else None)
        except ValueError as error:
            found.append(ExportFact(target, "", (f"not for this calibration: {error}",)))
            continue
        losses = tuple(f"axis {x.axis}: {x.what}, up to {x.value:.4g} {x.unit}" for x in done.losses if x.value > 0.0)
        found.append(ExportFact(target, command, losses))
    return found


def _assumed(recipe: Recipe | None, calibration: Calibration | None) -> list[tuple[str, str]]:
    """The noise figures that numbers rest on: the spec's, or those that the calibration keeps."""
    rows: list[tuple[str, str]] = []
    if recipe is not None:
        sensor, angle = recipe.spec.sensor, recipe.spec.rig.table.angle
        rows.append(("angle random walk", str(sensor.angle_random_walk)))
        for drift in sensor.drift:
            rows.append(("bias instability", f"{drift.standard_deviation}, correlation time {drift.correlation_time}"))
        for wander in sensor.scale_factor_instability:
            words = f"{wander.standard_deviation}, correlation time {wander.correlation_time}"
            rows.append(("scale-factor instability", words))
        given = (
            ("rate random walk", sensor.rate_random_walk),
            ("turn-on bias", sensor.turn_on_bias),
            ("sample clock error", sensor.sample_clock_error),
            ("thermal lag", sensor.thermal_lag),
            ("reading noise", angle.reading_noise or None),
            ("standstill offset", angle.standstill_offset or None),
            ("timing error", angle.timing_error or None),
        )
        return rows + [(name, str(value)) for name, value in given if value is not None]
    if calibration is not None and calibration.noise is not None:
        rows.append(("angle random walk", str(calibration.noise.angle_random_walk)))
        if calibration.noise.rate_random_walk is not None:
            rows.append(("rate random walk", str(calibration.noise.rate_random_walk)))
    return rows


def _provenance(sources: Sources) -> list[tuple[str, str]]:
    rows: list[tuple[str, str]] = []
    recipe, calibration, run = sources.recipe, sources.calibration, sources.run
    if recipe is not None:
        rows += [
            ("recipe", recipe.fingerprint),
            ("recipe made by", recipe.made.by),
            ("versions", ", ".join(f"{name} {number}" for name, number in recipe.made.versions.items())),
            ("plan", recipe.status),
        ]
        if recipe.made.seed is not None:
            rows.append(("seed of the optimisation", str(recipe.made.seed)))
    if run is not None:
        notes = run.notes()
        rows += [
            ("run", run.path.name),
            ("run begun", str(notes.get("begun", ""))),
            ("run by", f"gradcal {notes['version']}"),
        ]
        if notes.get("simulated"):
            rows.append(("seed of the simulation", str(notes["simulation"]["seed"])))
    if calibration is not None:
        rows += [("unit", calibration.serial_number), ("frame", calibration.frame), ("order", calibration.order)]
        names = {
            "program": "estimated by",
            "estimator": "estimator",
            "readings": "readings",
            "log": "log",
            "spec": "model",
        }
        rows += [(words, calibration.provenance[key]) for key, words in names.items() if key in calibration.provenance]
    rows += [(f"SHA-256 of {name}", digest) for name, digest in sources.paths]
    return rows


def _finite(value: float) -> float | None:
    return float(value) if np.isfinite(value) else None
