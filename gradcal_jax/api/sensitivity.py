"""Elasticities of the residual: its change in per cent for one per cent of every figure of sensor, rig and plan.

The derivative of the logarithm of a requirement's residual in the logarithm of the figure, at the plan as it is. For an
optimised plan the derivative is the same after the plan is optimised again, to first order (envelope theorem).

Of one axis by automatic differentiation through timeline, whitening and statistic. Of a whole unit by central
differences: the figures are changed in the spec itself, by a thousandth up and down. Faster turns may change the number
of cycles in the ramp; such a side is left out, and where both are, the figure has no row. Where all times become
longer, the number of readings stays, since an integer has no derivative.
"""

import re
from collections.abc import Iterator, Mapping
from typing import Any, NamedTuple, cast

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np

from gradcal_jax.api.build import Assembled, assemble
from gradcal_jax.api.error_budget import known_sources, scaled
from gradcal_jax.api.posterior_of_plan import UNIT_OF, criterion_of, posterior_of_plan, residual_map, statistic_of
from gradcal_jax.api.systematic import budget_of_plan, own_of_unit, shares_of_variance
from gradcal_jax.api.unit_build import assemble_unit, posterior_of_unit
from gradcal_jax.api.unit_residual import unit_residual
from gradcal_jax.design import Criterion
from gradcal_jax.display import summary
from gradcal_jax.files import Spec
from gradcal_jax.files.changes import changed, tables_of
from gradcal_jax.files.spec import expect_spec, goes_on
from gradcal_jax.files.unit_spec import UnitSpec
from gradcal_jax.information import Posterior, information
from gradcal_jax.model import Discrepancy, EncoderHarmonics, SensorModel
from gradcal_jax.trajectory import Rule, Schedule, rule_of
from gradcal_jax.units import dimension_of, format_quantity, parse, unit_of

# Names of the plan's figures, for people.
TIME, UNIT_TIME = "time: ramp and turns last longer", "time: ramp, rests and turns last longer"
RATES = "rates: all turns faster"
_INTEGRATION, _LAG = "integration time", "thermal lag"
_ENCODER, _DISCREPANCY = "encoder's error by angle", "model discrepancy"


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


def sensitivity(spec: Spec | UnitSpec) -> Sensitivities:
    """The change of each residual, in per cent, for one per cent more of every figure of sensor, rig and plan.

    `rows` of (requirement, figure, percent), the largest first; `residuals` of (value, unit) by requirement, in ppm or
    deg/h, of the axis with the largest. For an optimised plan the change is the same after the plan is optimised again
    (envelope theorem). Those of a whole unit are central differences of the prediction, two predictions a figure.

    Errors: `ValueError` for a spec without requirements, or with one that the plan cannot observe.
    """
    spec = expect_spec(spec)
    if spec.turns_one_gyro and spec.done:
        raise goes_on("a sensitivity")
    if not spec.requirement:
        raise ValueError("the spec has no [[requirement]], so there is nothing to be sensitive: add one")
    residuals, slopes = _of_axis(spec) if spec.turns_one_gyro else _of_unit(spec)
    rows = [
        Elasticity(r.name, figure, float(of[i]))
        for i, r in enumerate(spec.requirement)
        for figure, of in slopes.items()
    ]
    rows.sort(key=lambda row: (row.requirement, -abs(row.percent)))
    shown = {r.name: (float(v), UNIT_OF[r.quantity][0]) for r, v in zip(spec.requirement, residuals, strict=True)}
    return Sensitivities(tuple(rows), shown)


# --- one axis ---------------------------------------------------------------------------------------------------------


def _of_axis(spec: UnitSpec) -> tuple[np.ndarray, dict[str, np.ndarray]]:
    """The residual of every requirement, and the elasticities of all by figure."""
    built = assemble(spec)
    criteria = tuple(criterion_of(built.model, r) for r in spec.requirement)
    names, (schedule,) = _names(built), built.schedules.values()
    rule = rule_of(built.model, schedule.trajectory(built.thermal_lag))
    figures = _Figures(built.model, schedule.padded(), criteria, built.thermal_lag, built.sources, rule)
    values, slopes = map(np.asarray, _logs_and_slopes(figures, tuple(names), jnp.ones(len(names))))
    if not (np.all(np.isfinite(values)) and np.all(np.isfinite(slopes))):
        raise ValueError(
            "the plan cannot observe what is required, so its sensitivity is not defined: see gradcal check"
        )
    factors = np.array([UNIT_OF[r.quantity][1] for r in spec.requirement])
    return _with_unseen(built, np.exp(values) * factors, dict(zip(names, slopes.T, strict=True)))


def _with_unseen(
    built: Assembled, residuals: np.ndarray, rows: dict[str, np.ndarray]
) -> tuple[np.ndarray, dict[str, np.ndarray]]:
    """Residuals and elasticities with what no residual of a run shows, as far as the spec names it."""
    unseen: list[dict[str, float]] = []
    fits: list[float] = []
    channel = built.channels[0]
    budget = budget_of_plan(built, posterior_of_plan(built, channel), channel, built)
    for requirement in built.spec.requirement:

        def value(of: Posterior, requirement=requirement) -> float:
            return statistic_of(requirement, residual_map(built, of, requirement)[2])

        fit, shares = shares_of_variance(budget, "this run", value)
        fits.append(fit)
        unseen.append(shares)
    share = np.array(fits)
    rows = {name: of * share for name, of in rows.items()}
    for name in dict.fromkeys(n for of in unseen for n in of):
        rows[name] = np.array([of.get(name, 0.0) for of in unseen])
    return residuals / np.sqrt(share), rows


class _Figures(eqx.Module):
    """What the elasticities depend on; its arrays are arguments of the compiled program."""

    model: SensorModel
    schedule: Schedule
    criteria: tuple[Criterion, ...]
    thermal_lag: float | None
    sources: dict[str, tuple[int, ...]] = eqx.field(static=True)
    rule: Rule = eqx.field(static=True)


@eqx.filter_jit
def _logs_and_slopes(figures: _Figures, names: tuple[str, ...], factors):
    """Logarithms of the residuals (r,), and their derivatives with respect to those of all figures (r, f)."""

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
    return [*names, TIME, *([RATES] if len(line.moving_pieces) else [])]


def _stretched(plan: Schedule, by: dict) -> Schedule:
    """The plan with its times and rates multiplied by factors; the temperatures that it visits stay."""
    programme = plan.programme
    if plan.rates:
        time = by[_INTEGRATION]
        held = plan.duration * jnp.where(jnp.arange(len(plan.duration)) > 0, time, 1.0)
        more = jnp.sum(held) - jnp.sum(plan.duration)
        longer = programme.durations + jnp.where(programme.durations > 0.0, more, 0.0)
        return eqx.tree_at(lambda p: (p.duration, p.programme.durations), plan, (held, longer))
    time, rate = by[TIME], by.get(RATES, 1.0)
    of = lambda p: (p.duration, p.ramp, p.peak_rate, p.programme.durations, p.programme.slopes)  # noqa: E731
    numbers = plan.duration * time, plan.ramp * time, plan.peak_rate * rate
    return eqx.tree_at(of, plan, (*numbers, programme.durations * time, programme.slopes / time))


# --- a whole unit -----------------------------------------------------------------------------------------------------

_STEP = 1e-3
# Patterns of keys, and the name of their figure for people.
_FIGURES: tuple[tuple[str, str], ...] = (
    (r"sensor\.(gyro|accelerometer)\.(angle|velocity|rate)_random_walk", "{0}: {1} random walk"),
    (r"sensor\.(gyro|accelerometer)\.drift\[\d+\]\.standard_deviation", "{0}: drift"),
    (r"sensor\.(gyro|accelerometer)\.drift\[\d+\]\.correlation_time", "{0}: drift's correlation time"),
    (r"sensor\.gyro\.scale_factor_instability\[\d+\]\.standard_deviation", "gyro: scale-factor instability"),
    (r"sensor\.gyro\.scale_factor_instability\[\d+\]\.correlation_time", "gyro: its correlation time"),
    (r"sensor\.(gyro|accelerometer)\.(\w+)\.prior", "{0}: prior of {1}"),
    (r"sensor\.(gyro|accelerometer)\.(\w+)\.discrepancy\.standard_deviation", "{0}: discrepancy of {1}"),
    (r"sensor\.(gyro|accelerometer)\.(\w+)\.smoothness", "{0}: smoothness of {1}"),
    (r"sensor\.(thermal_lag|sample_clock_error|temperature_offset|temperature_lag)", "{0}"),
    (r"sensor\.gyro\.bias_temperature_gradient", "gyro: bias from dT/dt"),
    (r"rig\.table\.axis\[\d+\]\.angle\.scale_error", "table: scale of the angle"),
    (r"rig\.site\.gravity_accuracy", "accuracy of gravity"),
    (r"rig\.table\.(tilt|azimuth)", "{0} of the base"),
    (r"rig\.table\.axis\[\d+\]\.orthogonality", "angle between the table's axes"),
    (r"rig\.table\.axis\[\d+\]\.angle\.(reading_noise|standstill_offset)", "table: {0}"),
    (r"rig\.table\.axis\[\d+\]\.angle\.harmonics\[\d+\]\.amplitude", "table: encoder's error by angle"),
    (r"rig\.table\.mounting\[\d+\]\.accuracy", "accuracy of the mounting"),
)
# Powers of a common factor of time, by dimension.
_POWERS = {"time": 1, "angular rate": -1, "temperature slope": -1, "angular acceleration": -2}
_RIG = r"rig\.(table\.axis\[\d+\]\.max_(rate|acceleration)|chamber\.max_(heating|cooling))"
_PLAN = r"plan\.(gradient|soak\.duration|programme\[\d+\]\.(soak|rate))"
_MOVES = r"plan\.cycle\.moves\[\d+\]\.(rest|duration|peak_rate|period|ramp)"


def _of_unit(spec: UnitSpec) -> tuple[np.ndarray, dict[str, np.ndarray]]:
    """The same of a unit's requirements."""
    nominal = _residuals(spec)
    hidden = [r.name for r, value in zip(spec.requirement, nominal, strict=True) if not np.isfinite(value)]
    if hidden:
        names = ", ".join(hidden)
        raise ValueError(f"the plan cannot observe {names}, so its sensitivity is not defined: see gradcal check")
    slopes = {figure: _elasticity(spec, powers, nominal) for figure, powers in sensitive_figures(spec).items()}
    return nominal, {figure: of for figure, of in slopes.items() if of is not None}


def sensitive_figures(spec: UnitSpec) -> dict[str, dict[str, int]]:
    """The figures of a spec by name, each with its keys and their powers of the factor."""
    figures: dict[str, dict[str, int]] = {}
    time = {f"rig.table.axis[{k}].angle.read_every": 1 for k in range(len(spec.rig.table.axis))}
    rates: dict[str, int] = {}
    for key, text in _texts(tables_of(spec), ""):
        if key == "sensor.sample_clock_error" and spec.sensor.takes_host_clock:
            continue
        for pattern, name in _FIGURES:
            if (match := re.fullmatch(pattern, key)) is not None and _number(text) != 0.0:
                words = (group.replace("_", " ") for group in match.groups())
                figures.setdefault(name.format(*words), {})[key] = 1
        if re.fullmatch(f"{_RIG}|{_PLAN}|{_MOVES}", key):
            time[key] = _POWERS[dimension_of(unit_of(text))]
            if not re.fullmatch(_PLAN, key) and not key.endswith(".rest") and "chamber" not in key:
                rates[key] = -time[key]
    moving = any(step.axis >= 0 for step in spec.gradient_schedule.steps)
    return figures | {UNIT_TIME: time} | ({RATES: rates} if moving else {})


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


def _elasticity(spec: UnitSpec, powers: Mapping[str, int], nominal: np.ndarray) -> np.ndarray | None:
    """d ln(residuals)/d ln(figure), by a central difference where both sides have the plan's number of cycles."""
    texts, cycles = dict(_texts(tables_of(spec), "")), [stretch.cycles for stretch in spec.gradient_schedule.stretches]
    for k, axis in enumerate(spec.rig.table.axis):
        texts.setdefault(f"rig.table.axis[{k}].angle.read_every", str(axis.angle.read_every))
    logs: list[np.ndarray] = []
    places: list[float] = []
    for step in (-_STEP, _STEP):
        scaled = {
            key: format_quantity(_number(texts[key]) * (1.0 + step) ** power, unit_of(texts[key]))
            for key, power in powers.items()
        }
        other = changed(spec, scaled)
        if [stretch.cycles for stretch in other.gradient_schedule.stretches] == cycles:
            logs.append(np.log(_residuals(other)))
            places.append(np.log1p(step))
    if not logs:
        return None
    if len(logs) == 1:
        logs, places = [np.log(nominal), *logs], [0.0, *places]
    return (logs[1] - logs[0]) / (places[1] - places[0])


def _residuals(spec: UnitSpec) -> np.ndarray:
    """The value of every requirement's own statistic; infinite where it is not observable."""
    built = assemble_unit(spec)
    known = own_of_unit(built, posterior_of_unit(built))
    values = (unit_residual(built, known, requirement).statistic() for requirement in spec.requirement)
    return np.array([np.inf if value is None else value for value in values])
