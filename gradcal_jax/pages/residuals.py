"""What is left of the error of each requirement: before the plan, after it as predicted, and as achieved."""

from typing import NamedTuple

import numpy as np

from gradcal_jax.estimation.calibrations import calibrated_parameters, calibrated_posterior
from gradcal_jax.information import posterior
from gradcal_jax.information.posterior import square_root
from gradcal_jax.information.prediction import judged_plan
from gradcal_jax.information.residual import ResidualMap, residual_of
from gradcal_jax.information.unseen import TURN_ON, widened
from gradcal_jax.information.verdicts import finite, run_of
from gradcal_jax.pages.sources import Sources
from gradcal_jax.pages.tables import results as results_of
from gradcal_jax.spec.requirement import Requirement
from gradcal_jax.tables.display import amount
from gradcal_jax.tables.table import Table


class ResidualLeft(NamedTuple):
    """A requirement, and its residuals (1σ) by stage: "before" (by the priors of the spec), "predicted", "achieved", as
    far as they are known."""

    requirement: Requirement
    stages: dict[str, ResidualMap]


def residuals_left(sources: Sources) -> list[ResidualLeft]:
    """The residuals of all requirements of a plan."""
    spec, calibration = sources.spec, sources.calibration
    if spec is None:
        return []
    counted = judged_plan(spec).budget
    built = counted.built
    prior = posterior(square_root(np.asarray(built.model.prior_rows())))
    turn_on = counted.columns.get(TURN_ON)
    found: list[ResidualLeft] = []
    for requirement in spec.requirement:
        run = run_of(requirement)
        known = {"before": (built, prior), "predicted": (built, counted.judged(run))}
        if calibration is not None:
            about = calibrated_parameters(built.model, calibration)
            achieved = calibrated_posterior(built.model, calibration)
            if run == "any run" and turn_on is not None:
                achieved = widened(achieved, {TURN_ON: turn_on})
            known["achieved"] = built._replace(about=about), achieved
        stages = {stage: residual_of(of, requirement).map(by) for stage, (of, by) in known.items()}
        finite = {stage: left for stage, left in stages.items() if np.isfinite(left.values).any()}
        found.append(ResidualLeft(requirement, finite))
    return found


def outcome_table(sources: Sources, found: list[ResidualLeft]) -> Table:
    """The requirements of a page: what is left at each stage, the target and the verdict."""
    calibration = sources.calibration
    if sources.spec is None:
        assert calibration is not None
        return results_of(calibration)
    results = {} if calibration is None else {row.name: row for row in calibration.result}
    before = {left.requirement.name: left.stages.get("before") for left in found}
    rows: list[dict[str, str]] = []
    for row in sources.prediction.requirements:
        low, high = row.temperature_c
        rates = "" if row.rate_dps is None else f", {row.rate_dps[0]:g} to {row.rate_dps[1]:g} deg/s"
        cells = {
            "requirement": row.name,
            "within": f"{low:g} to {high:g} °C{rates}",
            "statistic": f"{row.statistic}, {row.axis}",
            "before": "" if (prior := before.get(row.name)) is None else amount(finite(prior.statistic()), row.unit),
            "predicted": amount(row.judged, row.unit),
            "achieved": "",
            "target": "" if row.target is None else amount(row.target, row.unit),
            "verdict": (row.verdict if calibration is None else None) or "",
            "limited by": row.limited_by or "",
        }
        if (result := results.get(row.name)) is not None:
            cells |= {"achieved": amount(result.value, row.unit), "verdict": result.verdict or ""}
        rows.append(cells)
    heads = [head for head in (rows[0] if rows else {}) if any(row[head] for row in rows)]
    return Table.of(heads, [[row[head] for head in heads] for row in rows])
