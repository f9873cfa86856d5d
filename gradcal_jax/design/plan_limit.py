"""Proven lower limits on any plan with the rig and time of a spec, and the efficiency of the spec's plan: of the scale
factors and biases of gyros.

A **bias** `ψ(T)ᵀβ` under white noise and drift: with all else known exactly and the error itself observed at every
instant of the data, moving or not, generalised least squares has a known covariance of β; every row of any plan is a
function of these observations.

A **scale factor** is also a function of the rate: its limit is that of an axis (`design.limit`) that turns all the time
that it has the table, in white noise and under what multiplies its rate. Where the gyro is alone on a table of one
axis, readings, drift and clock count, too; the errors of an encoder that other channels see are no noise.

A **heading** after a mission depends on both: its limit is the larger one of those with one of the maps known.
"""

from dataclasses import replace
from typing import NamedTuple

import equinox as eqx
import numpy as np

from gradcal_jax import motion as trajectory
from gradcal_jax.design.criteria import Criterion, criterion_of
from gradcal_jax.design.limit import Limit
from gradcal_jax.design.limit import limit as relaxed_limit
from gradcal_jax.design.noise_floor import (
    PRIOR_OF_WALK,
    Course,
    Windows,
    between_knots,
    bias_seen_continuously,
    least_noise_density,
    middles_of_parts,
    scale_factor_floor,
    sensor_course,
)
from gradcal_jax.design.visits import LEAST_TURN, ResolvedCycle, cycle_of, motion_time, with_motion
from gradcal_jax.information import statistic
from gradcal_jax.information.imu_residual import box, imu_residual
from gradcal_jax.information.prediction import requirement_rows
from gradcal_jax.information.unseen import floor_of_plan
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
from gradcal_jax.model.build import chamber_programme
from gradcal_jax.model.imu_build import BuiltImu, build_imu
from gradcal_jax.motion import EARTH_RATE
from gradcal_jax.spec.absent import with_typical
from gradcal_jax.spec.design import Design
from gradcal_jax.spec.requirement import Requirement
from gradcal_jax.spec.spec import expect_spec
from gradcal_jax.spec.spec_sections import Spec
from gradcal_jax.tables.display import summary
from gradcal_jax.units import time_text

_MOST_WINDOWS = 40
# An axis this near to a gyro's is the same, by 1 less the cosine.
_ALONG = 1e-12
# Lags that differ by a smaller share are equal.
_APART = 1e-6
# What requirements there are proofs for.
_PROVEN = ("gyro_scale_factor", "gyro_bias", "mission_heading")
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
    design = spec.design or Design()
    if motion is None and (design.max_motion or design.max_total):
        motion = motion_time(spec, design)
    proofs = _proofs(spec if motion is None else with_motion(spec, motion))
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
    the rig that the proof leaves out; `kept`: what all plans of the proof have in common; both in words."""

    requirement: Requirement
    certified: float
    reached: float
    relaxed: tuple[str, ...]
    kept: tuple[str, ...]


def _proofs(spec: Spec) -> list[Proof]:
    """The limit of every requirement of a gradient plan for which there is a proof. Errors: `ValueError` for none."""
    built = build_imu(spec)
    data, proven = _PlanData(built), list[Proof]()
    for requirement in spec.requirement:
        axis = requirement.axis
        channels = [c for c in built.model.channels if c.kind == "gyro"]
        # Of several gyros the first, since all are alike.
        channel = next((c for c in channels if axis in ("worst", "all", AXIS_NAMES[c.axis])), None)
        if channel is not None and requirement.quantity in _PROVEN:
            bounds = _Gyro(data, channel).bounds(requirement)
            if bounds:
                certified = max(bounds, key=lambda bound: bound[0].certified)
                proven.append(Proof(requirement, *certified[0], certified[1], data.kept))
    if not proven:
        raise ValueError(
            "limits are proven for the biases and polynomial scale factors of gyros; the spec has no requirement on "
            "any of these"
        )
    return proven


class _PlanData:
    """The used data of a plan, `time` s in all: `spans`, and `windows`, divided where the chamber's slope changes (s);
    the `chamber`'s programme. Of an axis that has the table in visits: when it has it, `visits` (`tied`: at those times
    alone), and for how long, `turning` s. `kept`: in words."""

    def __init__(self, built: BuiltImu) -> None:
        spec = built.spec
        schedule = spec.gradient_schedule
        self.built, (self.chamber, _) = built, chamber_programme(schedule)
        self.spans: Windows = [(s.start, s.start + s.duration) for s in schedule.stretches]
        self.windows = between_knots(self.spans, self.chamber.times())
        self.time = self.turning = sum(end - begin for begin, end in self.spans)
        self.visits, self.tied, self.cycle = self.spans, True, None
        if spec.turns_one_gyro and schedule.steps:
            self.cycle = cycle = cycle_of(spec)
            assert cycle is not None
            own = sum(move.repeat * move.duration for move in cycle.moves if not move.other_axes)
            # An axis that no other axis waits for has the table all the time, whatever the cycles leave.
            if own < cycle.duration * (1.0 - 1e-9):
                self.visits = [w for begin, end in self.spans for w in _visits(cycle, begin, end - begin)]
                # A cycle of another length may have a little more or less of the same share.
                total = sum(end - begin for begin, end in self.visits)
                self.turning = max(total, self.time * own / cycle.duration)
                free = () if spec.design is None else spec.design.free
                self.tied = "cycle" not in free and len(self.visits) <= _MOST_WINDOWS
        same = ", at the same times as in this plan" if self.tied and self.visits is not self.spans else ""
        at_table = f"{time_text(float(round(self.turning)))} at the table{same}"
        self.kept = (at_table, "the chamber follows the temperatures of this plan")

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


class _Gyro:
    """A gyro of a unit as if it were alone, with the noise of an angle's readings where it is."""

    def __init__(self, data: _PlanData, channel: Channel) -> None:
        self.data, of, built = data, channel.model, data.built
        self.alone = _has_the_table_alone(built, channel)
        self.of_bias, self.of_scale = of.bias, of.scale
        processes, reference = of.processes, None
        if self.alone:
            encoder, clock = built.model.encoder, built.spec.sensor.clock_error
            reference = angle_reference(float(encoder.reading[0]), float(encoder.offset[0]))
            processes = processes + constant(clock, rate_gain=1.0) if clock else processes
        bias, scale = (None if term is None else replace(term, late=None) for term in (of.bias, of.scale))
        self.model = gyro_model(bias, scale, float(of.angle_random_walk), processes, reference)

    def bounds(self, requirement: Requirement) -> list[tuple[Limit, tuple[str, ...]]]:
        """Limits of a requirement in SI, and what their proofs leave out."""
        criterion, model = criterion_of(self.model, requirement), self.model
        if requirement.quantity == "mission_heading" and not self.alone:
            return []
        bias, scale = (criterion.rows[:, model.where(name)] for name in (BIAS, SCALE_FACTOR))
        both, found = bool(np.any(bias) and np.any(scale)), list[tuple[Limit, tuple[str, ...]]]()
        if np.any(bias):
            found.append(self._bias(criterion, np.asarray(bias)))
        if np.any(scale) and model.scale is not None and isinstance(model.scale.rate, Polynomial):
            found.append(self._scale(criterion, None if both else box(requirement)))
        if criterion.alone is None:
            return found
        more = "the calibration contains the discrepancy as far as the data determine it"
        return [(of, (*words, more)) for of, words in found]

    def _bias(self, criterion: Criterion, rows: np.ndarray) -> tuple[Limit, tuple[str, ...]]:
        """The limit of a bias, or of a part of an error, under white noise and drift, seen continuously."""
        data, model = self.data, self.model
        assert self.of_bias is not None
        bias = replace(self.of_bias, late=None, beyond=None)
        walk, course = float(model.angle_random_walk), data.course(self.of_bias)
        deviation = bias_seen_continuously(bias, walk, model.processes, data.windows, course, rows)
        value = statistic(criterion.statistic, deviation.reshape(criterion.shape))
        return Limit(value, value), _RELAXED

    def _scale(self, criterion: Criterion, grid: tuple[np.ndarray, np.ndarray] | None) -> tuple[Limit, tuple[str, ...]]:
        """The limit of a scale factor on a `grid` (°C, rad/s), or of a part of an error (None)."""
        data, model, built = self.data, self.model, self.data.built
        assert self.of_scale is not None
        course = data.course(self.of_scale)
        turning = data.visits if data.tied else data.spans
        density, relaxed = _noise_density(model, *_spacing(data))
        if not data.tied:
            relaxed.append(
                "the turns may be at any time; only their total time is limited, to the axis's part of a cycle"
            )
        if grid is None:
            sure = np.zeros(len(criterion.rows))
            relaxed += ["the bias is known", "errors that multiply the rate are left out"]
        else:
            windows = between_knots(turning, data.chamber.times())
            sure = np.repeat(scale_factor_floor(model, windows, course, grid[0]), len(grid[1]))
        result = relaxed_limit(
            criterion,
            model,
            motion_time=data.turning,
            temperatures=course(middles_of_parts(turning))[0],
            max_rate=_fastest(built, alone=self.alone),
            noise_density=density,
            floor=sure,
            prior_share=PRIOR_OF_WALK if np.any(sure) else 1.0,
        )
        return result, tuple(relaxed) if self.alone else _RELAXED


def _noise_density(model: SensorModel, spacing: float, apart: float) -> tuple[float, list[str]]:
    """The least noise density (rad²/s) of any motion, and what the proof leaves out. Readings are `spacing` s apart or
    more, standstills `apart` s."""
    reference = model.reference
    relaxed = ["acceleration and travel"]
    if float(reference.reading_noise) > 0.0:
        often = f"the angle is read at most every {spacing:.3g} s"
        relaxed.append(f"{often}, also during moves (a plan with more frequent readings may leave a smaller error)")
    density = least_noise_density(model, spacing)
    if float(reference.standstill_offset) > 0.0:
        # An offset is one draw a standstill.
        other = eqx.tree_at(lambda m: m.reference.reading_noise, model, reference.standstill_offset)
        density = max(density, least_noise_density(other, apart))
        relaxed.append(f"the time between standstills can be as short as {apart:.3g} s")
    return density, relaxed


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


def _has_the_table_alone(built: BuiltImu, channel: Channel) -> bool:
    """Whether the unit is one gyro along the table's only axis, as a spec of one axis has it."""
    one = len(built.model.channels) == 1 and built.motion.geometry.axis_count == 1
    if not one or len(built.motion.geometry.mountings) > 1:
        return False
    along = (built.motion.geometry.axes[0] @ built.motion.geometry.mountings[0])[channel.axis]
    return bool(abs(along) > 1.0 - _ALONG)


def _spacing(data: _PlanData) -> tuple[float, float]:
    """The least time between readings, and between standstills (s), of this plan and of any plan in a search."""
    built, cycle = data.built, data.cycle
    turns = [step.move.duration for step in built.spec.gradient_schedule.steps if step.axis >= 0]
    spacings = list(np.asarray(built.model.encoder.every))
    if cycle is not None:
        spacings = [m.read_every for m in cycle.moves if m.read_every is not None]
        spacings.append(cycle.other_read_every or np.inf)
    apart = min([LEAST_TURN, *turns])
    return min([*spacings, apart, _between_readings(built.motion.line)]), apart


def _fastest(built: BuiltImu, *, alone: bool) -> float:
    """The gyro's largest rate, rad/s, the Earth's share included."""
    of, axes = built.motion.geometry, built.spec.rig.table.axis
    if not alone:
        return max(float(axis.max_rate) for axis in axes) + EARTH_RATE
    usable = built.spec.sensor.gyro.usable_rate if built.spec.sensor.gyro is not None else None
    return min(float(axes[0].max_rate), np.inf if usable is None else float(usable)) + abs(
        float(of.base @ of.axes[0] @ of.earth_rate())
    )
