"""Proven lower limits on the residuals of any plan that turns one gyro on the rig and in the time of a spec."""

from contextlib import suppress
from itertools import pairwise
from typing import NamedTuple

import equinox as eqx
import jax
import numpy as np

from gradcal_jax import trajectory
from gradcal_jax.api.build import Assembled, assemble
from gradcal_jax.api.imu_residual import box
from gradcal_jax.api.measure import criterion_of, design_of
from gradcal_jax.api.structures import LEAST_TURN, ResolvedCycle, cycle_of, largest_rate, motion_time, ramp_ends
from gradcal_jax.design import (
    PRIOR_OF_WALK,
    Criterion,
    Limit,
    bias_floor,
    bias_floor_anywhere,
    gated_noise_density,
    least_noise_density,
    limit,
    scale_factor_floor,
)
from gradcal_jax.design.noise_floor import Course
from gradcal_jax.files.design import TIMES
from gradcal_jax.files.requirement import Requirement
from gradcal_jax.files.spec_sections import Spec
from gradcal_jax.information import information, statistic
from gradcal_jax.model import BIAS, SCALE_FACTOR, Map, Processes, SensorModel, gyro_model
from gradcal_jax.trajectory import Programme, programme
from gradcal_jax.units import time_text

# The time at the table is divided into at least this many equal parts of one temperature, two or more for each turn.
_PARTS = 48
_MOST_WINDOWS = 40
# Longest step of a continuous observation: as a share of the shortest correlation time, and in s; most steps.
_SHARE_OF_CORRELATION = 0.05
_LONGEST_S = 5.0
_MOST_STEPS = 200_000
_AT_KNOT = 1e-6

Windows = list[tuple[float, float]]


class Proof(NamedTuple):
    """A requirement's limit in SI: `certified`, and the optimum of the relaxed problem, `reached`. `relaxed`: limits of
    the rig that the proof leaves out; `kept`: what all plans of the proof have in common; both in words."""

    requirement: Requirement
    certified: float
    reached: float
    relaxed: tuple[str, ...]
    kept: tuple[str, ...]


def proofs_of_axis(spec: Spec, motion: float | None = None) -> list[Proof]:
    """The limit of every requirement of a gradient plan that turns one gyro. Errors: `ValueError` without a proof.

    `motion` s: time without soaks, in the place of the plan's or [design]'s.
    """
    window = _window(spec, assemble(spec), motion)
    return [window.proof(requirement) for requirement in spec.requirement]


class _Window(NamedTuple):
    """When and at which temperatures the axis may turn, and the least noise density of its motion.

    `time`, `every`: duration (s) of the axis at the table, and of all data. `windows` (s) at the table, and the
    sensor's `temperature` and its rate there; `used`: windows (s) of all used data. Both are empty where the programme
    is free. `spans`: of all used data, not divided at the programme's `knots`.
    """

    spec: Spec
    built: Assembled
    time: float
    every: float
    temperatures: np.ndarray
    fixed: bool
    density: float
    windows: Windows
    used: Windows
    spans: Windows
    knots: np.ndarray
    temperature: Course
    relaxed: tuple[str, ...]
    kept: tuple[str, ...]

    def proof(self, requirement: Requirement) -> Proof:
        model = self.built.model
        criterion = criterion_of(model, requirement)
        if requirement.quantity.endswith("scale_factor"):
            temperature, rate = box(requirement)
            sure = scale_factor_floor(model, self.windows, self.temperature, temperature)
            result, relaxed = self._of_scale_factor(criterion, np.repeat(sure, len(rate))), self.relaxed
        else:
            result, relaxed = self._of_functionals(criterion)
        if criterion.alone is not None:
            relaxed = (*relaxed, "the calibration contains the discrepancy as far as the data determine it")
        return Proof(requirement, result.certified, result.reached, relaxed, self.kept)

    def _of_scale_factor(self, criterion: Criterion, sure: np.ndarray) -> Limit:
        """The limit of a criterion on the scale factor, the bias known; `sure`: a variance that no plan removes."""
        return limit(
            criterion,
            self.built.model,
            motion_time=self.time,
            temperatures=self.temperatures,
            fixed_programme=self.fixed,
            max_rate=largest_rate(self.spec, []),
            noise_density=self.density,
            floor=sure,
            prior_share=PRIOR_OF_WALK if np.any(sure) else 1.0,
        )

    def _of_functionals(self, criterion: Criterion) -> tuple[Limit, tuple[str, ...]]:
        """The limit of a combination of bias and scale factor: the larger of two limits with one of the maps known."""
        model = self.built.model
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
                floor = bias_floor(model, self.used, self.temperature, of_bias)
                relaxed = ("the angle is read continuously and without noise",)
            else:
                ends = float(np.min(self.temperatures)), float(np.max(self.temperatures))
                floor = bias_floor_anywhere(model, self.every, ends, of_bias)
                relaxed = (
                    "the time is distributed optimally over the temperatures",
                    "the only noise is the random walk",
                )
            relaxed += ("the scale factor is known",) if model.scale is not None else ()
            bounds.append((_exactly(statistic(criterion.statistic, np.sqrt(floor).reshape(criterion.shape))), relaxed))
            known = self._seen_continuously(of_bias) if self.used and not np.any(of_scale) else None
            if known is not None:
                bounds.append((_exactly(statistic(criterion.statistic, known.reshape(criterion.shape))), relaxed))
        return max(bounds, key=lambda pair: pair[0].certified)

    def _seen_continuously(self, rows: np.ndarray) -> np.ndarray | None:
        """Standard deviations of combinations `rows` of the bias; None: too many steps, or an extended structure."""
        model = self.built.model
        steps = self.every / longest_step(model.processes)
        if model.bias is None or model.bias.beyond is not None or steps > _MOST_STEPS:
            return None
        spans = windows_between_knots(self.spans, self.knots)
        return bias_seen_continuously(
            model.bias, float(model.angle_random_walk), model.processes, spans, self.temperature, rows
        )


def _exactly(value: float) -> Limit:
    return Limit(value, value)


def longest_step(processes: Processes) -> float:
    """The longest time step (s) of `bias_seen_continuously`."""
    decays = processes.decay[np.asarray(processes.rate_gain) == 0.0]
    return min(_LONGEST_S, _SHARE_OF_CORRELATION / np.max(decays, initial=1e-12))


def bias_seen_continuously(
    bias: Map, angle_random_walk: float, processes: Processes, windows: Windows, course: Course, rows: np.ndarray
) -> np.ndarray:
    """Standard deviations `(g,)`, rad/s, of combinations `rows` of a bias's parameters that no plan reduces.

    All else is known exactly and the error itself is observed at every instant of the `windows` (s, in order; the
    chamber's slope is constant in each), moving or not: every reading of any plan is a function of this observation.
    The noise is white (rad/√s), with the processes that act at rate zero.
    """
    at_rest = jax.tree.map(lambda of: of[np.asarray(processes.rate_gain) == 0.0], processes)
    alone = gyro_model(bias, None, angle_random_walk, at_rest)

    def variance(longest: float) -> np.ndarray:
        look = look_at(windows, course, longest)
        none = np.zeros(len(look.start), bool)
        line = trajectory.held(
            look.start, look.duration, np.zeros(len(none)), look.begin, look.end,
            read=look.used, at_rest=~none, moving=none, gap=~look.used,
        )  # fmt: skip
        return information(line, alone).deviations(rows) ** 2

    # Integrals over steps have less information than instants: halving all further steps adds at most as much as this
    # one.
    step = longest_step(processes)
    coarse, fine = variance(step), variance(0.5 * step)
    return np.sqrt(np.maximum(fine - np.abs(coarse - fine), 0.0))


class Look(NamedTuple):
    """Windows of time in steps, and the times between them: `start`, `duration` s, the temperature (°C) at their
    `begin` and `end`, and whether they belong to a window (`used`)."""

    start: np.ndarray
    duration: np.ndarray
    begin: np.ndarray
    end: np.ndarray
    used: np.ndarray


def look_at(windows: Windows, course: Course, longest: float) -> Look:
    """The windows in steps no longer than `longest` s."""
    edges, used = [np.array(windows[0][:1])], []
    for begin, end in windows:
        if begin - edges[-1][-1] > _AT_KNOT:
            edges.append(np.array([begin]))
            used.append(np.zeros(1, bool))
        parts = max(1, int(np.ceil((end - begin) / longest * (1.0 - 1e-9))))
        edges.append(np.linspace(begin, end, parts + 1)[1:])
        used.append(np.ones(parts, bool))
    at = np.concatenate(edges)
    # The slope jumps at a knot, the temperature does not.
    temperature, _ = course(at)
    return Look(at[:-1], np.diff(at), temperature[:-1], temperature[1:], np.concatenate(used))


def _window(spec: Spec, built: Assembled, motion: float | None) -> _Window:
    schedule, design = spec.gradient_schedule, spec.design
    free = set() if design is None else set(design.free)
    cycle = cycle_of(spec)
    assert cycle is not None
    # A cycle that fills the ramp, as in a recipe, fits only that ramp.
    as_is = motion is None and (design is None or design.minimise in TIMES or 2.0 * cycle.duration > schedule.motion)
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
    density, relaxed = noise_density(built.model, *_spacing(built, cycle), visits if tied else None)
    if not tied:
        relaxed.append("the axis may turn at any time within its share of the time")
    followed = sensor_course(chamber, built.thermal_lag)
    fixed, windows, used = "gradient" not in free, [], []
    if fixed:
        used = windows_between_knots(spans, chamber.times())
        # With a cycle of free length, the turns may lie anywhere in the used data.
        turning = visits if tied else spans
        temperatures = followed(middles_of_parts(turning))[0]
        windows = windows_between_knots(turning, chamber.times())
    else:
        assert one_ramp is not None
        temperatures = np.linspace(*one_ramp, _PARTS)
        relaxed.append("the time is distributed optimally over the temperatures")
        if np.any(built.model.processes.rate_gain):
            relaxed.append("errors that multiply the rate are left out, except for constant ones")
    kept = kept_in_words(total, when=tied and not alone, fixed=fixed)
    looks = windows, used, spans, chamber.times(), followed
    return _Window(spec, built, total, every, temperatures, fixed, density, *looks, tuple(relaxed), kept)


def kept_in_words(time: float, *, when: bool = False, fixed: bool = True) -> tuple[str, ...]:
    """What the plans of a proof have in common: the `time` at the table (s), `when` it is there, the programme."""
    at_table = f"{time_text(float(round(time)))} at the table" + (", when this plan has it" if when else "")
    return (at_table, *(["the chamber follows the temperatures of this plan"] if fixed else []))


def noise_density(model: SensorModel, spacing: float, apart: float, visits: Windows | None) -> tuple[float, list[str]]:
    """The least noise density (rad²/s) of any motion in the windows `visits` (None: at any times), and what the proof
    leaves out. Readings are `spacing` s apart or more, standstills `apart` s."""
    reference = model.reference
    relaxed = ["acceleration and travel"]
    if float(reference.reading_noise) > 0.0:
        often = f"the angle is read at most every {spacing:.3g} s"
        relaxed.append(f"{often}, also during moves (a plan with more frequent readings may leave less)")
    if visits is not None and float(reference.reading_noise) > 0.0:
        density = gated_noise_density(model, spacing, visits)
    else:
        density = least_noise_density(model, spacing)
    if float(reference.standstill_offset) > 0.0:
        # An offset is one draw a standstill.
        other = eqx.tree_at(lambda m: m.reference.reading_noise, model, reference.standstill_offset)
        density = max(density, least_noise_density(other, apart))
        relaxed.append(f"standstills as little as {apart:.3g} s apart")
    return density, relaxed


def _spacing(built: Assembled, cycle: ResolvedCycle) -> tuple[float, float]:
    """The least time between readings, and between standstills (s), of this plan and of any plan in a search."""
    turns = [m.duration for m in cycle.moves if not m.is_rest]
    rests = [m.read_every for m in cycle.moves if m.read_every is not None]
    apart = min([LEAST_TURN, *turns])
    read = between_readings(built.trajectory())
    return min([*rests, cycle.other_read_every or np.inf, apart, read]), apart


def between_readings(line: trajectory.Trajectory) -> float:
    """The least time (s) between two readings of a trajectory."""
    times = np.concatenate([line.start[:1], (line.start + line.duration)[line.read | line.gap]])
    return float(np.min(np.diff(times), initial=np.inf))


def middles_of_parts(windows: Windows) -> np.ndarray:
    """The middles (s) of equal parts of all windows' time together."""
    count = max(_PARTS, 2 * len(windows))
    begin, end = np.array(windows).T
    lasted = np.concatenate([[0.0], np.cumsum(end - begin)])
    middle = lasted[-1] * (np.arange(count) + 0.5) / count
    k = np.clip(np.searchsorted(lasted, middle, side="right") - 1, 0, len(begin) - 1)
    return begin[k] + middle - lasted[k]


def windows_between_knots(windows: Windows, knots: np.ndarray) -> Windows:
    """The windows, divided where the chamber's slope changes."""
    parts: Windows = []
    for begin, end in windows:
        inside = knots[(knots > begin + _AT_KNOT) & (knots < end - _AT_KNOT)]
        parts += [(float(a), float(b)) for a, b in pairwise([begin, *inside, end])]
    return parts


def sensor_course(chamber: Programme, lag: float | None) -> Course:
    """The sensor's temperature (°C) and its rate (K/s) at any time (s)."""
    of = chamber.sensor(lag)

    def at(t: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        k = np.clip(np.searchsorted(of.times, t, side="right") - 1, 0, len(of.slope) - 1)
        since = t - of.times[k]
        fading = of.excess[k] * np.exp(-of.lag_rate * since)
        return of.level[k] + of.slope[k] * since + fading, of.slope[k] - of.lag_rate * fading

    return at


def _visits(cycle: ResolvedCycle, start: float, time: float) -> Windows:
    """When the axis has the table (begin, end; s) in a stretch of that time."""
    period = cycle.duration
    count = int((time + period - cycle.moving + 1e-6) // period)
    visits: Windows = []
    for begin in start + period * np.arange(count):
        here = float(begin)
        visits.append((here, here))
        for move in cycle.moves:
            there = here + move.repeat * move.duration
            visits.append((there, there)) if move.other_axes else visits.append((visits.pop()[0], there))
            here = there
    return [(begin, end) for begin, end in visits if end > begin]
