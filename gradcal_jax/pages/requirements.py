"""The requirements of a page: before, as predicted, as achieved, and the residual maps behind the numbers."""

import re
from collections.abc import Iterator
from typing import Any, Final, NamedTuple

import numpy as np

from gradcal_jax.calibration import Calibration, Result
from gradcal_jax.estimation.calibrations import (
    Box,
    calibrated_parameters,
    calibrated_posterior,
    calibration_map,
    grid_of,
)
from gradcal_jax.information import Posterior, posterior
from gradcal_jax.information.error_budget import TURN_ON, CountedPosteriors, widened
from gradcal_jax.information.imu_residual import ErrorCurve, ImuResidual, error_curves, quantity_of
from gradcal_jax.information.posterior import square_root
from gradcal_jax.information.prediction import counted_posteriors
from gradcal_jax.information.verdicts import run_of
from gradcal_jax.model.imu_build import BuiltImu, build_imu, imu_posterior
from gradcal_jax.pages.sources import Sources
from gradcal_jax.plots.calibration_maps import panels_of
from gradcal_jax.plots.residual import boxes_of
from gradcal_jax.spec.requirement import MissionHeadingRequirement, Requirement
from gradcal_jax.spec.spec import Spec
from gradcal_jax.tables.contracts import RequirementRow

SUMMED: Final = {"worst": "worst axis", "all": "all axes together"}
# Relative difference of residuals that shows in the digits of a page.
_SEEN: Final = 1e-3


class RequirementFact(NamedTuple):
    """A requirement's residual before, predicted and achieved (1σ, in `unit`); None: not observable, or not known.

    All count what the spec omits and, in any run, the turn-on bias; `named`: the last one by the terms that the spec
    names alone, where it is another. `verdict`: of the achieved residual where there is a calibration, else of the
    predicted one; `limit`: proven for any plan; `coverage`: number of standard deviations that must be within the
    target.
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


class MapFact(NamedTuple):
    """Residual maps of one element ("x", "xy") of a requirement's quantity, in the order before, predicted, achieved,
    as far as they are known; for missions the curves of their error."""

    name: str
    axis: str
    quantity: str
    maps: tuple[tuple[str, Box], ...]
    curves: tuple[tuple[str, ErrorCurve], ...] = ()


class RequirementFacts(NamedTuple):
    """The requirements of a page with their maps. `before_is`: the meaning of "before"; empty without it. `differing`:
    names of requirements whose achieved map does not have the statistic that the calibration states, with both."""

    before_is: str
    rows: tuple[RequirementFact, ...]
    maps: tuple[MapFact, ...]
    differing: tuple[str, ...] = ()


def requirements_of(sources: Sources) -> RequirementFacts:
    """Every requirement of a page."""
    spec, calibration = sources.spec, sources.calibration
    if spec is None:
        assert calibration is not None
        alone = tuple(_result_alone(row, len(calibration.channel) > 1) for row in calibration.result)
        return RequirementFacts("", alone, tuple(_covered(calibration)))
    here = _Plan(spec)
    other = None if sources.before is None else _Plan(sources.before)
    results = {} if calibration is None else {row.name: row for row in calibration.result}
    achieved = None if calibration is None else here.achieved(calibration)
    rows: list[RequirementFact] = []
    maps: list[MapFact] = []
    differing: list[str] = []
    known_before = False
    by_name = {requirement.name: requirement for requirement in spec.requirement}
    for row in sources.prediction.requirements:
        requirement = by_name[row.name]
        stages = {
            "before": here.prior(requirement) if other is None else other.left(requirement),
            "predicted": here.left(requirement),
            "achieved": None if achieved is None else here.left_by(*achieved, requirement),
        }
        known = {label: left for label, left in stages.items() if left is not None and np.isfinite(left.values).any()}
        before = known["before"].statistic() if "before" in known else None
        known_before |= "before" in known
        result = results.get(row.name)
        more = {"before": before, "limit": sources.limits.get(row.name), "own": row.own, "coverage": row.coverage}
        # A calibration gives no verdict on what it does not state.
        more |= {} if calibration is None else {"verdict": None}
        rows.append(_fact_of(row, result, several=here.has_several(requirement), **more))
        if isinstance(requirement, MissionHeadingRequirement):
            maps.append(here.curves(requirement))
            continue
        maps += _maps_of(requirement, known)
        shown = known["achieved"].statistic() if "achieved" in known else None
        if result is not None and result.value and shown and abs(shown - result.value) > _SEEN * result.value:
            both = f"{shown:.4g} {row.unit} in the map, {result.value:.4g} {row.unit} in the table"
            differing.append(f"{row.name} ({both})")
    before_is = "" if not known_before else "without a calibration: the priors in the spec"
    if other is not None:
        before_is = f"the plan in {sources.before_name}, on the rig in this file"
    record = (sources.recipe and sources.recipe.optimisation) or {}
    name, value = re.sub(r" \([^)]*\)$", "", str(record.get("objective", ""))), record.get("before")
    if not before_is and name and isinstance(value, float | int):
        before_is = "the plan with which the optimisation began"
        rows = [row._replace(before=float(value) if row.name == name else None) for row in rows]
    return RequirementFacts(before_is, tuple(rows), tuple(maps), tuple(differing))


class _Plan:
    """A spec's model and posteriors before and after its plan."""

    def __init__(self, spec: Spec) -> None:
        self.built = build_imu(spec)
        self.known = imu_posterior(self.built)
        self.counted: CountedPosteriors = counted_posteriors(self.built, self.known)
        self._prior = posterior(square_root(np.asarray(self.counted.built.model.prior_rows())))

    def left(self, requirement: Requirement) -> ImuResidual | None:
        """The residual that a verdict judges."""
        return _residual(self.counted.built, self.counted.judged(run_of(requirement)), requirement)

    def prior(self, requirement: Requirement) -> ImuResidual | None:
        """The residual by what is known before any calibration; None for directions, of which it may be many turns."""
        left = _residual(self.counted.built, self._prior, requirement)
        return None if left is None or left.unit == "deg" else left

    def achieved(self, calibration: Calibration) -> tuple[BuiltImu, Posterior]:
        """The IMU about a calibration's parameters, and their posterior."""
        built = self.counted.built
        about = calibrated_parameters(built.model, calibration)
        return built._replace(about=about), calibrated_posterior(built.model, calibration)

    def left_by(self, built: BuiltImu, achieved: Posterior, requirement: Requirement) -> ImuResidual | None:
        """The residual after a calibration; in any run with the bias of another power-on."""
        if run_of(requirement) == "any run" and (turn_on := self.counted.columns.get(TURN_ON)) is not None:
            achieved = widened(achieved, {TURN_ON: turn_on})
        return _residual(built, achieved, requirement)

    def has_several(self, requirement: Requirement) -> bool:
        """Whether a requirement's quantity has several elements."""
        return len(quantity_of(self.built, requirement).elements) > 1

    def curves(self, requirement: MissionHeadingRequirement) -> MapFact:
        """The error of the heading over every mission, with what several curves differ by."""
        drawn = error_curves(self.built, self.known, requirement)
        axes, files = len({axis for axis, _ in drawn}) > 1, len({curve.file for _, curve in drawn}) > 1
        parts = [("calibration", axis * axes, curve.file * files) for axis, curve in drawn]
        labels = [", ".join(filter(None, part)) for part in parts]
        curves = tuple(zip(labels, (curve for _, curve in drawn), strict=True))
        return MapFact(requirement.name, requirement.axis, requirement.quantity, (), curves)


def _residual(built: BuiltImu, known: Posterior, requirement: Requirement) -> ImuResidual | None:
    """A requirement's residual; None where another sensor does not have its quantity."""
    quantity = quantity_of(built, requirement)
    return quantity.residual(known) if quantity.elements else None


def _maps_of(requirement: Requirement, stages: dict[str, ImuResidual]) -> list[MapFact]:
    """The maps of every element of a quantity at each stage."""
    maps: dict[str, list[tuple[str, Box]]] = {}
    for stage, left in stages.items():
        for element, box in boxes_of(left):
            maps.setdefault(element, []).append((stage, box))
    return [MapFact(requirement.name, element, requirement.quantity, tuple(own)) for element, own in maps.items()]


def _covered(calibration: Calibration) -> Iterator[MapFact]:
    """The achieved maps of biases and scale factors of a calibration without a plan, over all that the data cover."""
    for kind, name in panels_of(calibration):
        for channel in calibration.channel:
            if channel.kind == kind and channel.term_of(name) is not None:
                _, deviation = calibration_map(calibration, channel, name, *grid_of(channel, name))
                yield MapFact("all that the data cover", channel.axis, f"{kind}_{name}", (("achieved", deviation),))


def _fact_of(row: RequirementRow, result: Result | None, *, several: bool, **more: Any) -> RequirementFact:
    """A requirement as predicted, and as achieved where there is a result. `several`: elements are summed up; `more`:
    further fields."""
    fields: dict[str, Any] = {"statistic": _statistic(row.statistic, row.axis, several), "predicted": row.judged}
    fields |= {"named": None if row.judged == row.decisive else row.decisive, "verdict": row.verdict, **more}
    if result is not None:
        fields |= {"achieved": result.value, "verdict": result.verdict, "named": result.named}
    same = ("name", "axis", "quantity", "unit", "temperature_c", "rate_dps", "target", "limited_by")
    return RequirementFact(**{name: getattr(row, name) for name in same}, **fields)


def _result_alone(row: Result, several: bool) -> RequirementFact:
    """A requirement of a calibration without a plan: the achieved residual."""
    known = {"achieved": row.value, "target": row.target, "verdict": row.verdict, "named": row.named}
    statistic = _statistic(row.statistic.removesuffix(", 1 sigma"), row.axis, several)
    return RequirementFact(row.name, row.axis, row.quantity, statistic, row.unit, **known)


def _statistic(statistic: str, axis: str, several: bool) -> str:
    """A statistic, and how several elements are summed up."""
    return f"{statistic}, {SUMMED[axis]}" if several and axis in SUMMED else statistic
