"""Derivatives of the residual: its change in per cent for one per cent of every figure of sensor, rig and plan.

An elasticity is the derivative of the logarithm of a requirement's residual in the logarithm of the figure, at the plan
as it is. For an optimised plan the derivative is the same after the plan is optimised again, to first order (envelope
theorem). That of an error's size is its share in the error budget. Those of all other figures are central differences
of the spec as a function of its figures (`differentiable`), extrapolated to a step of zero. Where times or rates
change, the number of readings and of cycles stays, since an integer has no derivative.
"""

from collections.abc import Callable, Mapping
from typing import Any, Final, NamedTuple

import numpy as np

from gradcal_jax.information.differentiable import (
    CHAMBER_DURATIONS,
    CHAMBER_SLOPES,
    LAG,
    MOVE_DURATIONS,
    PEAK_RATES,
    RAMPS,
    READING_INTERVALS,
    Differentiable,
    differentiable,
)
from gradcal_jax.information.error_budget import PRIOR, ErrorBudget
from gradcal_jax.information.figures import CORRELATION_TIME
from gradcal_jax.information.plan_information import imu_posterior
from gradcal_jax.information.residual import residual_map
from gradcal_jax.information.unseen import budget_of_imu
from gradcal_jax.model import Map
from gradcal_jax.spec.requirement import QUANTITIES
from gradcal_jax.spec.spec import expect_spec
from gradcal_jax.spec.spec_sections import Spec
from gradcal_jax.tables.display import summary

TIME: Final = "time: ramp and turns last longer"
RATES: Final = "rates: all turns faster"
INTEGRATION: Final = "integration time"
# Step of the differences; and of those in which moves shift against the chamber's programme.
_STEP, _SMALL_STEP = 2e-4, 2e-5
# Largest change (rad) of a wave of the encoder's error in a step.
_PHASE = 0.02

Change = Callable[[float], Mapping[str, Any]]


class Elasticity(NamedTuple):
    """`percent`: the change of the requirement's residual, in per cent, for one per cent more of `figure`."""

    requirement: str
    figure: str
    percent: float


class Sensitivities(NamedTuple):
    """Elasticities, and the residual of each requirement in its unit."""

    rows: tuple[Elasticity, ...]
    residuals: dict[str, tuple[float, str]]

    __repr__ = summary


def sensitivity(spec: Spec) -> Sensitivities:
    """The change of each residual, in per cent, for one per cent more of every figure of sensor, rig and plan.

    `rows` of (requirement, figure, percent), the largest first; `residuals` of (value, unit) by requirement, in its own
    unit. Errors: `ValueError` for a spec without requirements, with one that the plan cannot observe, or with an
    estimator that does not weight by the noise.
    """
    spec = expect_spec(spec)
    of = differentiable(spec)
    known = imu_posterior(of.built)
    hidden = [r.name for r in spec.requirement if not np.isfinite(residual_map(of.built, known, r).statistic())]
    if hidden:
        names = ", ".join(hidden)
        raise ValueError(f"the plan cannot observe {names}, so the sensitivity is not defined: see gradcal check")
    # The elasticity of an error's size is its share in the error budget, as far as the spec names it.
    sources, rows = ErrorBudget(budget_of_imu(of.built, known, of.built)), list[Elasticity]()
    for r in spec.requirement:
        shares = sources.shares(r, "this run") or {}
        rows += [Elasticity(r.name, name, share) for name, share in shares.items() if name != PRIOR]
    for name, (change, step) in (_of_sensor(of) | _of_plan(of)).items():
        near, far = (_slopes(of, change, h) for h in (0.5 * step, step))
        rows += [Elasticity(r.name, name, near[r.name] + (near[r.name] - far[r.name]) / 3.0) for r in spec.requirement]
    rows.sort(key=lambda row: (row.requirement, -abs(row.percent)))
    values = of.at({})
    shown = {r.name: (float(values[r.name]), QUANTITIES[r.quantity].unit) for r in spec.requirement}
    return Sensitivities(tuple(rows), shown)


def _slopes(of: Differentiable, change: Change, step: float) -> dict[str, float]:
    """d ln residual/d ln(factor) by central differences."""
    more, less = (of.at(change(np.exp(h))) for h in (step, -step))
    return {name: float(np.log(more[name] / less[name])) / (2.0 * step) for name in more}


def _of_sensor(of: Differentiable) -> dict[str, tuple[Change, float]]:
    """Figures of the sensor that are no sizes of errors: their changes, and the step of the differences."""
    names = [name for name in of.own if name.startswith(CORRELATION_TIME)]
    names += [LAG] if np.any(of.own.get(LAG, 0.0)) else []
    return {name: (lambda factor, name=name: {name: of.own[name] * factor}, _STEP) for name in names}


def _of_plan(of: Differentiable) -> dict[str, tuple[Change, float]]:
    """The plan's figures."""
    built, own = of.built, of.own
    line, spec = built.motion.line, built.spec
    # Where attitudes count, longer turns are slower, and faster ones shorter.
    kept, turning = not spec.is_one_axis, own[PEAK_RATES] != 0.0

    def longer(factor: float) -> dict[str, Any]:
        times = (MOVE_DURATIONS, RAMPS, CHAMBER_DURATIONS, READING_INTERVALS)
        slower = (CHAMBER_SLOPES, PEAK_RATES) if kept else (CHAMBER_SLOPES,)
        changed = {name: own[name] * factor for name in times if name in own}
        return changed | {name: own[name] / factor for name in slower}

    def faster(factor: float) -> dict[str, Any]:
        shorter = np.where(turning, 1.0 / factor, 1.0) if kept else 1.0
        return {PEAK_RATES: own[PEAK_RATES] * factor} | {n: own[n] * shorter for n in (MOVE_DURATIONS, RAMPS)}

    def integrated(factor: float) -> dict[str, Any]:
        held, course = own[MOVE_DURATIONS].copy(), own[CHAMBER_DURATIONS]
        held[1:] *= factor
        more = np.sum(held) - np.sum(own[MOVE_DURATIONS])
        return {MOVE_DURATIONS: held, CHAMBER_DURATIONS: course + np.where(course > 0.0, more, 0.0)}

    if line.rates:
        return {INTEGRATION: (integrated, _STEP)}
    before, after = built.motion.angles()
    waves = max((h.order for axis in spec.rig.table.axis for h in axis.angle.harmonics), default=0)
    turned = waves * float(np.max(np.abs(after - before[0]), initial=0.0))
    step = min(_STEP, _PHASE / turned) if turned and not kept else _STEP
    # Where functions of the rate are divided, other rates divide the pieces elsewhere.
    divided = any(isinstance(t, Map) and t.rate.breaks for t in built.model.terms)
    figures: dict[str, tuple[Change, float]] = {} if divided and kept else {TIME: (longer, step)}
    if np.any(line.moving) and not divided:
        figures[RATES] = faster, _SMALL_STEP if kept else step
    return figures
