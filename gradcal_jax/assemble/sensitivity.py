"""What one per cent of every figure of sensor, rig and plan is worth, in per cent of the residual.

The derivative of the logarithm of a requirement's residual in the logarithm of the figure, by automatic
differentiation through timeline, whitening and statistic, at the plan as it is: for an optimised plan this is also what
remains after it is optimised again, to first order (envelope theorem).
"""

from typing import NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np

from gradcal_jax.assemble.build import Assembled, assemble
from gradcal_jax.assemble.knowledge import UNIT_OF, box
from gradcal_jax.design import criterion
from gradcal_jax.files import Spec
from gradcal_jax.information import information
from gradcal_jax.plans import GradientPlan


class Elasticity(NamedTuple):
    """`percent`: by how much the requirement's residual changes for one per cent more of `figure`."""

    requirement: str
    figure: str
    percent: float


class Sensitivities(NamedTuple):
    """Elasticities, and the residual of each requirement in its unit."""

    rows: tuple[Elasticity, ...]
    residuals: dict[str, tuple[float, str]]


def sensitivities(spec: Spec) -> Sensitivities:
    """The elasticities of every requirement of a spec. Errors: `ValueError` where nothing is required or observed."""
    if not spec.requirement:
        raise ValueError("the spec has no [[requirement]], so there is nothing to be sensitive: add one")
    built = assemble(spec)
    lag = None if built.thermal_lag is None else jnp.asarray(built.thermal_lag)
    criteria = [criterion(built.model, r.quantity, *box(r), r.statistic) for r in spec.requirement]
    sources = {name: tuple(members) for name, members in built.sources.items()}
    names = _names(built, sources)
    # Which factor each process has; the last is one.
    factor_of = np.full(built.model.processes.count, len(names))
    for name, members in sources.items():
        factor_of[list(members)] = names.index(name)

    @eqx.filter_jit
    def logs(factors):
        model, plan = built.model, built.plan
        by = dict(zip(names, factors, strict=True))
        processes = model.processes
        size = jnp.append(factors, 1.0)[factor_of]
        reference = model.reference
        scaled = lambda name, value: value * by.get(name, 1.0)  # noqa: E731
        model = eqx.tree_at(
            lambda m: (
                m.angle_random_walk,
                m.processes.diffusion,
                m.processes.initial_std,
                m.reference.reading_noise,
                m.reference.standstill_offset,
                m.reference.timing_error,
                m.reference.rate_accuracy,
                m.reference.harmonic_amplitudes,
            ),
            model,
            (
                scaled("angle random walk", model.angle_random_walk),
                processes.diffusion * size,
                processes.initial_std * size,
                scaled("reading noise", reference.reading_noise),
                scaled("standstill offset", reference.standstill_offset),
                scaled("timing error", reference.timing_error),
                scaled("rate accuracy", reference.rate_accuracy),
                scaled("encoder's error by angle", reference.harmonic_amplitudes),
            ),
        )
        if isinstance(plan, GradientPlan):
            plan = _stretched(plan, by.get("time: ramp and turns last longer"), by.get("rates: all turns faster"))
        else:
            plan = eqx.tree_at(lambda p: p.integration, plan, plan.integration * by["integration time"])
        slower = None if lag is None else lag * by["thermal lag"]
        info = information(plan.timeline(built.channels[0], slower), model)
        return jnp.log(jnp.stack([c(info) for c in criteria]))

    ones = jnp.ones(len(names))
    values, gradients = np.asarray(logs(ones)), np.asarray(eqx.filter_jit(jax.jacrev(logs))(ones))
    if not np.all(np.isfinite(values)) or not np.all(np.isfinite(gradients)):
        raise ValueError(
            "the plan cannot observe what is required, so nothing can be said of its sensitivity: see check"
        )
    rows = [
        Elasticity(r.name, name, float(gradients[i, k]))
        for i, r in enumerate(spec.requirement)
        for k, name in enumerate(names)
    ]
    rows.sort(key=lambda row: (row.requirement, -abs(row.percent)))
    residuals = {}
    for r, value in zip(spec.requirement, values, strict=True):
        unit, factor = UNIT_OF[r.quantity]
        residuals[r.name] = float(np.exp(value)) * factor, unit
    return Sensitivities(tuple(rows), residuals)


def _names(built: Assembled, sources: dict[str, tuple[int, ...]]) -> list[str]:
    """Figures that the spec has, by the names that people use."""
    spec = built.spec
    angle = spec.rig.table.angle
    found = ["angle random walk", *sources]
    figures = {
        "reading noise": float(angle.reading_noise),
        "standstill offset": float(angle.standstill_offset),
        "timing error": float(angle.timing_error),
        "rate accuracy": float(spec.rig.table.rate_accuracy or 0.0),
        "encoder's error by angle": float(len(angle.harmonics)),
        "thermal lag": float(spec.sensor.thermal_lag or 0.0),
    }
    found += [name for name, value in figures.items() if value > 0.0]
    if isinstance(built.plan, GradientPlan):
        found.append("time: ramp and turns last longer")
        if spec.gradient_schedule.cycle is not None:
            found.append("rates: all turns faster")
    else:
        found.append("integration time")
    return found


def _stretched(plan: GradientPlan, time, rate) -> GradientPlan:
    """The plan with all its times longer and its turns faster; the temperatures that it visits stay."""
    programme = plan.programme
    programme = eqx.tree_at(
        lambda p: (p.durations, p.slopes), programme, (programme.durations * time, programme.slopes / time)
    )
    longer = lambda move: eqx.tree_at(  # noqa: E731
        lambda m: (m.duration, m.ramp, m.peak_rate),
        move,
        (move.duration * time, move.ramp * time, move.peak_rate * (1.0 if rate is None else rate)),
    )
    moves, after = tuple(longer(m) for m in plan.moves), tuple(longer(m) for m in plan.after)
    return eqx.tree_at(lambda p: (p.programme, p.moves, p.after), plan, (programme, moves, after))
