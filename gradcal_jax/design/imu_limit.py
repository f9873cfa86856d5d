"""What the data of an IMU's plan can tell at most of its channels' errors; and what they can tell if the same axes of
the table turn at the same times as in the plan, by any angle and at any rate."""

from collections.abc import Callable
from contextlib import suppress
from dataclasses import replace
from typing import NamedTuple

import numpy as np
import scipy.linalg

from gradcal_jax.design import bias_seen_continuously, look_at
from gradcal_jax.design.misalignment_limit import Standstills, TurnNodes, misalignment_limit
from gradcal_jax.design.noise_floor import Course, Windows, between_knots, sensor_course
from gradcal_jax.information import readings_of_standstills, segments_of, square_root
from gradcal_jax.model import AXIS_NAMES, SCALE_FACTOR, Channel, Map, SignalMap, make_map
from gradcal_jax.model.build import chamber_programme
from gradcal_jax.model.imu_build import MISALIGNMENT, SECOND_ORDER, BuiltImu
from gradcal_jax.motion import EARTH_RATE, quadrature
from gradcal_jax.spec.requirement import MisalignmentRequirement, Requirement

# Nodes of a part of a turn: its rate is linear in time there, the functions of temperature nearly so.
_NODES = 6
# Longest step of the integrals of signals, s.
_LONGEST_S = 5.0
# Directions are perpendicular or along one another to this.
_ALONG = 1e-12
# Lags that differ by a smaller share are equal.
_APART = 1e-6
# Information of an angle that is known exactly, 1/rad²; a time that is none, s.
_EXACT, _NO_TIME = 1e30, 1e-9
# Functions of temperature at times (s).
FunctionsAt = Callable[[np.ndarray], np.ndarray]


class PlanTurns:
    """The turns of a plan: `axis`, `begin` and `end` (s) of each, in order, and their largest possible rates.

    Errors: `ValueError` where nothing turns, or several axes at once.
    """

    def __init__(self, built: BuiltImu) -> None:
        self.built, line = built, built.motion.line
        at = segments_of(built.motion, built.model)
        moves = at.sums(np.where(built.motion.turns, 1.0, 0.0)) > 0.0
        start = np.asarray(line.start)[at.first]
        self.time = float(line.start[0]), float(line.start[-1] + line.duration[-1])
        seen = ~np.asarray(line.gap)[at.last]
        turns = np.flatnonzero(np.any(moves, axis=1) & seen)
        if not len(turns) or np.any(np.sum(moves, axis=1) > 1):
            raise ValueError("a limit for the turns of this plan needs a plan in which the axes turn one at a time")
        self.axis = np.argmax(moves[turns], axis=1)
        self.begin, self.end = start[turns], start[turns] + at.sums(np.asarray(line.duration))[turns]
        if not built.model.encoder.held:
            # Readings on the move divide a turn; turns without a rest between them are like one.
            new = (np.diff(self.axis, prepend=-1) != 0) | (self.begin - np.append(-np.inf, self.end[:-1]) > _NO_TIME)
            first = np.flatnonzero(new)
            self.axis, self.begin = self.axis[first], self.begin[first]
            self.end = self.end[np.append(first[1:], len(new)) - 1]
        self._moves, self._ends = moves, np.append(start, self.time[1])

    def nodes(self, axis: int | None = None) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Nodes in all turns, or in those of an axis: time (s), weight (s), and largest possible ∫ω²dt (rad²/s)."""
        rig = self.built.spec.rig.table.axis
        own = np.ones(len(self.axis), bool) if axis is None else self.axis == axis
        begin, end = self.begin[own], self.end[own]
        rate = np.array([float(rig[k].max_rate) for k in self.axis[own]])
        steep = np.array([float(rig[k].max_acceleration) for k in self.axis[own]])
        ramp = np.minimum(rate / steep, 0.5 * (end - begin))
        x, weight = quadrature(_NODES)
        edges = np.stack([begin, begin + ramp, end - ramp, end], axis=1)
        width = np.diff(edges, axis=1)[..., None]
        t = edges[:, :-1, None] + width * x
        since = np.minimum(t - begin[:, None, None], end[:, None, None] - t)
        largest = np.minimum(rate[:, None, None], steep[:, None, None] * since) + EARTH_RATE
        return t.ravel(), (width * weight + 0.0 * t).ravel(), (largest**2 * width * weight).ravel()

    def shares(self, spans: Windows, parts: int, axis: int | None = None) -> tuple[np.ndarray, np.ndarray]:
        """`(parts,)` each, of equal parts of the time of all spans: the share in which something turns, or an axis,
        and the largest mean square of the rate in it (rad²/s²)."""
        begin, end = np.array(spans).T
        lasted = np.concatenate([[0.0], np.cumsum(end - begin)])
        t, weight, squares = self.nodes(axis)
        k = np.clip(np.searchsorted(begin, t, side="right") - 1, 0, len(begin) - 1)
        inside = t <= end[k]
        where = ((lasted[k] + t - begin[k])[inside] * (parts / lasted[-1])).astype(int)
        where = np.clip(where, 0, parts - 1)
        times, sums = (np.bincount(where, of[inside], parts) for of in (weight, squares))
        # A part without a turn has a short one at any rate.
        times = np.maximum(times, _NO_TIME)
        return np.minimum(times * (parts / lasted[-1]), 1.0), np.where(sums > 0.0, sums, np.inf) / times

    def _inner_along(self) -> int | None:
        """Which of the body's axes the inner one of two perpendicular axes is along in all mountings."""
        of = self.built.motion.geometry
        if of.axis_count != 2 or abs(of.axes[0] @ of.axes[1]) > _ALONG:
            return None
        along = np.abs([of.axes[1] @ mounting for mounting in np.asarray(of.mountings)])
        found = set(np.argmax(along, axis=1).tolist())
        return found.pop() if len(found) == 1 and np.all(np.max(along, axis=1) > 1.0 - _ALONG) else None

    def gyros(self, axes: list[int]) -> list[tuple[int | None, int]]:
        """Axis of the table (None: any) and number of the gyros, of those along `axes`, that share its turns."""
        inner = self._inner_along()
        if inner is None:
            return [(None, len(axes))]
        groups = [(1, int(inner in axes)), (0, sum(k != inner for k in axes))]
        return [(axis, count) for axis, count in groups if count and np.any(self.axis == axis)]

    def misalignment(
        self, requirement: MisalignmentRequirement, term: SignalMap, functions: FunctionsAt, at: np.ndarray
    ) -> float | None:
        """The limit (rad) of a requirement on the misalignments of three gyros; None: without a proof.

        `functions` of the term at times; `at`: those at the requirement's temperatures.
        """
        built, of = self.built, self.built.motion.geometry
        channels = {(c.kind, c.axis): float(c.model.angle_random_walk) for c in built.model.channels}
        gyros = [white for (kind, _), white in channels.items() if kind == "gyro"]
        accelerometers = [white for (kind, _), white in channels.items() if kind == "accelerometer"]
        if len(gyros) < 3 or requirement.axis not in ("all", "worst") or self._inner_along() is None:
            return None
        of_accelerometers = (float(of.gravity) / min(accelerometers)) ** 2 if accelerometers else 0.0
        stands, begins = self._standstills(functions, of_accelerometers)
        outer, inner = (self._nodes_of(k, functions, begins) for k in (0, 1))
        noise, prior = min(gyros) ** 2, term.prior_rows()
        worst = requirement.axis == "worst"
        return misalignment_limit(
            outer, inner, stands, noise=noise, prior=prior, at=at, name=requirement.statistic, worst=worst
        )

    def _nodes_of(self, axis: int, functions: FunctionsAt, begins: np.ndarray) -> TurnNodes:
        """The nodes of an axis's turns; also all time on the rotating Earth, which the gyros see at rest, too."""
        t, _, squares = self.nodes(axis)
        rest = np.linspace(*self.time, 2 * len(self._ends) + 1)
        t, squares = np.append(t, rest), np.append(squares, EARTH_RATE**2 * (rest[1] - rest[0]) + 0.0 * rest)
        standstill = np.clip(np.searchsorted(begins, t, side="right") - 1, 0, len(begins) - 1)
        return TurnNodes(functions(t), squares, standstill)

    def _standstills(self, functions: FunctionsAt, of_accelerometers: float) -> tuple[Standstills, np.ndarray]:
        """The standstills of the inner axis, and the times (s) at which the turns before them are half over."""
        encoder, own = self.built.model.encoder, np.flatnonzero(self._moves[:, 1])
        begin, end = self._ends[own], self._ends[own + 1]
        halves = np.concatenate([[self.time[0]], 0.5 * (begin + end)])
        lasting = np.diff(np.append(halves, self.time[1]))
        still = np.concatenate([[self.time[0]], end]), np.concatenate([begin, [self.time[1]]])
        if encoder.held:
            every = float(encoder.every[1])
            first = np.floor((still[1][0] - still[0][0]) / every + 1e-9) + 1.0
            readings = np.append(first, readings_of_standstills(self.built.motion, self.built.model)[1][own])
            variance = float(encoder.offset[1]) ** 2 + float(encoder.reading[1]) ** 2 / readings
        else:
            # An angle that is read on the move, too, is taken as known.
            variance = np.zeros(len(lasting))
        known = np.minimum(1.0 / np.maximum(variance, 1.0 / _EXACT), _EXACT)
        turns = np.maximum(end - begin, _NO_TIME)
        return Standstills(functions(0.5 * (still[0] + still[1])), known + of_accelerometers * lasting, turns), halves


class PlanData:
    """The used data of a plan, `time` s in all: `spans`, and `windows`, divided where the chamber's slope changes (s);
    the `chamber`'s programme."""

    def __init__(self, built: BuiltImu) -> None:
        schedule = built.spec.gradient_schedule
        self.built, (self.chamber, _) = built, chamber_programme(schedule)
        self.spans: Windows = [(s.start, s.start + s.duration) for s in schedule.stretches]
        self.windows = between_knots(self.spans, self.chamber.times())
        self.time = sum(end - begin for begin, end in self.spans)
        self.turns: PlanTurns | None = None
        with suppress(ValueError):  # of nothing that turns
            self.turns = PlanTurns(built)

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


def bias_deviations(seen: PlanData, requirement: Requirement, temperatures: np.ndarray) -> np.ndarray | None:
    """Standard deviations of a bias under white noise and drift, seen continuously."""
    channel = channel_of(seen.built, requirement.quantity.removesuffix("_bias"), requirement.axis)
    term = channel.model.term("bias")
    assert isinstance(term, Map | SignalMap)
    if isinstance(term, Map):
        if term.beyond is not None:
            return None
        bias = replace(term, late=None)
    else:
        bias = make_map(term.temperature, prior_std=float(term.std) if term.has_prior else np.inf, shapes=term.shapes)
    white, rows = float(channel.model.angle_random_walk), bias.values(temperatures, 0.0 * temperatures)
    return bias_seen_continuously(bias, white, channel.model.processes, seen.windows, seen.course(term), rows)


class Elements(NamedTuple):
    """The elements of a quantity: `term`, one of their columns, and its `channel`; `bound`: the largest possible mean
    square of their signals; `mean`: the mean of the signals, where the turns and poses do not change it."""

    channel: Channel
    term: SignalMap
    bound: float
    mean: float | None

    @classmethod
    def of(cls, built: BuiltImu, requirement: Requirement) -> "Elements | None":
        """Those of a requirement; None without a proof."""
        if isinstance(requirement, MisalignmentRequirement) and requirement.relative_to == "internal":
            return None
        kind = "gyro" if requirement.quantity in ("gyro_misalignment", "g_sensitivity") else "accelerometer"
        channels = [
            c
            for c in built.model.channels
            if c.kind == kind and requirement.axis in ("worst", "all", AXIS_NAMES[c.axis])
        ]
        gravity, fastest, mean = float(built.motion.geometry.gravity), fastest_rate(built), None
        # Number of misalignments m_ij of the channels i along the same axis j.
        beside = max(sum(c.axis != j for c in channels) for j in range(3)) / (2 * len(channels))
        found = {
            "gyro_misalignment": (MISALIGNMENT.format(""), fastest**2 * beside),
            "accelerometer_misalignment": (MISALIGNMENT.format(""), gravity**2 * beside),
            "accelerometer_scale_factor": (SCALE_FACTOR, gravity**2 / len(channels)),
            "second_order": (SECOND_ORDER, gravity**4 / len(channels)),
            "g_sensitivity": ("g_sensitivity", gravity**2 / 3.0),
        }.get(requirement.quantity)
        if found is None:
            return None
        if requirement.quantity == "second_order" and len(channels) == 3:
            mean = gravity**2 / 3.0
        term = next(t for t in channels[0].model.terms if t.name.startswith(found[0]))
        assert isinstance(term, SignalMap)
        return cls(channels[0], term, found[1], mean)

    def deviations(self, seen: PlanData, temperatures: np.ndarray) -> np.ndarray:
        """Standard deviations from the mean information of all elements, and of the biases whose columns they share."""
        nodes, weights = quadrature(_NODES)
        white, bias = float(self.channel.model.angle_random_walk), self.channel.model.term("bias")

        def functions(of: Map | SignalMap) -> np.ndarray:
            look = look_at(seen.windows, seen.course(of), _LONGEST_S)
            at = (look.begin[:, None] + (look.end - look.begin)[:, None] * nodes)[look.used]
            return (
                np.asarray(of.temperature(at.ravel()))
                * np.sqrt((look.duration[look.used, None] * weights).ravel())[:, None]
            )

        own, mean = functions(self.term) / white, self.mean or 0.0
        rows = [own * np.sqrt(self.bound - mean**2), np.asarray(self.term.prior_rows())]
        if not mean or not isinstance(bias, Map | SignalMap) or getattr(bias, "beyond", None) is not None:
            return square_root(np.concatenate(rows)).deviations(self.term.temperature(temperatures))
        beside = np.asarray(scipy.linalg.block_diag(bias.prior_rows(), np.concatenate(rows)))
        together = np.concatenate([functions(bias) / white, own * mean], axis=1)
        wanted = np.asarray(self.term.temperature(temperatures))
        wanted = np.concatenate([np.zeros((len(wanted), bias.temperature.size)), wanted], axis=1)
        return square_root(np.concatenate([together, beside])).deviations(wanted)

    def with_turns(
        self, seen: PlanData, requirement: MisalignmentRequirement, temperatures: np.ndarray
    ) -> float | None:
        """The limit of misalignments of gyros with the plan's turns, rad; None without a proof."""
        if requirement.quantity != "gyro_misalignment" or seen.turns is None:
            return None
        of, course = self.term, seen.course(self.term)
        return seen.turns.misalignment(
            requirement, of, lambda t: of.temperature(course(t)[0]), of.temperature(temperatures)
        )


def fastest_rate(built: BuiltImu) -> float:
    """The unit's largest rate, rad/s."""
    return max(float(axis.max_rate) for axis in built.spec.rig.table.axis) + EARTH_RATE


def channel_of(built: BuiltImu, kind: str, axis: str) -> Channel:
    """The channel of that kind and axis; for "worst" and "all" the first, since all are alike."""
    return next(c for c in built.model.channels if c.kind == kind and axis in ("worst", "all", AXIS_NAMES[c.axis]))
