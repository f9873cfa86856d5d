"""Derivatives of the residual: its change in per cent for one per cent of every figure of sensor, rig and plan.

An elasticity is the derivative of the logarithm of a requirement's residual in the logarithm of the figure, at the plan
as it is. For an optimised plan the derivative is the same after the plan is optimised again, to first order (envelope
theorem). That of an error's size is its share in the error budget. Those of all other figures are central differences
of the prediction, extrapolated to a step of zero. Where times or rates change, the number of readings and of cycles
stays, since an integer has no derivative.
"""

import re
from collections.abc import Callable, Iterator, Mapping
from dataclasses import replace
from functools import partial
from typing import Any, Final, NamedTuple, cast

import equinox as eqx
import numpy as np

from gradcal_jax.information import Posterior
from gradcal_jax.information.error_budget import PRIOR, ErrorBudget, shares_of_variance
from gradcal_jax.information.imu_residual import imu_residual
from gradcal_jax.information.unseen import budget_of_imu, own_of_imu
from gradcal_jax.information.verdicts import UNIT_OF
from gradcal_jax.model.build import BuiltImu, build_imu, imu_posterior
from gradcal_jax.motion import Schedule
from gradcal_jax.spec.changes import changed, tables_of
from gradcal_jax.spec.requirement import Requirement
from gradcal_jax.spec.spec import expect_spec
from gradcal_jax.spec.spec_sections import Spec
from gradcal_jax.tables.display import summary
from gradcal_jax.units import dimension_of, format_quantity, parse, unit_of

TIME: Final = "time: ramp and turns last longer"
RATES: Final = "rates: all turns faster"
INTEGRATION: Final = "integration time"
# Step of the differences; and of those in which moves shift against the chamber's programme.
_STEP, _SMALL_STEP = 2e-4, 2e-5
# Largest change (rad) of a wave of the encoder's error in a step.
_PHASE = 0.02
# Patterns of keys, and the name of their figure for people.
_FIGURES: Final[tuple[tuple[str, str], ...]] = (
    (r"sensor\.(gyro|accelerometer)\.drift\[\d+\]\.correlation_time", "{0}: drift's correlation time"),
    (r"sensor\.gyro\.scale_factor_instability\[\d+\]\.correlation_time", "gyro: instability's correlation time"),
    (r"sensor\.gyro\.temperature_error\.correlation_time", "gyro: temperature error's correlation time"),
    (r"sensor\.(gyro|accelerometer)\.(\w+)\.prior", "{0}: prior of {1}"),
    (r"sensor\.(gyro|accelerometer)\.(\w+)\.smoothness", "{0}: smoothness of {1}"),
    (r"sensor\.(thermal_lag)", "{0}"),
)


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
    unit. For an optimised plan the change is the same after the plan is optimised again (envelope theorem).

    Errors: `ValueError` for a spec without requirements, or with one that the plan cannot observe.
    """
    spec = expect_spec(spec)
    if not spec.requirement:
        raise ValueError("the spec has no [[requirement]], so there are no sensitivities: add a requirement")
    built = build_imu(spec)
    nominal = _residuals(built)
    hidden = [r.name for r, value in zip(spec.requirement, nominal, strict=True) if not np.isfinite(value)]
    if hidden:
        names = ", ".join(hidden)
        raise ValueError(f"the plan cannot observe {names}, so the sensitivity is not defined: see gradcal check")
    rows = [Elasticity(r.name, name, value) for r, of in _of_errors(built) for name, value in of.items()]
    figures = {name: (partial(_with_keys, spec, keys), _STEP) for name, keys in sensitive_figures(spec).items()}
    for name, (build, step) in (figures | _of_plan(built)).items():
        slopes = _slopes(lambda factor, build=build: np.log(_residuals(build(factor))), step)
        rows += [Elasticity(r.name, name, float(x)) for r, x in zip(spec.requirement, slopes, strict=True)]
    rows.sort(key=lambda row: (row.requirement, -abs(row.percent)))
    shown = {r.name: (float(v), UNIT_OF[r.quantity][0]) for r, v in zip(spec.requirement, nominal, strict=True)}
    return Sensitivities(tuple(rows), shown)


def _residuals(built: BuiltImu) -> np.ndarray:
    """The value of every requirement's own statistic; infinite where it is not observable."""
    known = own_of_imu(built)
    return np.array([imu_residual(built, known, r).finite_statistic() for r in built.spec.requirement])


def _of_errors(built: BuiltImu) -> Iterator[tuple[Requirement, dict[str, float]]]:
    """The elasticity of every error's size for each requirement: its share in the error budget, with what no residual
    of a run shows, as far as the spec names it."""
    known = imu_posterior(built)
    budget, sources = budget_of_imu(built, known, built), ErrorBudget(built, known)
    for requirement in built.spec.requirement:

        def value(of: Posterior, requirement=requirement) -> float:
            return imu_residual(built, of, requirement).finite_statistic()

        fit, unseen = shares_of_variance(budget, "this run", value)
        shares = {n: fit * share for n, share in (sources.shares(requirement) or {}).items() if n != PRIOR}
        yield requirement, shares | unseen


def sensitive_figures(spec: Spec) -> dict[str, list[str]]:
    """The keys of a spec's figures that are no sizes of errors, by the name of the figure."""
    figures: dict[str, list[str]] = {}
    for key, text in _texts(tables_of(spec), ""):
        for pattern, name in _FIGURES:
            if (match := re.fullmatch(pattern, key)) is not None and _number(text) != 0.0:
                words = (group.replace("_", " ") for group in match.groups())
                figures.setdefault(name.format(*words), []).append(key)
    return figures


def _with_keys(spec: Spec, keys: list[str], factor: float) -> BuiltImu:
    """The spec with keys multiplied by a factor."""
    texts = dict(_texts(tables_of(spec), ""))
    scaled = {key: format_quantity(_number(texts[key]) * factor, unit_of(texts[key])) for key in keys}
    return build_imu(changed(spec, scaled))


def _of_plan(built: BuiltImu) -> dict[str, tuple[Callable[[float], BuiltImu], float]]:
    """The plan's figures by name: what they build for a factor, and the step of the differences."""
    line, spec = built.motion.line, built.spec
    if line.rates:
        return {INTEGRATION: (lambda factor: build_imu(spec, change=partial(_integrated, factor)), _STEP)}
    # Where attitudes count, longer turns are slower, and faster ones shorter.
    kept = not spec.is_one_axis

    def longer(factor: float) -> BuiltImu:
        of = build_imu(spec, change=partial(_timed, factor, 1.0 / factor if kept else 1.0))
        every = of.model.encoder.every * factor
        return of._replace(model=eqx.tree_at(lambda m: m.encoder.every, of.model, every))

    def faster(factor: float) -> BuiltImu:
        return build_imu(spec, change=partial(_turned, factor, 1.0 / factor if kept else 1.0))

    before, after = built.motion.angles()
    waves = max((h.order for axis in spec.rig.table.axis for h in axis.angle.harmonics), default=0)
    turned = waves * float(np.max(np.abs(after - before[0]), initial=0.0))
    step = min(_STEP, _PHASE / turned) if turned and not kept else _STEP
    figures = {TIME: (longer, step)}
    return figures | ({RATES: (faster, _SMALL_STEP if kept else step)} if len(line.moving_pieces) else {})


def _timed(time: float, rate: float, plan: Schedule) -> Schedule:
    """The plan with all times and all rates multiplied by factors; the temperatures that it visits stay."""
    course = plan.programme
    return replace(
        plan,
        duration=plan.duration * time,
        ramp=plan.ramp * time,
        peak_rate=plan.peak_rate * rate,
        programme=replace(course, durations=course.durations * time, slopes=course.slopes / time),
    )


def _turned(rate: float, time: float, plan: Schedule) -> Schedule:
    """The plan with the rates and the times of its turns multiplied by factors."""
    longer = np.where(plan.peak_rate != 0.0, time, 1.0)
    return replace(plan, duration=plan.duration * longer, ramp=plan.ramp * longer, peak_rate=plan.peak_rate * rate)


def _integrated(time: float, plan: Schedule) -> Schedule:
    """The plan of the standard method with longer integrations."""
    course = plan.programme
    held = plan.duration * np.where(np.arange(len(plan.duration)) > 0, time, 1.0)
    more = np.sum(held) - np.sum(plan.duration)
    longer = course.durations + np.where(course.durations > 0.0, more, 0.0)
    return replace(plan, duration=held, programme=replace(course, durations=longer))


def _slopes(logs: Callable[[float], np.ndarray], step: float) -> np.ndarray:
    """d logs/d ln(factor), by central differences of two steps and Richardson's extrapolation."""
    near, far = ((logs(np.exp(h)) - logs(np.exp(-h))) / (2.0 * h) for h in (0.5 * step, step))
    return near + (near - far) / 3.0


def _texts(value: Any, key: str) -> Iterator[tuple[str, str]]:
    if isinstance(value, Mapping):
        for name, entry in cast("Mapping[str, Any]", value).items():
            yield from _texts(entry, f"{key}.{name}" if key else name)
    elif isinstance(value, list):
        for k, entry in enumerate(cast("list[Any]", value)):
            yield from _texts(entry, f"{key}[{k}]")
    elif isinstance(value, str):
        yield key, value


def _number(text: str) -> float:
    return parse(text, dimension_of(unit_of(text)))
