"""The objective of a spec's [design], as `predict` evaluates a plan: what it leaves of the requirements, over their
targets, in every scenario; and the tests for structure that a map hides, polynomials of higher degree.

The residual never falls when a standard deviation of the noise rises: the covariance of the estimate grows with that of
the readings. So the worst case of `uncertain` figures has every standard deviation at its largest and the best at its
smallest. The effect of a correlation time has no known sign, so both its ends and the written value are tried.
"""

import math
from collections.abc import Sequence
from dataclasses import replace
from itertools import product
from statistics import fmean
from typing import Any, Final, Literal, NamedTuple, cast

import equinox as eqx
import numpy as np

from gradcal_jax.design import KEPT, Missed, Optimality
from gradcal_jax.design.pose_cycle import EXCESS
from gradcal_jax.information import (
    Posterior,
    SquareRootInformation,
    gains_of_shares,
    kept,
    noticed_from,
    power,
    quantiles,
    square_root,
    where_hidden,
)
from gradcal_jax.information.error_budget import own_of_imu
from gradcal_jax.information.imu_residual import ImuResidual, imu_residual, quantity_of
from gradcal_jax.information.residual import Statistic
from gradcal_jax.information.verdicts import UNIT_OF, limit_of
from gradcal_jax.model import AXIS_NAMES, BIAS, DISCREPANCY, SCALE_FACTOR, Discrepancy, ImuModel, SensorModel, make_map
from gradcal_jax.model.build import basis
from gradcal_jax.model.imu_build import (
    BuiltImu,
    build_imu,
    hung_alike,
    imu_posterior,
    information_with_gears,
)
from gradcal_jax.spec.bases import RatePolynomial, TemperaturePolynomial
from gradcal_jax.spec.changes import changed
from gradcal_jax.spec.design import ALL, OPTIMALITIES, TIMES, WORST, Design, Notice, Scenario
from gradcal_jax.spec.requirement import Requirement
from gradcal_jax.spec.sensor import ScaleFactor
from gradcal_jax.spec.spec_sections import Spec
from gradcal_jax.tables.contracts import NoticeRow
from gradcal_jax.tables.quantity import Quantity

# With more uncertain correlation times than this, each end is tried alone, the others as they are written.
_TOGETHER = 2


def scenario_specs(spec: Spec) -> list[tuple[Spec, float]]:
    """The spec of each scenario, with its weight; the spec itself where nothing is uncertain.

    For a design that minimises the worst case, every standard deviation is at its largest. For one that minimises the
    mean, the figures are as written, and each end of each alone, all with the same weight.
    """
    robust = "mean" if spec.design is None else spec.design.robust
    scenarios = spec.design.scenario if spec.design is not None else ()
    chosen = [(changed(spec, overrides(s)), float(s.weight)) for s in scenarios]
    return [
        (changed(one, values) if values else one, weight)
        for one, weight in chosen or [(spec, 1.0)]
        for values in (_corners(one, 1) if robust == "worst" else _star(one))
    ]


def extremes(spec: Spec) -> list[Spec]:
    """Specs that include the best and the worst case of uncertain figures; none where nothing is uncertain."""
    if not spec.sensor.uncertain_figures():
        return []
    return [changed(spec, values) for end in (0, 1) for values in _corners(spec, end)]


def overrides(scenario: Scenario) -> dict[str, Any]:
    """A scenario's values by their dotted keys."""
    return dict(_leaves({"sensor": scenario.sensor, "rig": scenario.rig}, ""))


def _leaves(tables: dict[str, Any], before: str):
    for name, value in tables.items():
        key = f"{before}.{name}" if before else name
        if isinstance(value, dict):
            yield from _leaves(value, key)
        else:
            yield key, value


def _star(spec: Spec) -> list[dict[str, str]]:
    figures = spec.sensor.uncertain_figures()
    return [{}, *({key: ends[k].text} for key, ends in figures.items() for k in (0, 1))]


def _corners(spec: Spec, end: Literal[0, 1]) -> list[dict[str, str]]:
    figures = spec.sensor.uncertain_figures()
    sizes = {key: ends[end].text for key, ends in figures.items() if not _is_time(key)}
    times: dict[str, tuple[Quantity, Quantity]] = {key: ends for key, ends in figures.items() if _is_time(key)}
    if len(times) > _TOGETHER:
        some: list[dict[str, str]] = [{}, *({key: e.text} for key, ends in times.items() for e in ends)]
    else:
        choices = [[None, *(e.text for e in ends)] for ends in times.values()]
        some = [
            {key: text for key, text in zip(times, texts, strict=True) if text is not None}
            for texts in product(*choices)
        ]
    return [sizes | one for one in some]


def _is_time(key: str) -> bool:
    return key.endswith("correlation_time")


FALSE_ALARM = 0.01
"""Level of the test if [design] of the spec states none."""
_POWER = 0.9
# Number of degrees beyond the structure that are tested by default.
_MORE = 2
# A standard deviation for maps that have none of their own; the result does not depend on it.
NOTIONAL = {BIAS: 10.0 / UNIT_OF["bias"][1], SCALE_FACTOR: 100.0 / UNIT_OF["scale_factor"][1]}


class TestedMap(NamedTuple):
    """The polynomials beyond the structure, up to these degrees; `std` (1, rad/s) of each where the spec has one."""

    temperature_degree: int
    rate_degree: int
    std: float | None
    false_alarm: float = FALSE_ALARM
    power: float = _POWER

    __test__ = False


def tested_maps(spec: Spec) -> dict[str, TestedMap]:
    """The test of every polynomial map, by quantity, with degrees and size of its discrepancy or `notice`."""
    maps: dict[str, TestedMap] = {}
    gyro = spec.sensor.gyro
    if gyro is None:
        return maps
    bias, scale = gyro.bias, gyro.scale_factor
    if bias is not None and isinstance(bias.temperature, TemperaturePolynomial):
        of = bias.discrepancy
        degree = bias.temperature.degree + _MORE if of is None else of.temperature_degree
        maps[BIAS] = TestedMap(degree, 0, None if of is None else float(of.standard_deviation))
    if scale is None or not isinstance(scale.temperature, TemperaturePolynomial):
        return maps
    if not isinstance(scale.rate, RatePolynomial):
        return maps
    of = scale.discrepancy
    notice = spec.design.notice if spec.design is not None else None
    degrees = [scale.temperature.degree + _MORE, scale.rate.degree + _MORE]
    if of is not None:
        degrees = [of.temperature_degree, of.rate_degree]
    elif notice is not None:
        notice_degrees = (notice.temperature_degree, notice.rate_degree)
        degrees = [own if a is None else a for own, a in zip(degrees, notice_degrees, strict=True)]
    stated = notice if notice is not None else of
    maps[SCALE_FACTOR] = TestedMap(
        degrees[0],
        degrees[1],
        None if stated is None else float(stated.standard_deviation),
        *(() if notice is None else (float(notice.false_alarm), float(notice.power))),
    )
    return maps


def with_hidden(spec: Spec, model: SensorModel, quantity: str) -> SensorModel:
    """The model with the hidden map of a quantity as its last term, where it has no discrepancy of its own.

    No criterion includes that term: it is only tested for.
    """
    if where_hidden(model, quantity) is not None:
        return model
    of = tested_maps(spec)[quantity]
    gyro = spec.sensor.gyro
    assert gyro is not None
    section = gyro.bias if quantity == BIAS else gyro.scale_factor
    assert section is not None
    beyond = make_map(
        basis(section.temperature),
        basis(section.rate) if isinstance(section, ScaleFactor) else None,
        discrepancy=(NOTIONAL[quantity], of.temperature_degree, of.rate_degree),
    ).beyond
    assert beyond is not None
    return eqx.tree_at(lambda m: m.terms, model, (*model.terms, beyond))


def imu_with_hidden(spec: Spec, model: ImuModel) -> ImuModel:
    """The IMU with the hidden scale-factor map of each gyro."""
    hidden = (with_hidden(spec, c.model, SCALE_FACTOR) if c.kind == "gyro" else c.model for c in model.channels)
    channels = tuple(replace(c, model=of) for c, of in zip(model.channels, hidden, strict=True))
    return ImuModel(channels, model.installation, model.encoder)


def hidden_test(model: SensorModel, notice: Notice, begin: int) -> Missed:
    """The test of a `model` for its hidden scale-factor map; its parameters begin at `begin`."""
    term, where = cast("Any", where_hidden(model, SCALE_FACTOR))
    below = quantiles(term.size, float(notice.false_alarm))
    return Missed(
        term.std, np.asarray(float(notice.standard_deviation)), below, (begin + where.start, begin + where.stop)
    )


def hidden_maps(spec: Spec, model: SensorModel) -> list[tuple[Discrepancy, float]]:
    """The hidden maps that a log of the spec's sensor is tested for, with the false-alarm level of each test."""
    maps = [(where_hidden(with_hidden(spec, model, name), name), of) for name, of in tested_maps(spec).items()]
    return [(hidden[0], of.false_alarm) for hidden, of in maps if hidden is not None]


def _knowing(info: SquareRootInformation, own: slice, others: Sequence[slice]) -> tuple[slice, SquareRootInformation]:
    """Where `own` parameters stand in the information with those of `others` known to be zero, and that information."""
    keep = np.ones(len(info.scale), bool)
    for other in others:
        keep[other] = False
    begin = int(keep[: own.start].sum())
    rows = (info.factor * info.scale[None, :])[:, keep]
    return slice(begin, begin + own.stop - own.start), square_root(rows)


def noticing(unit: BuiltImu) -> tuple[NoticeRow, ...]:
    """The power of the plan's tests for hidden structure, for each gyro and each polynomial map."""
    tested, spec = tested_maps(unit.spec), unit.spec
    gyros = [c for c in unit.model.channels if c.kind == "gyro"]
    if not tested or not gyros:
        return ()
    channels, added = list(unit.model.channels), list[tuple[int, str]]()
    for number, channel in enumerate(channels):
        of = channel.model
        for quantity in tested if channel.kind == "gyro" else ():
            if where_hidden(of, quantity) is None:
                added.append((channel.axis, quantity))
            of = with_hidden(spec, of, quantity)
            place = next(k for k, t in enumerate(of.terms) if t.name == DISCREPANCY.format(quantity))
            of = eqx.tree_at(lambda m, k=place: m.terms[k].std, of, np.asarray(NOTIONAL[quantity]))
        channels[number] = replace(channel, model=of)
    model = ImuModel(tuple(channels), unit.model.installation, unit.model.encoder)
    info = information_with_gears([(unit.motion, unit.body_nodes())], model, unit.gears)
    where = lambda axis, quantity: model.where("gyro", axis, DISCREPANCY.format(quantity))  # noqa: E731
    rows: list[NoticeRow] = []
    for channel in gyros:
        for quantity, of in tested.items():
            others = [where(*other) for other in added if other != (channel.axis, quantity)]
            own, believed = _knowing(info, where(channel.axis, quantity), others)
            shares = kept(believed, own, np.asarray(NOTIONAL[quantity]))
            gains = gains_of_shares(np.asarray(shares), NOTIONAL[quantity])
            rows.append(_row(quantity, AXIS_NAMES[channel.axis], of, gains))
    return tuple(rows)


def _row(quantity: str, axis: str, of: TestedMap, gain: np.ndarray) -> NoticeRow:
    unit, factor = UNIT_OF[quantity]
    least = noticed_from(gain, of.power, of.false_alarm)
    return NoticeRow(
        quantity=cast("Any", quantity),
        axis=cast("Any", axis),
        temperature_degree=of.temperature_degree,
        rate_degree=None if quantity == BIAS else of.rate_degree,
        unit=cast("Any", unit),
        components=len(gain),
        false_alarm=of.false_alarm,
        standard_deviation=None if of.std is None else of.std * factor,
        power=None if of.std is None else power(gain, of.std, of.false_alarm),
        sure_power=of.power,
        sure_from=None if least is None else least * factor,
    )


MARGIN: Final = 0.1
"""A target is met with margin if the residual is below the target by this fraction or more."""
MET: Final = f"every target is met with a margin of {MARGIN:.0%}"
NO_TARGET: Final = "to stop when every target is met, give a requirement a target"
MISSED = "the probability of missing a hidden map"
# The smallest chance that counts.
_NEVER = 1e-12


class PlanCase(NamedTuple):
    """A scenario at a place, with its weight."""

    spec: Spec
    weight: float


def cases_of(spec: Spec) -> list[PlanCase]:
    """The spec at each place that hangs differently, in each scenario."""
    return [PlanCase(one, weight * len(names)) for at, names in hung_alike(spec) for one, weight in scenario_specs(at)]


def known_after(cases: Sequence[PlanCase]) -> tuple[list[BuiltImu], list[Posterior]]:
    """What is known after the plans of cases, by the terms that their specs name."""
    builts = [build_imu(case.spec) for case in cases]
    return builts, [own_of_imu(built, imu_posterior(built)) for built in builts]


class Left(NamedTuple):
    """A number of a plan that is no residual: a chance, or an optimality (in ppm or deg/h)."""

    value: float

    def statistic(self, name: Statistic | None = None) -> float | None:
        """The number itself; None: not observable."""
        del name
        return self.value if math.isfinite(self.value) else None


Residuals = Sequence[Sequence[ImuResidual | Left]]


class Aim(NamedTuple):
    """A number of a plan: the statistic of a requirement that counts, and its `limit` (1 where there is none) in its
    `unit`, of which `per_si` are one in SI. `counted` in the objective, or `limiting` the search."""

    name: str
    unit: str
    per_si: float
    statistic: Statistic
    limit: float
    counted: bool
    limiting: bool

    def log(self, left: ImuResidual | Left) -> float:
        """The logarithm of the statistic over its limit."""
        value = left.statistic(self.statistic)
        return math.log(value / self.limit) if value else math.inf


class ExactObjective:
    """What the [design] of a spec minimises: the logarithms of the residuals over their `aims`, in each of its `cases`:
    of the requirements in order, then the probability of missing a hidden map, and an optimality, if there are any.

    Of several counted aims the mean or the `worst`; over the cases the worst, or the mean: of ratios to targets the
    geometric one.
    """

    def __init__(self, spec: Spec) -> None:
        self.spec, self.design = spec, spec.design or Design()
        self.cases = cases_of(spec)
        self.builts = [build_imu(case.spec) for case in self.cases]
        weights = np.array([case.weight for case in self.cases])
        self.weights = weights / np.sum(weights)
        name, notice = self.design.minimise, self.design.notice
        timed = name in TIMES
        self.worst, self.of_logs = timed or name == WORST, name in (ALL, WORST)
        limited = not self.worst and name != ALL
        self.aims: tuple[Aim, ...] = tuple(
            Aim(
                r.name,
                *UNIT_OF[r.quantity],
                *_aim_of(r, self.design),
                (self.worst or name in (ALL, r.name)) and not (timed and r.target is None),
                limited and r.name != name and r.target is not None,
            )
            for r in spec.requirement
        )
        if timed and not any(aim.counted for aim in self.aims):
            raise ValueError(
                f'minimise = "{name}" finds the shortest plan that meets the targets: give at least one requirement a '
                "target"
            )
        if notice is not None:
            self.aims += (Aim(MISSED, "", 1.0, "max", 1.0 - float(notice.power), timed, not timed),)
        if name in OPTIMALITIES:
            kind = "bias" if self.builts[0].model.channels[0].model.scale is None else SCALE_FACTOR
            self.aims += (Aim(name, *UNIT_OF[kind], "max", 1.0, True, False),)
        if not self.aims:
            raise ValueError("the spec has no [[requirement]] to minimise: add one")
        self._quantities = [tuple(quantity_of(built, r) for r in spec.requirement) for built in self.builts]

    def residuals(self, spec: Spec) -> Residuals:
        """What a spec's plan leaves at each place in each scenario, in the order of the aims."""
        builts, known = known_after(cases_of(spec))
        left: list[list[ImuResidual | Left]] = []
        for built, of, quantities in zip(builts, known, self._quantities, strict=True):
            left.append([q.residual(of) for q in quantities])
            if self.design.notice is not None:
                rows = [row.power for row in noticing(built) if row.quantity == SCALE_FACTOR]
                left[-1].append(Left(max(1.0 - min(power or 0.0 for power in rows), _NEVER)))
            if self.design.minimise in OPTIMALITIES:
                left[-1].append(Left(self.aims[-1].per_si * _optimality(built, of, self.design.minimise)))
        return left

    def value_of(self, residuals: Residuals) -> float:
        """What a search minimises: the objective of a plan that leaves these residuals, and the cost of its excess."""
        return self.without_limits(residuals) + EXCESS * sum(self.exceeded(residuals).values())

    def without_limits(self, residuals: Residuals) -> float:
        """The objective alone."""
        logs = [[a.log(r) for r, a in zip(of, self.aims, strict=True) if a.counted] for of in residuals]
        each = [(max if self.worst else fmean)(of) for of in logs]
        if self.design.robust == "worst":
            return max(each)
        if self.of_logs or len(each) == 1 or not math.isfinite(max(each)):
            return float(self.weights @ each)
        return math.log(float(self.weights @ np.exp(each)))

    def shown(self, residuals: Residuals) -> float:
        """The objective alone, in the unit of `name_and_unit`."""
        return self.name_and_unit()[2] * math.exp(self.without_limits(residuals))

    def exceeded(self, residuals: Residuals) -> dict[str, float]:
        """By how much (natural logarithm) targets that are limits are exceeded, summed over the cases, by name."""
        logs = {a.name: [a.log(of[k]) for of in residuals] for k, a in enumerate(self.aims) if a.limiting}
        return {name: sum(max(x, 0.0) for x in of) for name, of in logs.items() if max(of) > 0.0}

    def missed(self, residuals: Residuals) -> dict[str, float]:
        """The same of targets that are exceeded by more than what counts as rounding."""
        return {name: by for name, by in self.exceeded(residuals).items() if by > KEPT}

    def name_and_unit(self) -> tuple[str, str, float]:
        """Name and unit of the objective for people, and how many of the unit are one of `value_of`, exponentiated."""
        counted = [aim for aim in self.aims if aim.counted]
        if self.worst or len(counted) > 1:
            name = "largest residual" if self.worst else "geometric mean of all residuals"
            rows = [r for r, aim in zip(self.spec.requirement, self.aims, strict=False) if aim.counted]
            return name, "of the target" if all(r.target is not None for r in rows) else "", 1.0
        (aim,) = counted
        of_map = "" if aim.name in OPTIMALITIES else f" ({aim.statistic})"
        return aim.name + of_map, aim.unit, aim.limit

    def met(self, residuals: Residuals) -> bool:
        """Whether every target is met by its rule with `MARGIN`, and a hidden map noticed, in every case. Errors:
        `ValueError` where there is no target."""
        aims = [limit_of(r) for r in self.spec.requirement]
        if all(aim is None for aim in aims):
            raise ValueError(NO_TARGET)
        left = [(r.statistic(a[0]), a[1]) for of in residuals for r, a in zip(of, aims, strict=False) if a is not None]
        met = all(value is not None and value <= (1.0 - MARGIN) * limit for value, limit in left)
        return met and MISSED not in self.exceeded(residuals)


def residuals_of_plan(spec: Spec) -> dict[str, ImuResidual]:
    """What a spec's own plan leaves of every requirement, without scenarios; of a fixture where that is worst."""
    builts, known = known_after([PlanCase(at, 1.0) for at, _ in hung_alike(spec)])
    return {
        r.name: max((imu_residual(*of, r) for of in zip(builts, known, strict=True)), key=ImuResidual.finite_statistic)
        for r in spec.requirement
    }


class RequirementChange(NamedTuple):
    """A requirement's statistic (`unit`, 1σ, by the terms that the spec names) before and after a search; None: not
    observable."""

    name: str
    unit: str
    before: float | None
    now: float | None


def requirement_changes(spec: Spec, plan: Spec) -> tuple[RequirementChange, ...]:
    """What two plans of a spec leave of its requirements."""
    both = [residuals_of_plan(one) for one in (spec, plan)]
    return tuple(
        RequirementChange(r.name, UNIT_OF[r.quantity][0], *(of[r.name].statistic() for of in both))
        for r in spec.requirement
    )


def _aim_of(requirement: Requirement, design: Design) -> tuple[Statistic, float]:
    """The statistic of a requirement that counts, and what it is divided by (`UNIT_OF`): its target by its rule, or 1.
    Of a requirement that alone is minimised its own statistic counts."""
    limit = None if requirement.name == design.minimise else limit_of(requirement)
    return (requirement.statistic, 1.0) if limit is None else limit


def optimality(model: SensorModel, name: str) -> Optimality:
    """The optimality criterion of that name of a gyro's reported coefficients: of its scale factor, if it has one."""
    where = model.where(BIAS if model.scale is None else SCALE_FACTOR)
    return Optimality(model.to_reported[where], cast("Any", name[0]))


def _optimality(built: BuiltImu, known: Posterior, name: str) -> float:
    """The criterion of the first gyro, SI."""
    channel = built.model.channels[0]
    of, where = optimality(channel.model, name), built.model.where(channel.kind, channel.axis)
    part, rows = Posterior(known.spread[where], known.hidden[where]), np.asarray(of.rows)
    return float(of.of_root((rows @ part.spread).T)) if np.all(np.isfinite(part.deviations(rows))) else math.inf
