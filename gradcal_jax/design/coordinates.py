"""Free coordinates: any real vector decodes to a cycle that the table executes, and a ramp that the chamber follows.

| what | from free numbers | why it is feasible |
|---|---|---|
| durations of the moves of a turn at the table | least times + remaining time · softmax | they fill that time exactly |
| peak rate of a turn | cap · tanh | cap: table, sensor, and acceleration in that time |
| ramp time | least + (half the turn − least) · sigmoid | least: what the acceleration needs at that rate |
| temperature steps, visit by visit | even steps mixed with a softmax | mixed as far as the chamber's slope allows |

An axis has *turns at the table* of `own_time` each; after each it stands for `other_time` while other axes move. A
cycle is one or more turns at the table, each with moves of its own: a reading at rest costs time only between the moves
of one turn at the table, so a few long moves in each are better than all moves in each.

With limited travel a turn takes its share of the remaining travel in its direction instead of the largest angle, so
that only turns which would reach the end of the travel become smaller. A repeated cycle ends where it began.
"""

from dataclasses import replace
from itertools import pairwise
from typing import Any, NamedTuple

import equinox as eqx
import numpy as np
from jaxtyping import Float, Int

from gradcal_jax import formulas
from gradcal_jax.arrays import AnyArray, filled, namespace, put, scanned, size_class
from gradcal_jax.formulas import RAMPED_SHAPES
from gradcal_jax.motion import Programme, Schedule
from gradcal_jax.motion.motion import PieceTable, even_division, standing, turning
from gradcal_jax.motion.schedule import make_schedule

# A Python number before `Coordinates` are built, an array in them.
Scalar = Any

# Peak acceleration over (peak rate / time), the time being the ramp's, or the whole move's for shapes without ramps.
STEEPNESS = {"cosine ramps": np.pi / 2.0, "linear ramps": 1.0}

# Pieces of a rest and of the standing while other axes turn; the reading of each stands for all readings within it.
_PIECES_A_REST = 2
_PIECES_OF_OTHERS = 8

# Bisection steps for a share.
_HALVINGS = 30
# A turn shorter than this many times its least duration is removed.
_VANISHED = 3.0


class Element(NamedTuple):
    """Structure of one move of the cycle: a rest (`shape="rest"`) or a turn, with its least duration (s).

    `group` counts the cycle's turns at the table.
    """

    shape: str
    least: float
    group: int = 0


class Limits(NamedTuple):
    """Limits of rig and sensor: rad/s, rad/s², rad in each direction (`inf`: unlimited), K/s."""

    max_rate: Scalar
    max_acceleration: Scalar
    travel: Scalar
    max_slope: Scalar


class CycleNumbers(NamedTuple):
    """A decoded cycle: durations (s), signed peak rates (rad/s), ramp times (s) of its moves; temperature steps (K).

    There is one step for each turn at the table of the whole ramp, from its start to the start of the next one.
    """

    durations: Float[AnyArray, " k"]
    peak_rates: Float[AnyArray, " k"]
    ramps: Float[AnyArray, " k"]
    steps: Float[AnyArray, " v"]


class Frame(NamedTuple):
    """Times and temperatures in which a cycle is placed; all of them may be differentiated.

    `own_time` and `other_time` of each turn at the table, `motion_time` of the whole ramp, `read_every` (the spacing of
    readings at rest): s. Temperatures: °C.
    """

    own_time: Scalar
    other_time: Scalar
    motion_time: Scalar
    temperature_start: Scalar
    temperature_end: Scalar
    read_every: Scalar


SHAPES = ("rest", *STEEPNESS)
_FREE = ("duration", "peak_rate", "ramp", "gradient")


class Coordinates(eqx.Module):
    """The plans that one structure of cycle allows, over an unbounded vector of `size` numbers.

    Arrays `(k,)` of the cycle's moves: `shape` (index in `SHAPES`), `least` duration (s), turn at the table (`group`);
    `turns` and `ramped` are indices of moves. `visits`: number of turns at the table in the whole ramp. `free`: which
    of "duration" (of turns and rests), "peak_rate", "ramp", "gradient" vary; the others keep their `nominal` value.
    `travels`: the travel is limited; `repeats`: the cycle occurs more than once; `others_read`: readings continue while
    other axes turn; `parts`: pieces of each smooth part of a turn. `template`: the schedule that receives the times, of
    the standing while others turn, of the remaining time at the end, and of the moves, in this order.

    `make_coordinates` builds it and refuses infeasible limits. Entries that `padded` adds have no effect.
    """

    limits: Limits
    frame: Frame
    nominal: CycleNumbers
    template: Schedule
    shape: Int[AnyArray, " k"]
    least: Float[AnyArray, " k"]
    group: Int[AnyArray, " k"]
    turns: Int[AnyArray, " t"]
    ramped: Int[AnyArray, " r"]
    visits: Float[AnyArray, ""]
    groups: int = eqx.field(static=True)
    free: frozenset[str] = eqx.field(static=True)
    travels: bool = eqx.field(static=True)
    repeats: bool = eqx.field(static=True)
    others_read: bool = eqx.field(static=True)
    parts: int = eqx.field(static=True)

    @property
    def _sizes(self) -> tuple[int, int, int, int]:
        numbers = zip(_FREE, (self.least, self.turns, self.ramped, self.nominal.steps), strict=True)
        durations, rates, ramps, steps = (of.shape[0] if name in self.free else 0 for name, of in numbers)
        return durations, rates, ramps, steps

    @property
    def size(self) -> int:
        """Number of free coordinates."""
        return sum(self._sizes)

    def elements(self) -> tuple[Element, ...]:
        """The moves of the cycle."""
        columns = (self.shape, self.least, self.group)
        return tuple(Element(SHAPES[s], float(least), int(g)) for s, least, g in zip(*columns, strict=True))

    def cycle(self, z: Float[AnyArray, " size"]) -> CycleNumbers:
        """Decode: see the table at the module's head."""
        ends = np.cumsum(self._sizes)
        timed, turns, ramps, steps = (z[a:b] for a, b in pairwise([0, *ends]))
        return self._turned(self._durations(timed), turns, ramps)._replace(steps=self._steps(steps))

    def decode(self, z: Float[AnyArray, " size"]) -> Schedule:
        """The plan of a vector."""
        return self.plan(self.cycle(z))

    def plan(self, cycle: CycleNumbers) -> Schedule:
        """The plan of a decoded cycle with relaxed rests: their number of readings need not be whole."""
        frame, lasting = self.frame, self.lasting()
        xp = namespace(cycle, frame)
        before = xp.stack([xp.asarray(frame.other_time), xp.zeros(())])
        slopes = cycle.steps / xp.where(lasting > 0.0, lasting, 1.0)
        programme = Programme(xp.asarray(frame.temperature_start), lasting, slopes, xp.zeros(lasting.shape))
        joined = lambda first, values: xp.concatenate([first, values])  # noqa: E731
        times = joined(before, cycle.durations), *(joined(xp.zeros(2), of) for of in (cycle.peak_rates, cycle.ramps))
        return eqx.tree_at(
            lambda s: (s.duration, s.peak_rate, s.ramp, s.spacing, s.programme),
            self.template,
            (*times, xp.asarray(frame.read_every), programme),
        )

    def _durations(self, z):
        if not z.shape[0]:
            return self.nominal.durations
        xp = namespace(z, self.least)
        member = np.arange(self.groups)[:, None] == self.group[None]
        top = xp.max(xp.where(member, z[None], -xp.inf), axis=1, keepdims=True)
        # (A padded group has no member.)
        below = xp.where(member, z[None] - xp.where(xp.isfinite(top), top, 0.0), 0.0)
        weight = xp.where(member, xp.exp(below), 0.0)
        left = self.frame.own_time - xp.sum(xp.where(member, self.least[None], 0.0), axis=1)
        share = left[:, None] * weight / xp.maximum(xp.sum(weight, axis=1, keepdims=True), 1.0)
        return self.least + xp.sum(share, axis=0)

    def _turned(self, durations, z_rates, z_ramps) -> CycleNumbers:
        """Turns at a share of the largest feasible rate, reduced where the travel ends."""
        cap = self._cap(durations)
        xp = namespace(cap, z_rates)
        if z_rates.shape[0]:
            peak = put(self.nominal.peak_rates, self.turns, cap[self.turns] * xp.tanh(z_rates))
        else:
            peak = xp.clip(self.nominal.peak_rates, -cap, cap)
        cycle = self._ramps(durations, peak, z_ramps)
        if not self.travels or not self.turns.shape[0]:
            return cycle
        return self._within_travel(cycle, self._ramps(durations, cap, z_ramps))

    def _cap(self, durations):
        """The largest rate that rig, sensor and, for the move's duration, the acceleration allow."""
        xp = namespace(durations, self.limits)
        time = xp.where(self._of_shape(_HAS_RAMPS), 0.5, 1.0) * durations
        steep = self._of_shape(_STEEP)
        largest = self.limits.max_acceleration * time / xp.where(steep > 0.0, steep, 1.0)
        return xp.minimum(xp.asarray(self.limits.max_rate), largest)

    def _of_shape(self, table: np.ndarray):
        return namespace(self.shape).asarray(table)[self.shape]

    def _ramps(self, durations, peak, z_ramps) -> CycleNumbers:
        xp = namespace(durations, peak, z_ramps)
        least = self._of_shape(_STEEP) * xp.abs(peak) / self.limits.max_acceleration
        ramp, ramped = self.nominal.ramps, self.ramped
        if z_ramps.shape[0]:
            room = 0.5 * durations[ramped] - least[ramped]
            ramp = put(ramp, ramped, least[ramped] + room * _sigmoid(z_ramps))
        else:
            ramp = xp.clip(ramp, least, 0.5 * durations)
        return CycleNumbers(durations, peak, ramp, self.nominal.steps)

    def _within_travel(self, wanted: CycleNumbers, fastest: CycleNumbers) -> CycleNumbers:
        """Each turn takes its share of the angle that is available in its direction from the present position.

        A repeated cycle must end where it began: an angle that no later turn can undo is not available either, and
        where too much remains to be undone, a turn goes back by the necessary angle.
        """
        turns = self.turns
        asked, most = (self.angles(c)[turns] for c in (wanted, fastest))
        xp = namespace(asked)
        if turns.shape[0] and xp is not np:
            # Padded indices refer to no turn.
            real = turns < self.least.shape[0]
            asked, most = xp.where(real, asked, 0.0), xp.where(real, most, 0.0)
        bound = xp.full(turns.shape, 1.0) * self.limits.travel
        if self.repeats:
            # The angle that the turns after each one can undo.
            bound = xp.minimum(bound, xp.cumsum(most[::-1])[::-1] - most)

        def turn(at, row):
            angle, reach, furthest = row
            down = xp.maximum(-furthest, at - reach) - at
            up = xp.minimum(furthest, at + reach) - at
            share = angle / xp.where(reach > 0.0, reach, 1.0)
            feasible = xp.clip(share * xp.where(share > 0.0, up, -down), xp.minimum(down, up), up)
            return at + feasible, feasible

        feasible = scanned(turn, xp.zeros(()), (asked, most, bound))
        # A reduced turn keeps its ramp; one that must go back needs the ramp of the fastest turn.
        smaller = xp.abs(feasible) <= xp.abs(asked)
        of = lambda cycle, angles: cycle.peak_rates[turns] * feasible / xp.where(angles == 0.0, 1.0, angles)  # noqa: E731
        peak = xp.where(smaller, of(wanted, asked), of(fastest, most))
        ramp = xp.where(smaller, wanted.ramps[turns], fastest.ramps[turns])
        return wanted._replace(peak_rates=put(wanted.peak_rates, turns, peak), ramps=put(wanted.ramps, turns, ramp))

    def lasting(self) -> Float[AnyArray, " v"]:
        """Time (s) from the start of each turn at the table to the next one's, for the last to the ramp's end."""
        visit = self.frame.own_time + self.frame.other_time
        xp = namespace(self.frame, self.visits)
        number = np.arange(self.nominal.steps.shape[0], dtype=float)
        last = self.frame.motion_time - (self.visits - 1) * visit
        return xp.where(number < self.visits - 1, visit, xp.where(number == self.visits - 1, last, 0.0))

    def _steps(self, z):
        span = self.frame.temperature_end - self.frame.temperature_start
        lasting = self.lasting()
        even = span * lasting / self.frame.motion_time
        if not z.shape[0]:
            return even
        xp = namespace(z, even)
        there = lasting > 0.0
        top = xp.max(xp.where(there, z, -xp.inf))
        weight = xp.where(there, xp.exp(xp.where(there, z - top, 0.0)), 0.0)
        uneven = span * weight / xp.sum(weight)
        over = xp.abs(uneven) - xp.abs(even)
        steepest = self.limits.max_slope * lasting
        room = xp.where(over > 0.0, (steepest - xp.abs(even)) / xp.where(over > 0.0, over, 1.0), xp.inf)
        mix = xp.clip(xp.min(room), 0.0, 1.0)
        return even + mix * (uneven - even)

    def angles(self, cycle: CycleNumbers) -> Float[AnyArray, " k"]:
        """Angle (rad) of each move."""
        by_duration, by_ramp = (self._of_shape(column) for column in _ANGLE)
        return cycle.peak_rates * (by_duration * cycle.durations + by_ramp * cycle.ramps)

    def vector(self, cycle: CycleNumbers) -> Float[np.ndarray, " size"]:
        """Coordinates of a cycle; values at a bound are moved slightly inside, since bounds are only approached."""
        durations, peaks, ramps = (np.asarray(v) for v in cycle[:3])
        spare = np.maximum(durations - self.least, 1e-4)
        least = (self._of_shape(_STEEP) * np.abs(peaks) / float(self.limits.max_acceleration))[self.ramped]
        share = (ramps[self.ramped] - least) / np.maximum(0.5 * durations[self.ramped] - least, 1e-12)
        share = np.clip(share, 1e-3, 1.0 - 1e-3)
        z_ramps = np.log(share / (1.0 - share))
        rates = self._shares(cycle, z_ramps)
        span = float(self.frame.temperature_end - self.frame.temperature_start)
        steps = np.maximum(np.asarray(cycle.steps) / span, 1e-4)
        parts = (np.log(spare), np.arctanh(np.clip(rates, -1 + 1e-4, 1 - 1e-4)), z_ramps, np.log(steps))
        return np.concatenate([p for p, size in zip(parts, self._sizes, strict=True) if size])

    def _shares(self, cycle: CycleNumbers, z_ramps: np.ndarray) -> np.ndarray:
        """Share of the largest rate of each turn; with limited travel, the share that yields its angle."""
        turns, cap = self.turns, self._cap(np.asarray(cycle.durations))
        if not self.travels:
            return np.asarray(cycle.peak_rates)[turns] / cap[turns]
        ramps = z_ramps if self._sizes[2] else z_ramps[:0]

        def at_shares(shares: np.ndarray) -> np.ndarray:
            peaks = put(np.zeros(len(cap)), turns, shares * cap[turns])
            return self.angles(self._ramps(np.asarray(cycle.durations), peaks, ramps))[turns]

        angles, reach = self.angles(CycleNumbers(*map(np.asarray, cycle)))[turns], at_shares(np.ones(len(turns)))
        at = np.concatenate([[0.0], np.cumsum(angles)[:-1]])
        room = np.minimum(reach, np.maximum(float(self.limits.travel) - np.sign(angles) * at, 0.0))
        wanted = reach * np.abs(angles) / np.where(room > 0.0, room, 1.0)
        # The angle is not proportional to the rate: a faster turn needs longer ramps.
        low, high = np.zeros(len(turns)), np.ones(len(turns))
        for _ in range(_HALVINGS):
            middle = 0.5 * (low + high)
            short = at_shares(middle) < wanted
            low, high = np.where(short, middle, low), np.where(short, high, middle)
        return np.sign(angles) * 0.5 * (low + high)

    def pruned(self, cycle: CycleNumbers) -> "tuple[Coordinates, CycleNumbers]":
        """The structure without the turns that the search has shrunk to nothing; the longest one gets their time."""
        durations, elements = np.array(cycle.durations), self.elements()
        keep = np.ones(len(elements), bool)
        for group in range(self.groups):
            members = [i for i, e in enumerate(elements) if e.group == group]
            turns = [i for i in members if elements[i].shape != "rest"]
            longest = max(turns, key=lambda i: durations[i], default=None)
            for i in turns:
                if i != longest and durations[i] < _VANISHED * elements[i].least:
                    keep[i] = False
            # One rest remains between neighbouring turns, with the time of all rests there, and one at each end where
            # the structure has one, since no rest precedes or follows it.
            kept = [i for i in turns if keep[i]]
            resting = [i for i in members if elements[i].shape == "rest"]
            keep[resting] = False
            ends = [members[0] - 1] * (members[0] in resting), [members[-1] + 1] * (members[-1] in resting)
            for before, after in pairwise([*ends[0], *kept, *ends[1]]):
                between = [i for i in resting if before < i < after]
                if between:
                    keep[between[0]] = True
                    durations[between[0]] = sum(durations[i] for i in between)
                    durations[between[1:]] = 0.0
            spare = sum(durations[i] for i in members if not keep[i])
            if longest is not None:
                durations[longest] += spare
        peaks, ramps = (np.asarray(v)[keep] for v in cycle[1:3])
        left = CycleNumbers(durations[keep], peaks, ramps, np.asarray(cycle.steps))
        return self.with_elements(tuple(e for e, k in zip(elements, keep, strict=True) if k), left), left

    def with_elements(self, elements: tuple[Element, ...], nominal: CycleNumbers) -> "Coordinates":
        """The same frame with other moves."""
        cycles, tail = int(self.visits) // self.groups, bool(len(self.template.fill_move))
        structure = _Structure(cycles, self.others_read, self.free, self.parts, tail)
        return _coordinates(elements, self.limits, self.frame, nominal, structure)

    def padded(self) -> "Coordinates":
        """Pad the sizes to few classes, so that one compiled program serves many structures."""
        count = size_class(len(self.least))
        steps = size_class(len(self.nominal.steps))
        longer = lambda values, filling=0.0: filled(values, count, filling)  # noqa: E731
        none = lambda places: filled(places, size_class(len(places)), count)  # noqa: E731
        nominal = CycleNumbers._make([*map(longer, self.nominal[:3]), filled(self.nominal.steps, steps, 0.0)])
        groups = size_class(self.groups)
        return replace(
            self,
            nominal=nominal,
            template=self.template.padded(moves=2 + count, stretches=steps),
            shape=longer(self.shape, 0),
            least=longer(self.least),
            group=longer(self.group, groups),
            turns=none(self.turns),
            ramped=none(self.ramped),
            groups=groups,
        )

    def places_in(self, padded: "Coordinates") -> np.ndarray:
        """Indices of these coordinates in a vector of the padded ones."""
        begins = np.cumsum([0, *padded._sizes[:-1]])
        return np.concatenate([b + np.arange(n) for b, n in zip(begins, self._sizes, strict=True)])

    def eased(self, by: Float[AnyArray, " 5"]) -> "Coordinates":
        """The same structure with limits relaxed by SI amounts: the ramp's time (cycle and turns in proportion), the
        largest rate, the largest acceleration, the travel, the chamber's slope.
        """
        frame, limits = self.frame, self.limits
        stretch = 1.0 + by[0] / frame.motion_time
        times = {name: getattr(frame, name) * stretch for name in ("own_time", "other_time", "motion_time")}
        limits = Limits(
            limits.max_rate + by[1],
            limits.max_acceleration + by[2],
            limits.travel + by[3] if self.travels else limits.travel,
            limits.max_slope + by[4],
        )
        return replace(self, frame=frame._replace(**times), limits=limits)


_STEEP = np.array([0.0, *STEEPNESS.values()])
_HAS_RAMPS = np.array([shape in RAMPED_SHAPES for shape in SHAPES])
# For unit peak rate: angle = first·duration + second·ramp, as `formulas.turned_angle`.
_ANGLE = np.array([(0.0, 0.0), *((1.0, -1.0) for _ in STEEPNESS)]).T


def _sigmoid(x):
    return 0.5 * (1.0 + namespace(x).tanh(0.5 * x))


def make_coordinates(
    elements: tuple[Element, ...],
    limits: Limits,
    frame: Frame,
    *,
    cycles: int,
    others_read: bool,
    free: frozenset[str],
    nominal: CycleNumbers | None = None,
    longest_piece: float = np.inf,
) -> Coordinates:
    """Coordinates from plain numbers. `nominal` None: every turn at the table shared evenly, no motion.

    `others_read`: readings continue while other axes turn; `longest_piece` s: longest piece in which a part of a turn
    is integrated. Errors: `ValueError` that states which limits exclude each other.
    """
    if [e.group for e in elements] != sorted(e.group for e in elements):
        raise ValueError(
            "the moves of a cycle must be in the order of its visits (the parts of a cycle in which this axis may turn)"
        )
    groups = elements[-1].group + 1
    for group in range(groups):
        least = sum(e.least for e in elements if e.group == group)
        if least > frame.own_time * (1.0 + 1e-9):
            raise ValueError(
                f"the moves need at least {least:.4g} s, but the axis may turn for only {frame.own_time:.4g} s in "
                "each cycle: use fewer moves or a longer cycle"
            )
    slope = abs(frame.temperature_end - frame.temperature_start) / frame.motion_time
    if slope > limits.max_slope * (1.0 + 1e-9):
        raise ValueError(
            f"the ramp needs a slope of {slope * 60:.4g} K/min, but the chamber reaches only "
            f"{limits.max_slope * 60:.4g} "
            "K/min: allow more time, or a smaller range"
        )
    used = cycles * groups * (frame.own_time + frame.other_time) - frame.other_time
    if used > frame.motion_time * (1.0 + 1e-9):
        raise ValueError(f"the cycles take {used:.6g} s, but the ramp lasts only {frame.motion_time:.6g} s")
    if nominal is None:
        share = [float(frame.own_time) / sum(o.group == e.group for o in elements) for e in elements]
        zeros = np.zeros(len(elements))
        nominal = CycleNumbers(np.array(share), zeros, zeros, np.zeros(cycles * groups))
    parts = max(1, int(np.ceil(float(frame.own_time) / longest_piece)))
    tail = bool(frame.motion_time - used > 1e-6)
    return _coordinates(elements, limits, frame, nominal, _Structure(cycles, others_read, free, parts, tail))


class _Structure(NamedTuple):
    """See `make_coordinates`, and `Coordinates` for `parts`; `tail`: time remains at the end of the ramp."""

    cycles: int
    others_read: bool
    free: frozenset[str]
    parts: int
    tail: bool


def _coordinates(
    elements: tuple[Element, ...], limits: Limits, frame: Frame, nominal: CycleNumbers, structure: _Structure
) -> Coordinates:
    cycles, others_read, free, parts, tail = structure
    groups, count = elements[-1].group + 1, len(elements)
    visits = cycles * groups
    kinds = [e.shape for e in elements]
    as_arrays = lambda values: type(values)(*(np.asarray(v, dtype=float) for v in values))  # noqa: E731
    resting = standing(even_division(_PIECES_A_REST, True))
    waiting = standing(even_division(_PIECES_OF_OTHERS, others_read))
    tables = [resting if kind == "rest" else _turn(kind, parts) for kind in kinds]
    placed: list[tuple[int, PieceTable]] = []
    for visit in range(visits):
        placed += [(2 + i, tables[i]) for i, e in enumerate(elements) if e.group == visit % groups]
        if float(frame.other_time) > 0.0 and visit < visits - 1:
            placed.append((0, waiting))
    fillers = []
    if tail:
        placed.append((1, waiting))
        fillers.append((1, 0, visits, np.array([visits - 1.0, 0.0, *([float(cycles)] * count)])))
    programme = Programme(np.zeros(()), *(np.zeros(visits) for _ in range(3)))
    template = make_schedule(
        programme, [(0.0, 0.0, 0.0)] * (2 + count), placed, first_knot=0, fillers=fillers, spacing=1.0
    )
    shape, least = np.array([SHAPES.index(kind) for kind in kinds]), np.array([e.least for e in elements], dtype=float)
    turns = [i for i, kind in enumerate(kinds) if kind != "rest"]
    ramped = [i for i, kind in enumerate(kinds) if kind in RAMPED_SHAPES]
    lists = np.array(turns, dtype=int), np.array(ramped, dtype=int), np.asarray(float(visits))
    numbers = as_arrays(limits), as_arrays(frame), as_arrays(nominal)
    moves = shape, least, np.array([e.group for e in elements])
    flags = bool(np.isfinite(limits.travel)), cycles > 1, others_read
    return Coordinates(*numbers, template, *moves, *lists, groups, free, *flags, parts)


def _turn(shape: str, parts: int) -> PieceTable:
    """A turn with one reading at its end, each of its smooth parts in `parts` pieces."""
    smooth = len(formulas.shape_pieces(shape))
    edges, unread = even_division(parts, False)
    last = (*unread[:-1], True)
    return turning(shape, ((edges, unread),) * (smooth - 1) + ((edges, last),), 0.0)
