"""The row of a requirement on a single axis, from posteriors of its own model; as `prediction.requirement_row`."""

from typing import Any

import numpy as np

from gradcal_jax.api.build import Assembled
from gradcal_jax.api.contract_rows import finite
from gradcal_jax.api.missions import mission_table, own_noise_of
from gradcal_jax.api.posterior_of_plan import DEG_PER_S, residual_map, statistic_of
from gradcal_jax.api.prediction import decided
from gradcal_jax.api.systematic import CountedPosteriors
from gradcal_jax.api.unit_build import assemble_unit
from gradcal_jax.api.verdicts import run_of
from gradcal_jax.files.contracts import RequirementRow
from gradcal_jax.files.moves import Axis
from gradcal_jax.files.requirement import MissionHeadingRequirement, Requirement
from gradcal_jax.files.spec import expect_spec
from gradcal_jax.information import STATISTICS


def axis_requirement_row(
    built: Assembled, budget: CountedPosteriors, requirement: Requirement, channel: Axis
) -> RequirementRow:
    """The residual and the verdict of one requirement on one axis."""
    _, rates, values = residual_map(built, budget.own, requirement)
    more: dict[str, Any] = {}
    judged = residual_map(budget.built, budget.whole, requirement)[2]
    if budget.whole is not budget.own:
        more["with_typical"] = finite(statistic_of(requirement, judged))
    if run_of(requirement) == "any run" and budget.any_run is not budget.whole:
        judged = residual_map(budget.built, budget.any_run, requirement)[2]
        more["another_run"] = finite(statistic_of(requirement, judged))
    for name in STATISTICS:
        if name != "mean of max" or requirement.quantity == "scale_factor":
            more[name.replace(" ", "_")] = finite(statistic_of(requirement, values, name))
    if isinstance(requirement, MissionHeadingRequirement):
        rates = np.array([float(rate) * DEG_PER_S for rate in requirement.rate])
    if requirement.quantity in ("heading", "north"):
        unit = assemble_unit(expect_spec(built.spec))
        own = own_noise_of(unit, next(r for r in unit.spec.requirement if r.name == requirement.name))
        assert own is not None
        more |= {"own": own.total, "own_sources": own.sources}
        if isinstance(requirement, MissionHeadingRequirement):
            more["missions"] = mission_table(requirement, values[:, 0], own)
    return RequirementRow(
        **{name: getattr(requirement, name) for name in ("name", "quantity", "statistic")},
        temperature_c=(float(requirement.temperature[0]), float(requirement.temperature[1])),
        grid=tuple(requirement.grid),
        **more,
        **decided(requirement, lambda name: statistic_of(requirement, judged, name)),
        axis=channel,
        rate_dps=(float(rates[0]), float(rates[-1])) if len(rates) > 1 else None,
    )
