"""Proven lower limits on any plan with the rig and time of a spec, and the efficiency of the spec's plan: of the scale
factors and biases of gyros.

A gyro alone on the only axis of a table has the time that its plan and [design] leave to any plan, with drift, readings
and clock. Of an IMU's gyros in the time of the data of the spec's plan there are two proofs. A **bias** `ψ(T)ᵀβ` under
white noise and drift: with all else known exactly and the error itself observed at every instant, moving or not,
generalised least squares has a known covariance of β; every row of any plan is a function of these observations.

A **scale factor** is also a function of the rate: its limit is that of a single axis (`design.limit`) that turns all
the time, in white noise and under what multiplies its rate. Where the gyro is alone on a table of one axis, it is that
axis's own limit, with drift, readings and clock; the errors of an encoder that other channels see, too, are no noise.
"""

from collections.abc import Sequence
from contextlib import suppress
from dataclasses import replace
from typing import NamedTuple

import equinox as eqx
import numpy as np

from gradcal_jax import design
from gradcal_jax import motion as trajectory
from gradcal_jax.design import Criterion, Limit, bias_seen_continuously, longest_step
from gradcal_jax.design.noise_floor import PARTS, Course, Windows, between_knots, middles_of_parts, sensor_course
from gradcal_jax.design.turn_plan import (
    LEAST_TURN,
    ResolvedCycle,
    criterion_of,
    cycle_of,
    design_of,
    largest_rate,
    motion_time,
    ramp_ends,
    with_motion,
)
from gradcal_jax.information import statistic
from gradcal_jax.information.error_budget import floor_of_plan
from gradcal_jax.information.imu_residual import box, imu_residual
from gradcal_jax.information.prediction import requirement_rows
from gradcal_jax.information.verdicts import UNIT_OF
from gradcal_jax.model import (
    AXIS_NAMES,
    BIAS,
    SCALE_FACTOR,
    Channel,
    Map,
    Polynomial,
    SensorModel,
    angle_reference,
    constant,
    gyro_model,
)
from gradcal_jax.model.build import assemble, chamber_programme
from gradcal_jax.model.imu_build import BuiltImu, build_imu
from gradcal_jax.motion import EARTH_RATE, programme
from gradcal_jax.spec.absent import with_typical
from gradcal_jax.spec.design import TIMES
from gradcal_jax.spec.requirement import GyroScaleFactorRequirement, Requirement
from gradcal_jax.spec.spec import expect_spec
from gradcal_jax.spec.spec_sections import Spec
from gradcal_jax.tables.display import summary
from gradcal_jax.units import time_text

_MOST_WINDOWS = 40
# Most steps of a continuous observation.
_MOST_STEPS = 200_000
# An axis this near to a gyro's is the same, by 1 less the cosine.
_ALONG = 1e-12
# Lags that differ by a smaller share are equal.
_APART = 1e-6
_RELAXED = (
    "everything else is known exactly",
    "the IMU is read continuously, at rest and during moves, with the best distribution of turns and poses",
    "all noise is white, except for the drift of biases",
)


class PlanLimit(NamedTuple):
    """No plan leaves less than `certified` (`unit`) of a requirement; `reached`: the optimum of the relaxed problem.

    `value`: what the spec's plan leaves (None: not observable); `efficiency`: certified over value. `relaxed`: limits
    of the rig that the proof leaves out; `kept`: what all plans of the
    proof have in common; both in words. All of that is by the terms that the spec names; `counted`, `judged`: certified
    and value with those that it omits, at typical figures.
    """

    name: str
    statistic: str
    unit: str
    certified: float
    reached: float
    value: float | None
    efficiency: float | None
    relaxed: tuple[str, ...]
    kept: tuple[str, ...]
    counted: float
    judged: float | None

    __repr__ = summary


def limit(spec: Spec, *, motion: float | None = None) -> list[PlanLimit]:
    """The proven lower limit on the residual of any plan on this rig in this time, for every requirement of a gradient
    plan that has a proof.

    `certified` (proven) and `value` (of the spec's own plan) are in `unit`; `relaxed`: the limits of the
    rig that the proof leaves out. `motion` s: time without soaks, in the place of the plan's or [design]'s; values and
    efficiencies are the plan's. The derivation for a scale factor, a convex problem with its certificate, is in
    `gradcal_jax.design.limit`.

    Errors: `ValueError` where there is no requirement, no proof for one, or another kind of plan.
    """
    spec = expect_spec(spec)
    if not spec.requirement:
        raise ValueError("a limit is proven for requirements; the spec has none: add a [[requirement]]")
    if spec.turns_one_gyro and spec.gradient_schedule.steps:
        proofs = _proofs_of_axis(spec, motion)
    else:
        proofs = _proofs_of_imu(spec if motion is None else with_motion(spec, motion))
    rows = {row.name: row for row in requirement_rows(spec)}
    # What no residual shows, no plan removes: it adds in quadrature, at least its smallest value in the box.
    floors = [floor_of_plan(one) for one in (spec, with_typical(spec))]
    proven: list[PlanLimit] = []
    for r, certified, reached, relaxed, kept in proofs:
        unit, factor = UNIT_OF[r.quantity]
        row, named, every = rows[r.name], 0.0, 0.0
        if r.quantity != "heading":
            named, every = (float(np.min(imu_residual(of, floor, r).values)) for of, floor in floors)
        found, best, counted = (
            float(np.hypot(factor * value, floor))
            for value, floor in ((certified, named), (reached, named), (certified, every))
        )
        share = None if row.decisive is None else found / row.decisive
        bounds = found, best, row.decisive, share
        proven.append(PlanLimit(r.name, r.statistic, unit, *bounds, relaxed, kept, counted, row.judged))
    return proven


class Proof(NamedTuple):
    """A requirement's limit in SI: `certified`, and the optimum of the relaxed problem, `reached`. `relaxed`: limits of
    the rig that the proof leaves out; `kept`: what all plans of the proof have in
    common; both in words."""

    requirement: Requirement
    certified: float
    reached: float
    relaxed: tuple[str, ...]
    kept: tuple[str, ...]


class _Window(NamedTuple):
    """When and at which temperatures a gyro may turn, and the least noise density of its motion.

    `model`: of the channel as if it were alone. `time`, `every`: duration (s) of the axis at the table, and of all
    data. `windows` (s) at the table, and the sensor's `temperature` and its rate there; `used`: windows (s) of all used
    data. Both are empty where the programme is free.
    """

    model: SensorModel
    time: float
    every: float
    temperatures: np.ndarray
    fixed: bool
    max_rate: float
    density: float
    windows: Windows
    used: Windows
    temperature: Course
    relaxed: Sequence[str]

    def of_requirement(self, requirement: Requirement) -> tuple[Limit, tuple[str, ...]]:
        """The limit of a requirement in SI, and what the proof leaves out."""
        criterion = criterion_of(self.model, requirement)
        if requirement.quantity.endswith("scale_factor"):
            result, relaxed = self.of_scale_factor(criterion, *box(requirement)), tuple(self.relaxed)
        else:
            result, relaxed = self._of_functionals(criterion)
        if criterion.alone is not None:
            relaxed = (*relaxed, "the calibration contains the discrepancy as far as the data determine it")
        return result, relaxed

    def of_scale_factor(self, criterion: Criterion, temperatures: np.ndarray, rates: np.ndarray) -> Limit:
        """The limit of a criterion on the scale factor on a grid (°C, rad/s), the bias known."""
        sure = design.scale_factor_floor(self.model, self.windows, self.temperature, temperatures)
        return self._of_scale_factor(criterion, np.repeat(sure, len(rates)))

    def _of_scale_factor(self, criterion: Criterion, sure: np.ndarray) -> Limit:
        """The same; `sure`: a variance that no plan removes."""
        return design.limit(
            criterion,
            self.model,
            motion_time=self.time,
            temperatures=self.temperatures,
            fixed_programme=self.fixed,
            max_rate=self.max_rate,
            noise_density=self.density,
            floor=sure,
            prior_share=design.PRIOR_OF_WALK if np.any(sure) else 1.0,
        )

    def _of_functionals(self, criterion: Criterion) -> tuple[Limit, tuple[str, ...]]:
        """The limit of a combination of bias and scale factor: the larger of two limits with one of the maps known."""
        model = self.model
        rows = np.asarray(criterion.rows)
        of_bias, of_scale = rows[:, model.where(BIAS)], rows[:, model.where(SCALE_FACTOR)]
        bounds: list[tuple[Limit, tuple[str, ...]]] = []
        if np.any(of_scale):
            relaxed = (*self.relaxed, *(["the bias is known"] if model.bias is not None else []))
            if np.any(model.processes.rate_gain):
                relaxed = (*relaxed, "errors that multiply the rate are left out")
            bounds.append((self._of_scale_factor(criterion, np.zeros(len(rows))), relaxed))
        if np.any(of_bias):
            if self.used:
                floor = design.bias_floor(model, self.used, self.temperature, of_bias)
                relaxed = ("the angle is read continuously and without noise",)
            else:
                ends = float(np.min(self.temperatures)), float(np.max(self.temperatures))
                floor = design.bias_floor_anywhere(model, self.every, ends, of_bias)
                relaxed = (
                    "the time is distributed optimally over the temperatures",
                    "the only noise is the random walk",
                )
            relaxed += ("the scale factor is known",) if model.scale is not None else ()
            known = self._seen_continuously(of_bias) if self.used and not np.any(of_scale) else None
            for least in (np.sqrt(floor), known):
                if least is not None:
                    value = statistic(criterion.statistic, least.reshape(criterion.shape))
                    bounds.append((Limit(value, value), relaxed))
        return max(bounds, key=lambda pair: pair[0].certified)

    def _seen_continuously(self, rows: np.ndarray) -> np.ndarray | None:
        """Standard deviations of combinations `rows` of the bias; None: too many steps, or an extended structure."""
        model = self.model
        steps = self.every / longest_step(model.processes)
        if model.bias is None or model.bias.beyond is not None or steps > _MOST_STEPS:
            return None
        white = float(model.angle_random_walk)
        return bias_seen_continuously(model.bias, white, model.processes, self.used, self.temperature, rows)


def _proofs_of_axis(spec: Spec, motion: float | None = None) -> list[Proof]:
    """The limit of every requirement of a gradient plan that turns one gyro. Errors: `ValueError` without a proof.

    `motion` s: time without soaks, in the place of the plan's or [design]'s.
    """
    schedule, of, built = spec.gradient_schedule, spec.design, assemble(spec)
    free = set() if of is None else set(of.free)
    cycle = cycle_of(spec)
    assert cycle is not None
    # A cycle that fills the ramp, as in a recipe, fits only that ramp.
    as_is = motion is None and (of is None or of.minimise in TIMES or 2.0 * cycle.duration > schedule.motion)
    one_ramp: tuple[float, float] | None = None
    with suppress(ValueError):  # of any other programme
        one_ramp = ramp_ends(spec)
    if as_is or one_ramp is None:
        # The plan as it is: its stretches with soaks that are used and every slope.
        free -= {"gradient", "cycle"} if one_ramp is None else set()
        chamber = built.schedule.programme
        spans = [(s.start, s.start + s.duration) for s in schedule.stretches]
    else:
        time = motion or motion_time(spec, design_of(spec))
        chamber = programme(one_ramp[0], [(time, (one_ramp[1] - one_ramp[0]) / time)])
        spans = [(0.0, time)]
    every = sum(end - begin for begin, end in spans)
    own = sum(move.repeat * move.duration for move in cycle.moves if not move.other_axes)
    # An axis that no other axis waits for has the table all the time, whatever the cycles leave.
    alone = own >= cycle.duration * (1.0 - 1e-9)
    visits = spans if alone else [w for begin, end in spans for w in _visits(cycle, begin, end - begin)]
    # A cycle of another length may have a little more or less of the same share.
    total = max(sum(end - begin for begin, end in visits), every * own / cycle.duration)
    tied = alone or ("cycle" not in free and len(visits) <= _MOST_WINDOWS)
    density, relaxed = _noise_density(built.model, *_spacing_of_cycle(cycle, built.trajectory()))
    if not tied:
        relaxed.append("the turns may be at any time; only their total time is limited, to the axis's part of a cycle")
    followed = sensor_course(chamber, built.thermal_lag)
    fixed, windows, used = "gradient" not in free, [], []
    if fixed:
        used = between_knots(spans, chamber.times())
        # With a cycle of free length, the turns may lie anywhere in the used data.
        turning = visits if tied else spans
        temperatures = followed(middles_of_parts(turning))[0]
        windows = between_knots(turning, chamber.times())
    else:
        assert one_ramp is not None
        temperatures = np.linspace(*one_ramp, PARTS)
        relaxed.append("the time is distributed optimally over the temperatures")
        if np.any(built.model.processes.rate_gain):
            relaxed.append("errors that multiply the rate are left out, except for constant ones")
    kept = _kept_in_words(total, when=tied and not alone, fixed=fixed)
    window = _Window(
        built.model,
        total,
        every,
        temperatures,
        fixed,
        largest_rate(spec, []),
        density,
        windows,
        used,
        followed,
        relaxed,
    )
    limits = ((r, *window.of_requirement(r)) for r in spec.requirement)
    return [Proof(r, of.certified, of.reached, relaxed, kept) for r, of, relaxed in limits]


def _kept_in_words(time: float, *, when: bool = False, fixed: bool = True) -> tuple[str, ...]:
    """What the plans of a proof have in common: the `time` at the table (s), `when` it is there, the programme."""
    at_table = f"{time_text(float(round(time)))} at the table" + (", at the same times as in this plan" if when else "")
    return (at_table, *(["the chamber follows the temperatures of this plan"] if fixed else []))


def _noise_density(model: SensorModel, spacing: float, apart: float) -> tuple[float, list[str]]:
    """The least noise density (rad²/s) of any motion, and what the proof leaves out. Readings are `spacing` s apart or
    more, standstills `apart` s."""
    reference = model.reference
    relaxed = ["acceleration and travel"]
    if float(reference.reading_noise) > 0.0:
        often = f"the angle is read at most every {spacing:.3g} s"
        relaxed.append(f"{often}, also during moves (a plan with more frequent readings may leave a smaller error)")
    density = design.least_noise_density(model, spacing)
    if float(reference.standstill_offset) > 0.0:
        # An offset is one draw a standstill.
        other = eqx.tree_at(lambda m: m.reference.reading_noise, model, reference.standstill_offset)
        density = max(density, design.least_noise_density(other, apart))
        relaxed.append(f"the time between standstills can be as short as {apart:.3g} s")
    return density, relaxed


def _spacing_of_cycle(cycle: ResolvedCycle, line: trajectory.Trajectory) -> tuple[float, float]:
    """The least time between readings, and between standstills (s), of this plan and of any plan in a search."""
    turns = [m.duration for m in cycle.moves if not m.is_rest]
    rests = [m.read_every for m in cycle.moves if m.read_every is not None]
    apart = min([LEAST_TURN, *turns])
    return min([*rests, cycle.other_read_every or np.inf, apart, _between_readings(line)]), apart


def _between_readings(line: trajectory.Trajectory) -> float:
    """The least time (s) between two readings of a trajectory."""
    times = np.concatenate([line.start[:1], (line.start + line.duration)[line.read | line.gap]])
    return float(np.min(np.diff(times), initial=np.inf))


def _visits(cycle: ResolvedCycle, start: float, time: float) -> Windows:
    """When the axis has the table (begin, end; s) in a stretch of that time."""
    period = cycle.duration
    count = int((time + period - cycle.moving + 1e-6) // period)
    visits: list[tuple[float, float]] = []
    for begin in start + period * np.arange(count):
        here = float(begin)
        visits.append((here, here))
        for move in cycle.moves:
            there = here + move.repeat * move.duration
            visits.append((there, there)) if move.other_axes else visits.append((visits.pop()[0], there))
            here = there
    return [(begin, end) for begin, end in visits if end > begin]


# --- an IMU's gyros ---------------------------------------------------------------------------------------------------


class _PlanData:
    """The used data of a plan, `time` s in all: `spans`, and `windows`, divided where the chamber's slope changes (s);
    the `chamber`'s programme."""

    def __init__(self, built: BuiltImu) -> None:
        schedule = built.spec.gradient_schedule
        self.built, (self.chamber, _) = built, chamber_programme(schedule)
        self.spans: Windows = [(s.start, s.start + s.duration) for s in schedule.stretches]
        self.windows = between_knots(self.spans, self.chamber.times())
        self.time = sum(end - begin for begin, end in self.spans)

    def course(self, term: Map) -> Course:
        """The course of the temperature that a map follows."""
        lag, late = self.built.spec.sensor.lag, term.late
        if not late:
            return sensor_course(self.chamber, lag)
        if not lag:
            return sensor_course(self.chamber, late.lag)
        # One lag after another, in partial fractions; of two equal ones the limit, to a millionth of the lag.
        then = late.lag if abs(late.lag / lag - 1.0) > _APART else lag * (1.0 + _APART)
        first, second = sensor_course(self.chamber, lag), sensor_course(self.chamber, then)

        def at(t: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
            level, slope = ((lag * a - then * b) / (lag - then) for a, b in zip(first(t), second(t), strict=True))
            return level, slope

        return at


def _proofs_of_imu(spec: Spec) -> list[Proof]:
    """The limit of every requirement of a gradient plan for which there is a proof. Errors: `ValueError` for none."""
    seen = _PlanData(build_imu(spec))
    kept = _kept_in_words(seen.time)
    proven: list[Proof] = []
    for r in spec.requirement:
        temperatures = np.linspace(float(r.temperature[0]), float(r.temperature[1]), r.grid[0])
        bound = None
        if isinstance(r, GyroScaleFactorRequirement):
            bound = _of_scale_factor(seen, r, temperatures)
        elif r.quantity == "gyro_bias":
            bound = _of_bias(seen, r, temperatures)
        if bound is not None:
            proven.append(Proof(r, *bound, kept))
    if not proven:
        raise ValueError(
            "limits are proven for the biases and polynomial scale factors of gyros; the spec has no requirement on "
            "any of these"
        )
    return proven


def _of_bias(
    seen: _PlanData, requirement: Requirement, temperatures: np.ndarray
) -> tuple[float, float, tuple[str, ...]] | None:
    """The limit of a bias under white noise and drift, seen continuously; None for an extended structure."""
    model = _gyro_of(seen.built, requirement).model
    if model.bias is None or model.bias.beyond is not None:
        return None
    bias = replace(model.bias, late=None)
    white, rows = float(model.angle_random_walk), bias.values(temperatures, 0.0 * temperatures)
    course = seen.course(model.bias)
    deviation = bias_seen_continuously(bias, white, model.processes, seen.windows, course, rows)
    value = statistic(requirement.statistic, deviation[:, None])
    return value, value, _RELAXED


def _of_scale_factor(
    seen: _PlanData, requirement: GyroScaleFactorRequirement, temperatures: np.ndarray
) -> tuple[float, float, tuple[str, ...]] | None:
    """The limit for a gyro that turns all the time, at up to the rate of the rig's fastest axis."""
    built = seen.built
    channel = _gyro_of(built, requirement)
    scale, processes = channel.model.scale, channel.model.processes
    if scale is None or not isinstance(scale.rate, Polynomial) or scale.beyond is not None:
        return None
    course, reference, scale = seen.course(scale), None, replace(scale, late=None)
    if alone := _has_the_table_alone(built, channel):
        # Other channels would show the encoder's errors and the clock's, which are left out.
        encoder, clock = built.model.encoder, built.spec.sensor.clock_error
        reference = angle_reference(float(encoder.reading[0]), float(encoder.offset[0]))
        processes = processes + constant(clock, rate_gain=1.0) if clock else processes
    model = gyro_model(None, scale, float(channel.model.angle_random_walk), processes, reference)
    density, relaxed = _noise_density(model, *_spacing(built))
    at, fastest = course(middles_of_parts(seen.spans))[0], (_fastest_along if alone else _fastest_rate)(built)
    time, windows = seen.time, seen.windows
    window = _Window(model, time, time, at, True, fastest, density, windows, windows, course, relaxed)
    rates = np.linspace(float(requirement.rate[0]), float(requirement.rate[1]), requirement.grid[1])
    criterion = design.criterion(model, SCALE_FACTOR, temperatures, rates, requirement.statistic)
    result = window.of_scale_factor(criterion, temperatures, rates)
    return result.certified, result.reached, tuple(relaxed) if alone else _RELAXED


def _gyro_of(built: BuiltImu, requirement: Requirement) -> Channel:
    """The gyro of a requirement; for "worst" and "all" the first, since all are alike."""
    axis = requirement.axis
    return next(c for c in built.model.channels if c.kind == "gyro" and axis in ("worst", "all", AXIS_NAMES[c.axis]))


def _fastest_rate(built: BuiltImu) -> float:
    """The unit's largest rate, rad/s."""
    return max(float(axis.max_rate) for axis in built.spec.rig.table.axis) + EARTH_RATE


def _has_the_table_alone(built: BuiltImu, channel: Channel) -> bool:
    """Whether the unit is one gyro along the table's only axis, as a spec of one axis has it."""
    one = len(built.model.channels) == 1 and built.motion.geometry.axis_count == 1
    if not one or len(built.motion.geometry.mountings) > 1:
        return False
    along = (built.motion.geometry.axes[0] @ built.motion.geometry.mountings[0])[channel.axis]
    return bool(abs(along) > 1.0 - _ALONG)


def _spacing(built: BuiltImu) -> tuple[float, float]:
    """The least time between readings, and between standstills (s), of this plan and of any plan in a search."""
    apart = min([LEAST_TURN, *(step.move.duration for step in built.spec.gradient_schedule.steps if step.axis >= 0)])
    return min([*np.asarray(built.model.encoder.every), apart, _between_readings(built.motion.line)]), apart


def _fastest_along(built: BuiltImu) -> float:
    """The largest rate (rad/s) of the gyro along the table's only axis, the Earth's share included."""
    of = built.motion.geometry
    return float(built.spec.rig.table.axis[0].max_rate) + abs(float(of.base @ of.axes[0] @ of.earth_rate()))
