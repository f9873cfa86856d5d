"""The requirements of a page: before, as predicted, as achieved, and the residual maps behind the numbers."""

import re
from typing import Any, Final, NamedTuple, cast

from gradcal_jax import api
from gradcal_jax.api.contract_rows import finite
from gradcal_jax.api.ieee_terms import Box, calibration_map, grid_of, prior_map
from gradcal_jax.api.missions import ErrorCurve, error_curves
from gradcal_jax.api.posterior_of_plan import UNIT_OF, run_of, statistic_of
from gradcal_jax.api.prediction import counted_posteriors
from gradcal_jax.api.systematic import CountedPosteriors
from gradcal_jax.files import Spec
from gradcal_jax.files.calibration import Calibration, Result
from gradcal_jax.files.contracts import RequirementRow
from gradcal_jax.files.moves import Axis
from gradcal_jax.files.requirement import HeadingRequirement, Requirement
from gradcal_jax.information import Posterior, statistic
from gradcal_jax.information.residual import Statistic
from gradcal_jax.pages.sources import Sources

SUMMED: Final = {"worst": "worst axis", "all": "all axes together"}
# Relative difference of residuals that shows in the digits of a page.
_SEEN: Final = 1e-3


class RequirementFact(NamedTuple):
    """A requirement's residual before, predicted and achieved (1σ, in `unit`); None: not observable, or not known.

    Both count what the spec omits and, in any run, the turn-on bias; `named`: the last one by the terms that the spec
    names alone, where it is another. `verdict`: of the achieved residual, else of the predicted one; `limit`: proven
    for any plan; `coverage`: number of standard deviations that must be within the target.
    """

    name: str
    axis: str
    quantity: str
    statistic: str
    unit: str
    temperature_c: tuple[float, float] | None = None
    rate_dps: tuple[float, float] | None = None
    before: float | None = None
    predicted: float | None = None
    achieved: float | None = None
    named: float | None = None
    target: float | None = None
    verdict: str | None = None
    limited_by: str | None = None
    limit: float | None = None
    own: float | None = None
    coverage: float = 1.0


def fact_of(row: RequirementRow, result: Result | None, **more: Any) -> RequirementFact:
    """A requirement as predicted, and as achieved where there is a result. `more`: further fields."""
    fields: dict[str, Any] = {"statistic": row.statistic, "predicted": row.judged, "verdict": row.verdict}
    fields["named"] = None if row.judged == row.decisive else row.decisive
    if result is not None:
        fields |= {"achieved": result.value, "verdict": result.verdict, "named": result.named}
    same = ("name", "axis", "quantity", "unit", "temperature_c", "rate_dps", "target", "limited_by")
    return RequirementFact(**{name: getattr(row, name) for name in same}, **(fields | more))


class MapFact(NamedTuple):
    """Residual maps of one requirement and axis, in the order before, predicted, achieved, as far as they are known;
    for missions the curves of their error."""

    name: str
    axis: str
    quantity: str
    maps: tuple[tuple[str, Box], ...]
    curves: tuple[tuple[str, ErrorCurve], ...] = ()


def _by_requirement(calibration: Calibration) -> dict[tuple[str, str, str], Result]:
    return {(r.name, r.axis, _of_map(r.quantity)): r for r in reversed(calibration.result)}


def _of_map(quantity: str) -> str:
    """The quantity of a gyro's requirement without its kind of channel, which that of an axis does not name."""
    return quantity.removeprefix("gyro_")


def requirements_of(sources: Sources) -> tuple[str, list[RequirementFact], list[MapFact]]:
    """The meaning of "before", every requirement, and its maps."""
    recipe, calibration = sources.recipe, sources.calibration
    if recipe is None:
        assert calibration is not None
        maps = [
            MapFact("all that the data cover", channel.axis, name, (("achieved", deviation),))
            for channel in calibration.channel
            if channel.kind == "gyro"
            for name in ("scale_factor", "bias")
            if channel.term_of(name) is not None
            for _, deviation in (calibration_map(calibration, channel, name, *grid_of(channel, None, name)),)
        ]
        return "", [result_alone(row) for row in calibration.result], maps
    built, known, counted = _plan(recipe.axis_spec)
    other = None if sources.before is None else _plan(sources.before)
    results = {} if calibration is None else _by_requirement(calibration)
    rows: list[RequirementFact] = []
    maps: list[MapFact] = []
    before_is = ""
    for row in recipe.prediction.requirements:
        requirement = next(r for r in recipe.axis_spec.requirement if r.name == row.name)
        drawn: list[tuple[str, Box]] = []
        earlier = _before(other, recipe.axis_spec, requirement, row.axis)
        before = None if earlier is None else finite(statistic_of(requirement, earlier.values))
        more = {"before": before, "limit": sources.limits.get(row.name), "own": row.own, "coverage": row.coverage}
        rows.append(fact_of(row, results.get((row.name, row.axis, _of_map(row.quantity))), **more))
        if earlier is not None:
            before_is = "the spec's priors, without a calibration"
            if other is not None:
                before_is = f"the plan of {sources.before_name}, on the rig of that file"
            drawn.append(("before", earlier))
        if isinstance(requirement, HeadingRequirement):
            curves = error_curves(built, known[cast("Axis", row.axis)], requirement)
            names = [f"calibration, {c.file}" if len(curves) > 1 else "calibration" for c in curves]
            maps.append(MapFact(row.name, row.axis, row.quantity, (), tuple(zip(names, curves, strict=True))))
            continue
        values = _judged_map(counted[cast("Axis", row.axis)], requirement)
        drawn.append(("predicted", Box(*values, row.unit)))
        name, channel = requirement.quantity, calibration and calibration.channel_of("gyro", row.axis)
        if calibration and channel and channel.term_of(name) is not None:
            grid = grid_of(channel, requirement, name)
            drawn.append(("achieved", calibration_map(calibration, channel, name, *grid)[1]))
        maps.append(MapFact(row.name, row.axis, row.quantity, tuple(drawn)))
    record = recipe.optimisation or {}
    name, value = re.sub(r" \([^)]*\)$", "", str(record.get("objective", ""))), record.get("before")
    if not before_is and name and isinstance(value, float | int):
        before_is = "the plan that the optimisation began with"
        rows = [row._replace(before=float(value) if row.name == name else None) for row in rows]
    return before_is, rows, maps


def hidden_by_structure(requirements: list[RequirementFact], maps: list[MapFact]) -> list[str]:
    """A note where results exceed the maps: these have only the covariance of the coefficients, not the discrepancy."""
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


def _plan(spec: Spec):
    """A spec's model, the posterior of every channel after its plan, and those that verdicts judge."""
    built = api.assemble(spec)
    known: dict[Axis, Posterior] = {channel: api.posterior_of_plan(built, channel) for channel in built.channels}
    return built, known, {channel: budget for _, channel, budget in counted_posteriors(built, known)}


def _judged_map(budget: CountedPosteriors, requirement: Requirement):
    """Temperatures, rates and residual that a verdict judges."""
    return api.residual_map(budget.built, budget.judged(run_of(requirement)), requirement)


def _before(other, spec: Spec, requirement: Requirement, channel: str) -> Box | None:
    """The residual of another plan on the same box or, without one, the spec's prior."""
    if other is None:
        return prior_map(spec, requirement)
    built, _, counted = other
    section = built.spec.sensor.scale_factor if requirement.quantity == "scale_factor" else built.spec.sensor.bias
    if channel not in counted or (section is None and requirement.quantity != "heading"):
        return None
    return Box(*_judged_map(counted[channel], requirement), UNIT_OF[requirement.quantity][0])


def result_alone(row: Result) -> RequirementFact:
    """A requirement of a calibration without a recipe: the achieved residual."""
    known = {"achieved": row.value, "target": row.target, "verdict": row.verdict, "named": row.named}
    statistic = ", ".join(filter(None, (row.statistic.removesuffix(", 1 sigma"), SUMMED.get(row.axis))))
    return RequirementFact(row.name, row.axis, row.quantity, statistic, row.unit, **known)
