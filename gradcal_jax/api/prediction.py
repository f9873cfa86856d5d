"""The contract gradcal-prediction/1, filled from a spec."""

import numpy as np

from gradcal_jax.api.build import Assembled, assemble
from gradcal_jax.api.error_budget import error_budget, limited_by
from gradcal_jax.api.posterior_of_plan import UNIT_OF, posterior_of_plan, residual_map, target_of, verdict
from gradcal_jax.api.unit_prediction import predict_unit
from gradcal_jax.api.warnings import warnings
from gradcal_jax.files import Prediction, Spec
from gradcal_jax.files.contracts import ParameterRow, RequirementRow
from gradcal_jax.files.moves import Axis
from gradcal_jax.files.requirement import Requirement
from gradcal_jax.files.unit_spec import UnitSpec
from gradcal_jax.information import STATISTICS, Posterior, statistic


def predict(spec: Spec | UnitSpec, *, limits: bool = False) -> Prediction:
    """The residual that a spec's plan leaves: by requirement (ppm, deg/h; 1σ), by parameter (SI), with its covariance.

    `limits`: also say of each requirement what it is limited by. The exact covariance of generalised least squares
    under the spec's noise (`gradcal_jax.information`). What cannot be observed is None, with a warning. Errors:
    none; whatever is wrong with a file, `read_spec` has refused already.
    """
    if isinstance(spec, UnitSpec):
        return predict_unit(spec)
    built = assemble(spec)
    known: dict[Axis, Posterior] = {channel: posterior_of_plan(built, channel) for channel in built.channels}
    requirements = [
        _requirement_row(built, known[channel], requirement, channel)
        for requirement in spec.requirement
        for channel in built.channels
    ]
    if limits:
        shares = {channel: error_budget(built, channel, known[channel]) for channel in built.channels}
        requirements = [
            row.model_copy(update={"limited_by": limited_by(shares[row.axis].get(row.name))}) for row in requirements
        ]
    schedule = spec.schedule
    parameters, covariance = _parameters(built, known)
    return Prediction(
        title=spec.title,
        duration_s=schedule.duration,
        soak_s=schedule.soak,
        motion_s=schedule.motion,
        requirements=tuple(requirements),
        parameters=parameters,
        covariance=covariance,
        warnings=tuple(warnings(built, known)),
    )


def _requirement_row(built: Assembled, known: Posterior, requirement: Requirement, channel: Axis) -> RequirementRow:
    _, rates, values = residual_map(built, known, requirement)
    found = {name: statistic(name, values) for name in STATISTICS}
    if requirement.quantity == "bias":
        del found["mean of max"]
    found = {name: value if np.isfinite(value) else None for name, value in found.items()}
    return RequirementRow(
        name=requirement.name,
        quantity=requirement.quantity,
        unit=UNIT_OF[requirement.quantity][0],
        axis=channel,
        temperature_c=(float(requirement.temperature[0]), float(requirement.temperature[1])),
        rate_dps=(float(rates[0]), float(rates[-1])) if requirement.quantity == "scale_factor" else None,
        grid=tuple(requirement.grid),
        statistic=requirement.statistic,
        mean_of_max=found.get("mean of max"),
        max=found["max"],
        mean=found["mean"],
        rms=found["rms"],
        target=target_of(requirement),
        verdict=verdict(requirement, found[requirement.statistic]),
    )


def _parameters(built: Assembled, known: dict[Axis, Posterior]):
    """Rows of the reported parameters and their covariance, axes one after the other (they are independent)."""
    model = built.model
    count = model.calibrated
    names, reported, unit = model.names()[:count], model.to_reported[:count], model.units()
    rows, size = [], len(known) * count
    covariance: list[list[float | None]] = [[0.0] * size for _ in range(size)]
    for k, (channel, posterior_) in enumerate(known.items()):
        deviations = posterior_.deviations(reported)
        block = posterior_.covariance(reported)
        for i, deviation in enumerate(deviations):
            std = float(deviation) if np.isfinite(deviation) else None
            rows.append(ParameterRow(name=names[i], axis=channel, std=std, unit=unit[i]))
            for j, other in enumerate(deviations):
                seen = np.isfinite(deviation) and np.isfinite(other)
                covariance[k * count + i][k * count + j] = float(block[i, j]) if seen else None
    return tuple(rows), tuple(tuple(row) for row in covariance)
