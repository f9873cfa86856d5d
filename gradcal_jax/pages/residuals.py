"""What is left of the error of each requirement: before the plan, after it as predicted, and as achieved."""

from typing import NamedTuple

import numpy as np

from gradcal_jax.calibration import Calibration
from gradcal_jax.estimation.calibrations import calibrated_parameters, calibrated_posterior
from gradcal_jax.information import Posterior, posterior
from gradcal_jax.information.imu_residual import ImuResidual, quantity_of
from gradcal_jax.information.posterior import square_root
from gradcal_jax.information.prediction import judged_plan
from gradcal_jax.information.unseen import TURN_ON, CountedPosteriors, widened
from gradcal_jax.information.verdicts import run_of
from gradcal_jax.model.build import BuiltImu
from gradcal_jax.pages.sources import Sources
from gradcal_jax.pages.tables import results as results_of
from gradcal_jax.spec.requirement import Requirement
from gradcal_jax.spec.spec_sections import Spec
from gradcal_jax.tables.display import amount
from gradcal_jax.tables.table import Table


class ResidualLeft(NamedTuple):
    """A requirement, and its residuals (1σ) by stage: "before", "predicted", "achieved", as far as they are known."""

    requirement: Requirement
    stages: dict[str, ImuResidual]


def residuals_of(sources: Sources) -> list[ResidualLeft]:
    """The residuals of all requirements of a plan."""
    spec = sources.spec
    if spec is None:
        return []
    plan = _Plan(spec)
    other = None if sources.before is None else _Plan(sources.before)
    achieved = None if sources.calibration is None else plan.achieved(sources.calibration)
    found: list[ResidualLeft] = []
    for requirement in spec.requirement:
        stages = {
            "before": plan.prior(requirement) if other is None else other.left(requirement),
            "predicted": plan.left(requirement),
            "achieved": None if achieved is None else plan.left_by(*achieved, requirement),
        }
        known = {stage: left for stage, left in stages.items() if left is not None and np.isfinite(left.values).any()}
        found.append(ResidualLeft(requirement, known))
    return found


def outcome_table(sources: Sources, found: list[ResidualLeft]) -> Table:
    """The requirements of a page: what is left at each stage, the target and the verdict."""
    calibration = sources.calibration
    if sources.spec is None:
        assert calibration is not None
        return results_of(calibration)
    results = {} if calibration is None else {row.name: row for row in calibration.result}
    before = {left.requirement.name: left.stages.get("before") for left in found}
    rows = []
    for row in sources.prediction.requirements:
        result = results.get(row.name)
        prior = before.get(row.name)
        rows.append(
            (
                row.name,
                _box(row.temperature_c, row.rate_dps),
                f"{row.statistic}, {row.axis}",
                "" if prior is None else amount(prior.statistic(), row.unit),
                amount(row.judged, row.unit),
                "" if result is None else amount(result.value, row.unit),
                "" if row.target is None else amount(row.target, row.unit),
                (row.verdict if calibration is None else None if result is None else result.verdict) or "",
                row.limited_by or "",
            )
        )
    stages = ["before", "predicted", "achieved"]
    heads = ["requirement", "within", "statistic", *stages, "target", "verdict", "limited by"]
    kept = [k for k, _ in enumerate(heads) if any(row[k] for row in rows)]
    return Table.of([heads[k] for k in kept], [[row[k] for k in kept] for row in rows])


def _box(temperature_c: tuple[float, float], rate_dps: tuple[float, float] | None) -> str:
    words = f"{temperature_c[0]:g} to {temperature_c[1]:g} °C"
    return words if rate_dps is None else f"{words}, {rate_dps[0]:g} to {rate_dps[1]:g} deg/s"


class _Plan:
    """A spec's model and posteriors before and after its plan."""

    def __init__(self, spec: Spec) -> None:
        self.counted: CountedPosteriors = judged_plan(spec).budget
        self._prior = posterior(square_root(np.asarray(self.counted.built.model.prior_rows())))

    def left(self, requirement: Requirement) -> ImuResidual | None:
        """The residual that a verdict judges."""
        return _residual(self.counted.built, self.counted.judged(run_of(requirement)), requirement)

    def prior(self, requirement: Requirement) -> ImuResidual | None:
        """The residual by what is known before any calibration."""
        return _residual(self.counted.built, self._prior, requirement)

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


def _residual(built: BuiltImu, known: Posterior, requirement: Requirement) -> ImuResidual | None:
    """A requirement's residual; None where another sensor does not have its quantity."""
    quantity = quantity_of(built, requirement)
    return quantity.residual(known) if quantity.elements else None
