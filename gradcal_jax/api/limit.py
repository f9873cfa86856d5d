"""Proven lower limits on any plan with the rig and time of a spec, the efficiency of the spec's plan, and the proofs
for an IMU, in the time of the data of the spec's plan; those for one gyro are in `axis_limit`.

Two proofs. A **bias** `ψ(T)ᵀβ` under white noise and drift: with all else known exactly and the error itself observed
at every instant, moving or not, generalised least squares has a known covariance of β; every row of any plan is a
function of these observations.

A parameter multiplied by a **signal** s under white noise N² (a column `∫ψ s dt`): with all else known exactly, the
drift too, its information is `∫ψψᵀs²dt/N²` plus its prior's. For the k elements of a quantity that share ψ, N and
prior, the squares of the signals add up to at most `bound` at every instant, because |f| = g and |ω| ≤ the fastest
axis's rate (one axis turns at a time, on the Earth): so their mean information is at most `J = bound/k ∫ψψᵀdt/N² +
prior`. As `(ψᵀJ⁻¹ψ)^½` is convex in J, the mean of their standard deviations, and so the worst and the root mean
square, is at least that of J, at every temperature; and so is every statistic over temperature.

A gyro's scale factor is also a function of the rate: its limit is that of a single axis (`design.limit`) that turns all
the time, in white noise and under what multiplies its rate. Where the gyro is alone on a table of one axis, it is that
axis's own limit, with drift, readings and clock; the errors of an encoder that other channels see, too, are no noise.
"""

from dataclasses import replace
from typing import NamedTuple

import numpy as np

from gradcal_jax import model, trajectory
from gradcal_jax.api.axis_limit import (
    Proof,
    Windows,
    between_readings,
    bias_seen_continuously,
    kept_in_words,
    look_at,
    middles_of_parts,
    noise_density,
    proofs_of_axis,
    sensor_course,
    windows_between_knots,
)
from gradcal_jax.api.build import chamber_programme
from gradcal_jax.api.imu_build import MISALIGNMENT, SECOND_ORDER, BuiltImu, build_imu
from gradcal_jax.api.imu_residual import imu_residual
from gradcal_jax.api.prediction import requirement_rows
from gradcal_jax.api.structures import LEAST_TURN, with_motion
from gradcal_jax.api.systematic import floor_of_plan
from gradcal_jax.api.verdicts import UNIT_OF
from gradcal_jax.design import PRIOR_OF_WALK, criterion, limit, scale_factor_floor
from gradcal_jax.design.noise_floor import Course
from gradcal_jax.display import summary
from gradcal_jax.files.absent import with_typical
from gradcal_jax.files.requirement import GyroScaleFactorRequirement, MisalignmentRequirement, Requirement
from gradcal_jax.files.spec import expect_spec, goes_on
from gradcal_jax.files.spec_sections import Spec
from gradcal_jax.information import square_root, statistic
from gradcal_jax.model import AXIS_NAMES, Channel, Map, Polynomial, SignalMap
from gradcal_jax.trajectory import EARTH_RATE, Programme


class PlanLimit(NamedTuple):
    """No plan leaves less than `certified` (`unit`) of a requirement; `reached`: the optimum of the relaxed problem.

    `value`: what the spec's plan leaves (None: not observable); `efficiency`: certified over value. `relaxed`: limits
    of the rig that the proof leaves out; `kept`: what all plans of the proof have in common; both in words. All of that
    is by the terms that the spec names; `counted`, `judged`: certified and value with those that it omits, at typical
    figures.
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


def limits(spec: Spec, *, motion: float | None = None) -> list[PlanLimit]:
    """The limit of every requirement of a gradient plan for which there is a proof.

    `motion` s: time without soaks, in the place of the plan's or [design]'s; values and efficiencies are the plan's.
    Errors: `ValueError` where there is no requirement, no proof for one, or another kind of plan.
    """
    spec = expect_spec(spec)
    if spec.done:
        raise goes_on("a limit")
    if not spec.requirement:
        raise ValueError("a limit is proven for requirements; the spec has none: add a [[requirement]]")
    if spec.turns_one_gyro and spec.gradient_schedule.steps:
        proofs = proofs_of_axis(spec, motion)
    else:
        proofs = proofs_of_imu(spec if motion is None else with_motion(spec, motion))
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
        proven.append(
            PlanLimit(r.name, r.statistic, unit, found, best, row.decisive, share, relaxed, kept, counted, row.judged)
        )
    return proven


# Longest time step of the integrals of signals, s, and nodes in a step.
_LONGEST_S = 5.0
_NODES = 4
# An axis this near to a gyro's is the same, by 1 less the cosine.
_ALONG = 1e-12
# Lags that differ by a smaller share are equal.
_APART = 1e-6
_RELAXED = (
    "everything else is known exactly",
    "the IMU is read continuously, at rest and during moves, with the best distribution of turns and poses",
    "the noise is white, except for that of biases",
)


def proofs_of_imu(spec: Spec) -> list[Proof]:
    """The limit of every requirement of a gradient plan for which there is a proof. Errors: `ValueError` for none."""
    window = _window(build_imu(spec))
    kept = kept_in_words(window.time)
    proven = [(r, *bound) for r in spec.requirement if (bound := _certified(window, r)) is not None]
    if not proven:
        raise ValueError(
            "for an IMU, limits are proven for biases, polynomial scale factors, misalignments to the table or "
            "the case, acceleration sensitivity and second-order terms; the spec has no requirement on any of "
            "these"
        )
    return [Proof(r, *bound, relaxed, kept) for r, bound, relaxed in proven]


class _Window(NamedTuple):
    """The used data of a plan, `time` s in all: `spans`, and `windows`, divided where the chamber's slope changes (s);
    the `chamber`'s programme."""

    built: BuiltImu
    time: float
    spans: Windows
    windows: Windows
    chamber: Programme

    def course(self, term: Map | SignalMap) -> Course:
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


def _window(built: BuiltImu) -> _Window:
    schedule = built.spec.gradient_schedule
    chamber, _ = chamber_programme(schedule)
    spans = [(s.start, s.start + s.duration) for s in schedule.stretches]
    windows = windows_between_knots(spans, chamber.times())
    return _Window(built, sum(end - begin for begin, end in spans), spans, windows, chamber)


# What a proof yields, in SI: certified, and the optimum of the relaxed problem; and what it leaves out.
_Proof = tuple[tuple[float, float], tuple[str, ...]]


def _certified(window: _Window, requirement: Requirement) -> _Proof | None:
    """A requirement's limit; None without a proof."""
    cold, warm = (float(t) for t in requirement.temperature)
    temperatures = np.linspace(cold, warm, requirement.grid[0])
    if isinstance(requirement, GyroScaleFactorRequirement):
        return _of_scale_factor(window, requirement, temperatures)
    of = _of_bias if requirement.quantity in ("gyro_bias", "accelerometer_bias") else _of_signal
    deviation = of(window, requirement, temperatures)
    if deviation is None:
        return None
    value = statistic(requirement.statistic, deviation[:, None])
    return (value, value), _RELAXED


def _of_scale_factor(
    window: _Window, requirement: GyroScaleFactorRequirement, temperatures: np.ndarray
) -> _Proof | None:
    """The limit for a gyro that turns all the time, at up to the rate of the rig's fastest axis."""
    built = window.built
    channel = _channel(built, "gyro", requirement.axis)
    scale, processes = channel.model.scale, channel.model.processes
    if scale is None or not isinstance(scale.rate, Polynomial) or scale.beyond is not None:
        return None
    course, scale = window.course(scale), replace(scale, late=None)
    rates = np.linspace(float(requirement.rate[0]), float(requirement.rate[1]), requirement.grid[1])
    white = float(channel.model.angle_random_walk)
    if alone := _has_the_table_alone(built, channel):
        # As a spec of one axis. Other channels would show the encoder's errors and the clock's, which are left out.
        encoder, clock = built.model.encoder, built.spec.sensor.clock_error
        reference = model.angle_reference(float(encoder.reading[0]), float(encoder.offset[0]))
        if clock:
            processes = processes + model.constant(clock, rate_gain=1.0)
        seen = model.gyro_model(None, scale, white, processes, reference)
    else:
        seen = model.gyro_model(None, scale, white, processes)
    density, relaxed = noise_density(seen, *_spacing(built), window.spans)
    sure = np.repeat(scale_factor_floor(seen, window.windows, course, temperatures), len(rates))
    result = limit(
        criterion(seen, "scale_factor", temperatures, rates, requirement.statistic),
        seen,
        motion_time=window.time,
        temperatures=course(middles_of_parts(window.spans))[0],
        fixed_programme=True,
        max_rate=_fastest_along(built, channel) if alone else _fastest(built),
        noise_density=density,
        floor=sure,
        prior_share=PRIOR_OF_WALK if np.any(sure) else 1.0,
    )
    return (result.certified, result.reached), tuple(relaxed) if alone else _RELAXED


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
    return min([*np.asarray(built.model.encoder.every), apart, between_readings(built.motion.line)]), apart


def _of_bias(window: _Window, requirement: Requirement, temperatures: np.ndarray) -> np.ndarray | None:
    """Standard deviations of a bias under white noise and drift, seen continuously."""
    channel = _channel(window.built, requirement.quantity.removesuffix("_bias"), requirement.axis)
    term = channel.model.term("bias")
    assert isinstance(term, Map | SignalMap)
    if isinstance(term, Map):
        if term.beyond is not None:
            return None
        bias = replace(term, late=None)
    else:
        bias = model.make_map(
            term.temperature, prior_std=float(term.std) if term.has_prior else np.inf, shapes=term.shapes
        )
    white, rows = float(channel.model.angle_random_walk), bias.values(temperatures, 0.0 * temperatures)
    return bias_seen_continuously(bias, white, channel.model.processes, window.windows, window.course(term), rows)


def _of_signal(window: _Window, requirement: Requirement, temperatures: np.ndarray) -> np.ndarray | None:
    """Standard deviations from the mean information of all elements."""
    built = window.built
    if isinstance(requirement, MisalignmentRequirement) and requirement.relative_to == "internal":
        return None
    kind = "gyro" if requirement.quantity in ("gyro_misalignment", "g_sensitivity") else "accelerometer"
    channels = [
        c for c in built.model.channels if c.kind == kind and requirement.axis in ("worst", "all", AXIS_NAMES[c.axis])
    ]
    most = _most(built, requirement, channels)
    if most is None:
        return None
    name, bound = most
    channel = channels[0]
    term = next(t for t in channel.model.terms if t.name.startswith(name))
    assert isinstance(term, SignalMap)
    nodes, weights = trajectory.quadrature(_NODES)
    look = look_at(window.windows, window.course(term), _LONGEST_S)
    at = (look.begin[:, None] + (look.end - look.begin)[:, None] * nodes)[look.used]
    functions = term.temperature(at.ravel())
    root = np.sqrt((look.duration[look.used, None] * weights).ravel() * bound) / float(channel.model.angle_random_walk)
    rows = np.concatenate([functions * root[:, None], term.prior_rows()])
    return square_root(rows).deviations(term.temperature(temperatures))


def _most(built: BuiltImu, requirement: Requirement, channels: list[Channel]) -> tuple[str, float] | None:
    """The quantity's term, and the largest possible mean square of its elements' signals."""
    gravity = float(built.motion.geometry.gravity)
    fastest = _fastest(built)
    # Number of misalignments m_ij of the channels i along the same axis j.
    beside = max(sum(c.axis != j for c in channels) for j in range(3)) / (2 * len(channels))
    return {
        "gyro_misalignment": (MISALIGNMENT.format(""), fastest**2 * beside),
        "accelerometer_misalignment": (MISALIGNMENT.format(""), gravity**2 * beside),
        "accelerometer_scale_factor": (model.SCALE_FACTOR, gravity**2 / len(channels)),
        "second_order": (SECOND_ORDER, gravity**4 / len(channels)),
        "g_sensitivity": ("g_sensitivity", gravity**2 / 3.0),
    }.get(requirement.quantity)


def _fastest(built: BuiltImu) -> float:
    """The unit's largest rate, rad/s."""
    return max(float(axis.max_rate) for axis in built.spec.rig.table.axis) + EARTH_RATE


def _fastest_along(built: BuiltImu, channel: Channel) -> float:
    """The largest rate (rad/s) of the gyro along the table's only axis, the Earth's share included."""
    of = built.motion.geometry
    return float(built.spec.rig.table.axis[0].max_rate) + abs(float(of.base @ of.axes[0] @ of.earth_rate()))


def _channel(built: BuiltImu, kind: str, axis: str) -> Channel:
    """The channel of that kind and axis; for "worst" and "all" the first, since all are alike."""
    return next(c for c in built.model.channels if c.kind == kind and axis in ("worst", "all", AXIS_NAMES[c.axis]))
