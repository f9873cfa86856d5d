"""Proven lower limits on any plan with the rig and time of a spec, and the efficiency of the spec's plan: of the scale
factors and biases of gyros.

A **bias** `ψ(T)ᵀβ` under white noise and drift: with all else known exactly and the error itself observed at every
instant of the data, moving or not, generalised least squares has a known covariance of β; every row of any plan is a
function of these observations.

A **scale factor** is also a function of the rate: its limit is that of an axis (`design.relaxed_limit`) that turns all
the time that it has the table, in white noise and under what multiplies its rate. Where the gyro is alone on a table of
one axis, readings, drift and clock count, too; the errors of an encoder that other channels see are no noise.
"""

from itertools import pairwise
from typing import NamedTuple

import jax
import numpy as np
import scipy.linalg

from gradcal_jax.design.noise_floor import (
    PRIOR_OF_WALK,
    Windows,
    least_noise_density,
    scale_factor_floor,
    seen_continuously,
)
from gradcal_jax.design.relaxed_limit import RelaxedProblem, relaxed_limit
from gradcal_jax.design.slots import LEAST_TURN
from gradcal_jax.design.visits import motion_time, with_motion
from gradcal_jax.formulas import lagged_temperature
from gradcal_jax.information.prediction import requirement_rows
from gradcal_jax.information.residual import residual_map, residual_of, statistic
from gradcal_jax.information.unseen import floor_of_plan
from gradcal_jax.model import AXIS_NAMES, BIAS, SCALE_FACTOR, Channel, Polynomial, constant
from gradcal_jax.model.build import build_imu
from gradcal_jax.motion import EARTH_RATE, Programme
from gradcal_jax.motion.plan_motion import chamber_programme
from gradcal_jax.spec.design import Design
from gradcal_jax.spec.requirement import QUANTITIES, Requirement
from gradcal_jax.spec.schedule import PlanSchedule
from gradcal_jax.spec.spec import expect_spec
from gradcal_jax.spec.spec_sections import Spec
from gradcal_jax.tables.display import summary
from gradcal_jax.units import time_text

# Windows at most at whose times alone a proof lets the axis turn; equal parts of the time at the table, at least.
_MOST_WINDOWS = 40
_PARTS = 48
# Temperatures on which a maximum over temperature is searched.
_TEMPERATURES = 26
_AT_KNOT = 1e-6
# An axis this near to a gyro's is the same, by 1 less the cosine.
_ALONG = 1e-12
_RELAXED = (
    "everything else is known exactly",
    "the IMU is read continuously, at rest and during moves, with the best distribution of turns and poses",
    "all noise is white, except for the drift of biases",
)


class PlanLimit(NamedTuple):
    """No plan leaves less than `certified` (`unit`) of a requirement.

    `value`: what the spec's plan leaves (None: not observable); `efficiency`: certified over value. `relaxed`: limits
    of the rig that the proof leaves out; `kept`: what all plans of the proof have in common; both in words. All of that
    is by the terms that the spec names.
    """

    name: str
    statistic: str
    unit: str
    certified: float
    value: float | None
    efficiency: float | None
    relaxed: tuple[str, ...]
    kept: tuple[str, ...]

    __repr__ = summary


def limit(spec: Spec) -> list[PlanLimit]:
    """The proven lower limit on the residual of any plan on this rig in this time, or in [design]'s, for every
    requirement of a gradient plan that has a proof; values and efficiencies are the plan's.

    Errors: `ValueError` where there is no requirement, no proof for one, or another kind of plan.
    """
    spec = expect_spec(spec)
    if not spec.requirement:
        raise ValueError("a limit is proven for requirements; the spec has none: add a [[requirement]]")
    design = spec.design or Design()
    data = _PlanData(with_motion(spec, motion_time(spec, design)) if design.max_motion or design.max_total else spec)
    rows = {row.name: row for row in requirement_rows(spec)}
    # What no residual shows, no plan removes: it adds in quadrature, at least its smallest value in the box.
    built, floor = floor_of_plan(spec)
    proven: list[PlanLimit] = []
    for r in spec.requirement:
        if (bound := data.bound(r)) is None:
            continue
        least, relaxed = bound
        (*_, unit, factor), value = QUANTITIES[r.quantity], rows[r.name].decisive
        certified = float(np.hypot(factor * least, np.min(residual_map(built, floor, r).values)))
        share = None if value is None else certified / value
        proven.append(PlanLimit(r.name, r.statistic, unit, certified, value, share, relaxed, data.kept))
    if not proven:
        raise ValueError(
            "limits are proven for the biases and polynomial scale factors of gyros; the spec has no requirement on "
            "any of these"
        )
    return proven


class _PlanData:
    """The used data of a plan: `windows` (s), divided where the chamber's slope changes, and `visits`: those in which
    the gyro's axis may turn, for `turning` s in all; `tied`: at those times alone. `kept`: in words."""

    def __init__(self, spec: Spec) -> None:
        self.spec, self.built, schedule = spec, build_imu(spec), spec.gradient_schedule
        self.chamber: Programme = chamber_programme(schedule)[0]
        spans = [(s.start, s.start + s.duration) for s in schedule.stretches]
        time = self.turning = sum(end - begin for begin, end in spans)
        self.windows, self.visits, self.tied, same = self._between_knots(spans), spans, True, ""
        own = sum(s.move.duration for s in schedule.steps if not s.move.other_axes)
        # An axis that no other axis waits for has the table all the time, whatever the cycles leave.
        if spec.turns_one_gyro and schedule.steps and own < schedule.period * (1.0 - 1e-9):
            visits = _visits(schedule)
            # A cycle of another length may have a little more or less of the same share.
            self.turning = max(sum(end - begin for begin, end in visits), time * own / schedule.period)
            free = () if spec.design is None else spec.design.free
            self.tied = "cycle" not in free and len(visits) <= _MOST_WINDOWS
            if self.tied:
                self.visits, same = visits, ", at the same times as in this plan"
        at_table = f"{time_text(float(round(self.turning)))} at the table{same}"
        self.kept = (at_table, "the chamber follows the temperatures of this plan")

    def temperature(self, t: np.ndarray) -> np.ndarray:
        """The sensor's temperature (°C) at times (s)."""
        of = self.chamber.sensor(self.spec.sensor.lag)
        k = np.clip(np.searchsorted(of.times, t, side="right") - 1, 0, len(of.slope) - 1)
        return lagged_temperature(t - of.times[k], of.level[k], of.slope[k], of.excess[k], of.lag_rate)

    def bound(self, requirement: Requirement) -> tuple[float, tuple[str, ...]] | None:
        """The limit of a requirement, SI, and what its proof leaves out; None where there is no proof."""
        name = {"gyro_bias": BIAS, "gyro_scale_factor": SCALE_FACTOR}.get(requirement.quantity)
        if name is None:
            return None
        # Of several gyros the first, since all are alike.
        quantity, model = residual_of(self.built, requirement), self.built.model
        element = quantity.elements[0]
        channel = next(c for c in model.channels if c.kind == "gyro" and AXIS_NAMES[c.axis] == element.label[0])
        of = channel.map(name)
        if of is None or (name == SCALE_FACTOR and not isinstance(of.rate, Polynomial)):
            return None
        carried = ("the calibration contains the discrepancy as far as the data determine it",)
        more = carried if element.alone is not None else ()
        rows = np.zeros((len(element.beyond), model.size))
        rows[:, element.where] = element.rows[0]
        rows = rows[:, model.where(channel.kind, channel.axis)]
        across, processes = len(quantity.rates), channel.processes
        if name == BIAS:
            at_rest = jax.tree.map(lambda x: np.asarray(x)[np.asarray(processes.rate_gain) == 0.0], processes)
            noise, prior = (float(channel.angle_random_walk), at_rest), np.asarray(of.prior_rows())
            rows = rows[:, channel.where(BIAS)]
            left = seen_continuously(of.temperature, prior, *noise, self.windows, self.temperature, rows)
            return float(np.asarray(statistic(requirement.statistic, left.reshape(-1, across)))), (*_RELAXED, *more)
        # Of a channel among others, the noise is white and its clock is one with that of all.
        density, relaxed = float(channel.angle_random_walk) ** 2, _RELAXED
        alone = self._alone(channel)
        if alone:
            if clock := self.spec.sensor.clock_error:
                processes = processes + constant(clock, rate_gain=1.0)
            density, relaxed = self._density_alone(channel)
        visits, temperatures = self._between_knots(self.visits), quantity.temperatures
        floor = scale_factor_floor(of, processes, visits, self.temperature, temperatures)
        kept = np.arange(len(floor))
        if requirement.statistic in ("max", "mean of max"):
            # A maximum over fewer temperatures is no larger: a limit of it is one of the whole.
            kept = np.unique(np.round(np.linspace(0, kept[-1], min(len(kept), _TEMPERATURES))).astype(int))
        functions = (of,) if of.beyond is None else (of, of.beyond)
        columns = np.concatenate([rows[:, channel.where(f.name)] for f in functions], axis=1)
        share = PRIOR_OF_WALK if np.any(floor) else 1.0
        problem = RelaxedProblem(
            functions,
            columns.reshape(-1, across, columns.shape[1])[kept],
            floor[kept],
            requirement.statistic,
            np.asarray(scipy.linalg.block_diag(*(np.asarray(f.prior_rows()) / np.sqrt(share) for f in functions))),
            self.temperature(_middles_of_parts(self.visits)),
            self._fastest(alone=alone),
            self.turning / density,
        )
        return relaxed_limit(problem), (*relaxed, *more)

    def _alone(self, channel: Channel) -> bool:
        """Whether the unit is one gyro along the table's only axis."""
        geometry = self.built.motion.geometry
        if len(self.built.model.channels) > 1 or geometry.axis_count > 1 or len(geometry.mountings) > 1:
            return False
        along = (geometry.axes[0] @ geometry.mountings[0])[channel.axis]
        return bool(abs(along) > 1.0 - _ALONG)

    def _fastest(self, *, alone: bool) -> float:
        """The largest rate of a gyro, rad/s, the Earth's share included."""
        of, gyro = self.built.motion.geometry, self.spec.sensor.gyro
        largest = max(float(axis.max_rate) for axis in self.spec.rig.table.axis)
        if not alone:
            return largest + EARTH_RATE
        usable = None if gyro is None else gyro.usable_rate
        earth = abs(float(of.base @ of.axes[0] @ of.earth_rate()))
        return min(largest, np.inf if usable is None else float(usable)) + earth

    def _density_alone(self, channel: Channel) -> tuple[float, tuple[str, ...]]:
        """The least noise density (rad²/s) of any motion of a gyro that has the table alone, by the least time between
        readings, and between standstills, of this plan and of any plan in a search; and what the proof leaves out."""
        encoder, schedule, line = self.built.model.encoder, self.spec.gradient_schedule, self.built.motion.line
        steps = (*schedule.steps, *schedule.after)
        apart = min([LEAST_TURN, *(step.move.duration for step in steps if step.axis >= 0)])
        stated = [step.move.read_every for step in steps if step.move.read_every is not None]
        times = np.concatenate([line.start[:1], (line.start + line.duration)[line.read | line.gap]])
        spacing = min([*np.asarray(encoder.every), *stated, apart, float(np.min(np.diff(times), initial=np.inf))])
        relaxed = ["acceleration and travel"]
        reading, offset = float(encoder.reading[0]), float(encoder.offset[0])
        noise = float(channel.angle_random_walk), channel.processes
        density = least_noise_density(*noise, reading, spacing)
        if reading > 0.0:
            often = f"the angle is read at most every {spacing:.3g} s"
            relaxed.append(f"{often}, also during moves (a plan with more frequent readings may leave a smaller error)")
        if offset > 0.0:
            # An offset is one draw a standstill.
            density = max(density, least_noise_density(*noise, offset, apart))
            relaxed.append(f"the time between standstills can be as short as {apart:.3g} s")
        if not self.tied:
            relaxed.append(
                "the turns may be at any time; only their total time is limited, to the axis's part of a cycle"
            )
        return density, tuple(relaxed)

    def _between_knots(self, windows: Windows) -> Windows:
        """The windows, divided where the chamber's slope changes."""
        knots, parts = self.chamber.times(), list[tuple[float, float]]()
        for begin, end in windows:
            inside = knots[(knots > begin + _AT_KNOT) & (knots < end - _AT_KNOT)]
            parts += pairwise([begin, *map(float, inside), end])
        return parts


def _middles_of_parts(windows: Windows) -> np.ndarray:
    """The middles (s) of equal parts of all windows' time together, two or more for each."""
    count = max(_PARTS, 2 * len(windows))
    begin, end = np.array(windows).T
    lasted = np.concatenate([[0.0], np.cumsum(end - begin)])
    middle = lasted[-1] * (np.arange(count) + 0.5) / count
    k = np.clip(np.searchsorted(lasted, middle, side="right") - 1, 0, len(begin) - 1)
    return begin[k] + middle - lasted[k]


def _visits(schedule: PlanSchedule) -> Windows:
    """When the axis has the table (begin, end; s) in the cycles of all stretches."""
    visits: list[tuple[float, float]] = []
    for stretch in schedule.stretches:
        for number in range(stretch.cycles):
            begin = here = stretch.start + number * schedule.period
            for step in schedule.steps:
                there = here + step.move.duration
                if step.move.other_axes:
                    visits.append((begin, here))
                    begin = there
                here = there
            visits.append((begin, here))
    return [(begin, end) for begin, end in visits if end > begin]
