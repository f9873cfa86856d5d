"""Elasticities of the residual: its change in per cent for one per cent of every figure of sensor, rig and plan.

The derivative of the logarithm of a requirement's residual in the logarithm of the figure, by automatic
differentiation through timeline, whitening and statistic, at the plan as it is. For an optimised plan the derivative is
the same after the plan is optimised again, to first order (envelope theorem).
"""

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np

from gradcal_jax.api.build import Assembled, assemble
from gradcal_jax.api.error_budget import known_sources, scaled
from gradcal_jax.api.posterior_of_plan import UNIT_OF, criterion_of
from gradcal_jax.api.unit_sensitivity import Elasticity, Sensitivities, unit_sensitivities
from gradcal_jax.design import Criterion
from gradcal_jax.files import Spec
from gradcal_jax.files.moves import Axis
from gradcal_jax.files.spec import expect_whole
from gradcal_jax.files.unit_spec import UnitSpec
from gradcal_jax.information import information
from gradcal_jax.model import Discrepancy, EncoderHarmonics, SensorModel
from gradcal_jax.trajectory import Rule, Schedule, rule_of

# Names of the plan's figures, for people.
_TIME, _RATES = "time: ramp and turns last longer", "rates: all turns faster"
_INTEGRATION, _LAG = "integration time", "thermal lag"
_ENCODER, _DISCREPANCY = "encoder's error by angle", "model discrepancy"


def sensitivities(spec: Spec | UnitSpec) -> Sensitivities:
    """The elasticities of every requirement of a spec, on the axis of its largest residual; of a whole unit by central
    differences. Errors: `ValueError` where nothing is required or observed."""
    if isinstance(spec, UnitSpec):
        return unit_sensitivities(spec)
    expect_whole(spec, "a sensitivity")
    if not spec.requirement:
        raise ValueError("the spec has no [[requirement]], so there is nothing to be sensitive: add one")
    built = assemble(spec)
    criteria = [criterion_of(built.model, r) for r in spec.requirement]
    names = _names(built)
    by_axis = {axis: _logs_and_slopes(built, axis, names, criteria) for axis in built.channels}
    if not all(np.all(np.isfinite(values)) and np.all(np.isfinite(slopes)) for values, slopes in by_axis.values()):
        raise ValueError(
            "the plan cannot observe what is required, so its sensitivity is not defined: see gradcal check"
        )
    rows, residuals = [], {}
    for i, r in enumerate(spec.requirement):
        values, slopes = max(by_axis.values(), key=lambda pair: pair[0][i])
        rows += [Elasticity(r.name, name, float(slopes[i, k])) for k, name in enumerate(names)]
        unit, factor = UNIT_OF[r.quantity]
        residuals[r.name] = float(np.exp(values[i])) * factor, unit
    rows.sort(key=lambda row: (row.requirement, -abs(row.percent)))
    return Sensitivities(tuple(rows), residuals)


def _logs_and_slopes(
    built: Assembled, axis: Axis, names: list[str], criteria: list[Criterion]
) -> tuple[np.ndarray, np.ndarray]:
    """Logarithms of the residuals (r,), and their derivatives with respect to those of all figures (r, f)."""
    schedule = built.schedules[axis]
    rule = rule_of(built.model, schedule.trajectory(built.thermal_lag))
    ones = jnp.ones(len(names))
    figures = _Figures(built.model, schedule.padded(), tuple(criteria), built.thermal_lag, built.sources, rule)
    values, slopes = _compiled(figures, tuple(names), ones)
    return np.asarray(values), np.asarray(slopes)


class _Figures(eqx.Module):
    """What the elasticities depend on; its arrays are arguments of the compiled program."""

    model: SensorModel
    schedule: Schedule
    criteria: tuple[Criterion, ...]
    thermal_lag: float | None
    sources: dict[str, tuple[int, ...]] = eqx.field(static=True)
    rule: Rule = eqx.field(static=True)


@eqx.filter_jit
def _compiled(figures: _Figures, names: tuple[str, ...], factors):
    def logs(factors):
        by = dict(zip(names, factors, strict=True))
        model = scaled(figures, by)
        for kind, field, name in (
            (EncoderHarmonics, lambda t: t.amplitudes, _ENCODER),
            (Discrepancy, lambda t: t.std, _DISCREPANCY),
        ):
            for k, term in enumerate(model.terms):
                if isinstance(term, kind) and name in by:
                    larger = eqx.tree_at(field, term, field(term) * by[name])
                    model = eqx.tree_at(lambda m, k=k: m.terms[k], model, larger)
        lag = figures.thermal_lag
        line = _stretched(figures.schedule, by).trajectory(None if lag is None else lag * by[_LAG])
        info = information(line, model, figures.rule)
        return jnp.log(jnp.stack([c(info) for c in figures.criteria]))

    return logs(factors), jax.jacrev(logs)(factors)


def _names(built: Assembled) -> list[str]:
    """Names of the figures that the spec has."""
    model, line = built.model, built.trajectory()
    names = known_sources(built)
    if model.harmonics is not None:
        names.append(_ENCODER)
    if any(isinstance(term, Discrepancy) for term in model.terms):
        names.append(_DISCREPANCY)
    if built.thermal_lag is not None:
        names.append(_LAG)
    if line.rates:
        return [*names, _INTEGRATION]
    return [*names, _TIME, *([_RATES] if len(line.moving_pieces) else [])]


def _stretched(plan: Schedule, by: dict) -> Schedule:
    """The plan with its times and rates multiplied by factors; the temperatures that it visits stay."""
    programme = plan.programme
    if plan.rates:
        time = by[_INTEGRATION]
        held = plan.duration * jnp.where(jnp.arange(len(plan.duration)) > 0, time, 1.0)
        more = jnp.sum(held) - jnp.sum(plan.duration)
        longer = programme.durations + jnp.where(programme.durations > 0.0, more, 0.0)
        return eqx.tree_at(lambda p: (p.duration, p.programme.durations), plan, (held, longer))
    time, rate = by[_TIME], by.get(_RATES, 1.0)
    of = lambda p: (p.duration, p.ramp, p.peak_rate, p.programme.durations, p.programme.slopes)  # noqa: E731
    numbers = plan.duration * time, plan.ramp * time, plan.peak_rate * rate
    return eqx.tree_at(of, plan, (*numbers, programme.durations * time, programme.slopes / time))
