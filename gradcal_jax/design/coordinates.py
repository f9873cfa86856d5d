"""Free coordinates: any real vector decodes to a cycle that the table executes, and a ramp that the chamber follows.

| what | from free numbers | why it is feasible |
|---|---|---|
| durations of the moves of a turn at the table | least times + what is left · softmax | they fill that time exactly |
| peak rate of a turn | cap · tanh, in its band if it has one | cap: table, sensor, and acceleration in that time |
| ramp time | least + (half the turn − least) · sigmoid | least: what the acceleration needs at that rate |
| temperature steps, visit by visit | even steps mixed with a softmax | mixed as far as the chamber's slope allows |

The axis has its *turns at the table*, `own_time` each, with `other_time` standing after each for the other axes; a
cycle is one or more of them, with moves of their own (a reading at rest costs time only between the moves of one turn
at the table, so few long moves in each, others in the next, are better than all in each).

With limited travel each turn takes its share not of the largest angle but of what is left of the travel that way, so
that only turns which would reach the end of the cable are smaller; a cycle that is made again ends where it began.
"""

from itertools import pairwise
from typing import Any, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from gradcal_jax import formulas
from gradcal_jax.formulas import RAMPED_SHAPES
from gradcal_jax.plans import GradientPlan, Move, Programme
from gradcal_jax.plans.motion import Division
from gradcal_jax.plans.plan import Stretch

# A number outside, an array within `Coordinates`.
Scalar = Any

# Peak acceleration over (peak rate / time), the time being the ramp's, or the whole move's for shapes without ramps.
_STEEPNESS = {"cosine ramps": np.pi / 2.0, "linear ramps": 1.0, "half sine": np.pi, "raised cosine": np.pi}

# A rest, and the standing while others turn, are searched with this many pieces; each one's reading stands for all that
# fall into it.
_PIECES_A_REST = 2
_PIECES_OF_OTHERS = 8

# How often a share is halved in on.
_HALVINGS = 30
# A turn that is shorter than this many times the least it may take has vanished.
_VANISHED = 3.0


class Element(NamedTuple):
    """One move of the cycle, as structure: a rest (`shape="rest"`) or a turn, and the least time it may take (s).

    `group` counts the cycle's turns at the table. `band`: where a turn's peak rate must lie, in shares of the largest.
    """

    shape: str
    least: float
    group: int = 0
    band: tuple[float, float] = (-1.0, 1.0)


class Limits(NamedTuple):
    """What rig and sensor allow: rad/s, rad/s², rad each way (`inf`: unlimited), K/s."""

    max_rate: Scalar
    max_acceleration: Scalar
    travel: Scalar
    max_slope: Scalar


class Cycle(NamedTuple):
    """A decoded cycle: durations (s), signed peak rates (rad/s), ramp times (s) of its moves; temperature steps (K).

    There is a step for each turn at the table of the whole ramp, taken from its start to the next one's.
    """

    durations: Float[Array, " k"]
    peak_rates: Float[Array, " k"]
    ramps: Float[Array, " k"]
    steps: Float[Array, " v"]


class Frame(NamedTuple):
    """The frame that a cycle is made in; everything in it may be differentiated.

    `own_time`, `other_time`: of each turn at the table; `motion_time`: the whole ramp's; `read_every`, at rest: s.
    Temperatures °C.
    """

    own_time: Scalar
    other_time: Scalar
    motion_time: Scalar
    temperature_start: Scalar
    temperature_end: Scalar
    read_every: Scalar


class Coordinates(eqx.Module):
    """The plans that one structure of cycle allows, over an unbounded vector of `size` numbers.

    `cycles`: how often the cycle is made. Free: which of "duration" (of turns and rests), "peak_rate", "ramp",
    "gradient" may change; what may not stays as in `nominal`. `shared`: other axes take their time. `tail`: the ramp
    goes on after the last cycle. `parts`: pieces that each smooth part of a turn is integrated in; `pieces`: those of a
    rest and of the standing while others turn.
    Made by `make_coordinates`, which refuses what cannot be.
    """

    elements: tuple[Element, ...] = eqx.field(static=True)
    limits: Limits
    frame: Frame
    nominal: Cycle
    cycles: int = eqx.field(static=True)
    others_read: bool = eqx.field(static=True)
    free: frozenset[str] = eqx.field(static=True)
    travels: bool = eqx.field(static=True)
    shared: bool = eqx.field(static=True)
    tail: bool = eqx.field(static=True)
    parts: int = eqx.field(static=True, default=1)
    axis: str = eqx.field(static=True, default="x")
    pieces: tuple[int, int] = eqx.field(static=True, default=(_PIECES_A_REST, _PIECES_OF_OTHERS))

    @property
    def groups(self) -> int:
        """Turns at the table in a cycle."""
        return self.elements[-1].group + 1

    @property
    def visits(self) -> int:
        """Turns at the table in the whole ramp."""
        return self.cycles * self.groups

    @property
    def _turns(self) -> np.ndarray:
        return np.array([i for i, e in enumerate(self.elements) if e.shape != "rest"], dtype=int)

    @property
    def _ramped(self) -> np.ndarray:
        return np.array([i for i, e in enumerate(self.elements) if e.shape in RAMPED_SHAPES], dtype=int)

    @property
    def _sizes(self) -> tuple[int, int, int, int]:
        timed = len(self.elements) if "duration" in self.free else 0
        return (
            timed,
            len(self._turns) if "peak_rate" in self.free else 0,
            len(self._ramped) if "ramp" in self.free else 0,
            len(self.nominal.steps) if "gradient" in self.free else 0,
        )

    @property
    def size(self) -> int:
        """How many free numbers there are."""
        return sum(self._sizes)

    def cycle(self, z: Float[Array, " size"]) -> Cycle:
        """Decode: see the table at the module's head."""
        timed, turns, ramps, steps = jnp.split(z, np.cumsum(self._sizes)[:-1])
        return self._turned(self._durations(timed), turns, ramps)._replace(steps=self._steps(steps))

    def decode(self, z: Float[Array, " size"]) -> GradientPlan:
        """The plan of a vector."""
        return self.plan(self.cycle(z))

    def _durations(self, z: Array) -> Array:
        if not z.shape[0]:
            return self.nominal.durations
        parts = []
        for group in range(self.groups):
            members = np.array([i for i, e in enumerate(self.elements) if e.group == group])
            least = np.array([self.elements[i].least for i in members])
            parts.append(least + (self.frame.own_time - np.sum(least)) * jax.nn.softmax(z[members]))
        return jnp.concatenate(parts)

    def _turned(self, durations: Array, z_rates: Array, z_ramps: Array) -> Cycle:
        """Turns at the share of the largest possible rate that is wanted, and less where the travel ends."""
        cap = self._cap(durations)
        if z_rates.shape[0]:
            low, high = np.array([self.elements[i].band for i in self._turns]).reshape(-1, 2).T
            wanted = 0.5 * (low + high) + 0.5 * (high - low) * jnp.tanh(z_rates)
            peak = self.nominal.peak_rates.at[self._turns].set(cap[self._turns] * wanted)
        else:
            peak = jnp.clip(self.nominal.peak_rates, -cap, cap)
        cycle = self._ramps(durations, peak, z_ramps)
        if not self.travels or not len(self._turns):
            return cycle
        return self._within_travel(cycle, self._ramps(durations, cap, z_ramps))

    def _cap(self, durations: Array) -> Array:
        """The largest rate that rig, sensor and the acceleration in so long a move allow."""
        time = jnp.where(np.isin(np.arange(len(self.elements)), self._ramped), 0.5, 1.0) * durations
        steep = self._steep
        return jnp.minimum(
            self.limits.max_rate, self.limits.max_acceleration * time / np.where(steep > 0.0, steep, 1.0)
        )

    @property
    def _steep(self) -> np.ndarray:
        return np.array([_STEEPNESS.get(e.shape, 0.0) for e in self.elements])

    def _ramps(self, durations: Array, peak: Array, z_ramps: Array) -> Cycle:
        least = self._steep * jnp.abs(peak) / self.limits.max_acceleration
        ramp, ramped = self.nominal.ramps, self._ramped
        if z_ramps.shape[0]:
            room = 0.5 * durations[ramped] - least[ramped]
            ramp = ramp.at[ramped].set(least[ramped] + room * jax.nn.sigmoid(z_ramps))
        else:
            ramp = jnp.clip(ramp, least, 0.5 * durations)
        return Cycle(durations, peak, ramp, self.nominal.steps)

    def _within_travel(self, wanted: Cycle, fastest: Cycle) -> Cycle:
        """Each turn takes its share of what may be turned that way from where the axis stands.

        A cycle that is made again must end where it began: what no later turn could undo is left out, too, and where
        too much is to be undone, a turn goes back by as much as it must.
        """
        turns = self._turns
        asked, most = (jnp.stack([self.angle(c, int(i)) for i in turns]) for c in (wanted, fastest))
        bound = jnp.full(len(turns), self.limits.travel)
        if self.cycles > 1:
            # What is still to come after each turn.
            bound = jnp.minimum(bound, jnp.cumsum(most[::-1])[::-1] - most)

        def turn(at, given):
            angle, reach, furthest = given
            down = jnp.maximum(-furthest, at - reach) - at
            up = jnp.minimum(furthest, at + reach) - at
            share = angle / jnp.where(reach > 0.0, reach, 1.0)
            made = jnp.clip(share * jnp.where(share > 0.0, up, -down), jnp.minimum(down, up), up)
            return at + made, made

        _, made = jax.lax.scan(turn, jnp.zeros(()), (asked, most, bound))
        # A turn that is made smaller keeps its ramp; one that is sent back needs the ramp of the fastest.
        smaller = jnp.abs(made) <= jnp.abs(asked)
        of = lambda cycle, angles: cycle.peak_rates[turns] * made / jnp.where(angles == 0.0, 1.0, angles)  # noqa: E731
        peak = jnp.where(smaller, of(wanted, asked), of(fastest, most))
        ramp = jnp.where(smaller, wanted.ramps[turns], fastest.ramps[turns])
        return wanted._replace(peak_rates=wanted.peak_rates.at[turns].set(peak), ramps=wanted.ramps.at[turns].set(ramp))

    def lasting(self) -> Array:
        """From the start of each turn at the table to the next one's, and to the ramp's end for the last."""
        visit = self.frame.own_time + self.frame.other_time
        whole = jnp.full(self.visits - 1, visit)
        return jnp.concatenate([whole, jnp.reshape(self.frame.motion_time - (self.visits - 1) * visit, (1,))])

    def _steps(self, z: Array) -> Array:
        span = self.frame.temperature_end - self.frame.temperature_start
        lasting = self.lasting()
        even = span * lasting / self.frame.motion_time
        if not z.shape[0]:
            return even
        uneven = span * jax.nn.softmax(z)
        over = jnp.abs(uneven) - jnp.abs(even)
        steepest = self.limits.max_slope * lasting
        room = jnp.where(over > 0.0, (steepest - jnp.abs(even)) / jnp.where(over > 0.0, over, 1.0), jnp.inf)
        mix = jnp.clip(jnp.min(room), 0.0, 1.0)
        return even + mix * (uneven - even)

    def angle(self, cycle: Cycle, i: int) -> Array:
        """How far move `i` turns, rad."""
        return formulas.turned_angle(self.elements[i].shape, cycle.peak_rates[i], cycle.durations[i], cycle.ramps[i])

    def vector(self, cycle: Cycle) -> Float[np.ndarray, " size"]:
        """Free numbers whose cycle is nearly the given one: bounds can only be approached."""
        durations, peaks, ramps = (np.asarray(v) for v in cycle[:3])
        spare = np.maximum(durations - np.array([e.least for e in self.elements]), 1e-4)
        turns, ramped = self._turns, self._ramped
        least = (self._steep * np.abs(peaks) / float(self.limits.max_acceleration))[ramped]
        share = (ramps[ramped] - least) / np.maximum(0.5 * durations[ramped] - least, 1e-12)
        share = np.clip(share, 1e-3, 1.0 - 1e-3)
        z_ramps = np.log(share / (1.0 - share))
        low, high = np.array([self.elements[i].band for i in turns]).reshape(-1, 2).T
        rates = (self._shares(cycle, z_ramps) - 0.5 * (low + high)) / (0.5 * (high - low))
        steps = np.maximum(
            np.asarray(cycle.steps) / float(self.frame.temperature_end - self.frame.temperature_start), 1e-4
        )
        parts = (np.log(spare), np.arctanh(np.clip(rates, -1 + 1e-4, 1 - 1e-4)), z_ramps, np.log(steps))
        return np.concatenate([p for p, size in zip(parts, self._sizes, strict=True) if size])

    def _shares(self, cycle: Cycle, z_ramps: np.ndarray) -> np.ndarray:
        """Which share of the largest rate each turn has; with limited travel, what asks for its share of the angle."""
        turns, cap = self._turns, np.asarray(self._cap(cycle.durations))
        if not self.travels:
            return np.asarray(cycle.peak_rates)[turns] / cap[turns]
        ramps = jnp.asarray(z_ramps if self._sizes[2] else z_ramps[:0])

        def angles(of: Cycle) -> np.ndarray:
            return np.array([float(self.angle(of, int(i))) for i in turns])

        def at_shares(shares: np.ndarray) -> np.ndarray:
            peaks = np.zeros(len(cap))
            peaks[turns] = shares * cap[turns]
            return angles(self._ramps(cycle.durations, jnp.asarray(peaks), ramps))

        made, reach = angles(cycle), at_shares(np.ones(len(turns)))
        at = np.concatenate([[0.0], np.cumsum(made)[:-1]])
        room = np.minimum(reach, np.maximum(float(self.limits.travel) - np.sign(made) * at, 0.0))
        wanted = reach * np.abs(made) / np.where(room > 0.0, room, 1.0)
        # The angle grows with the rate, not quite in proportion: a faster turn needs longer ramps.
        low, high = np.zeros(len(turns)), np.ones(len(turns))
        for _ in range(_HALVINGS):
            middle = 0.5 * (low + high)
            short = at_shares(middle) < wanted
            low, high = np.where(short, middle, low), np.where(short, high, middle)
        return np.sign(made) * 0.5 * (low + high)

    def pruned(self, cycle: Cycle) -> "tuple[Coordinates, Cycle]":
        """The structure without the turns that the search has shrunk to nothing, their time given to the longest."""
        durations = np.array(cycle.durations)
        keep = np.ones(len(self.elements), bool)
        for group in range(self.groups):
            members = [i for i, e in enumerate(self.elements) if e.group == group]
            turns = [i for i in members if self.elements[i].shape != "rest"]
            longest = max(turns, key=lambda i: durations[i], default=None)
            for i in turns:
                if i != longest and durations[i] < _VANISHED * self.elements[i].least and not self._banded(i):
                    keep[i] = False
            # Between neighbouring turns that are kept stands one rest, with the time of all that were there; one more
            # at the ends, where the structure has one: there the axis has not stood before, or will not stand after.
            kept = [i for i in turns if keep[i]]
            resting = [i for i in members if self.elements[i].shape == "rest"]
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
        elements = tuple(e for e, k in zip(self.elements, keep, strict=True) if k)
        kept = lambda values: jnp.asarray(np.asarray(values)[keep])  # noqa: E731
        left = Cycle(kept(durations), kept(cycle.peak_rates), kept(cycle.ramps), cycle.steps)
        smaller = eqx.tree_at(lambda c: c.nominal, self, left)
        return _with_elements(smaller, elements), left

    def _banded(self, i: int) -> bool:
        return self.elements[i].band != (-1.0, 1.0)

    def plan(self, cycle: Cycle) -> GradientPlan:
        """The plan of a decoded cycle, its rests relaxed: readings by their share, not by whole numbers."""
        spacing = self.frame.read_every
        others = even_division(self.pieces[1], self.others_read)
        standing = (_rest(self.frame.other_time, others, spacing, self.axis),) if self.shared else ()
        moves: list[Move] = []
        for i, element in enumerate(self.elements):
            if i and element.group != self.elements[i - 1].group:
                moves += standing
            moves.append(self._move(element, cycle, i, spacing))
        lasting = self.lasting()
        programme = Programme(self.frame.temperature_start, lasting, cycle.steps / lasting)
        tail = others if self.tail else None
        return GradientPlan(
            programme,
            tuple(moves),
            standing,
            (Stretch(0, self.visits, self.cycles, tail),),
            tail_spacing=spacing,
        )

    def _move(self, element: Element, cycle: Cycle, i: int, spacing: Array) -> Move:
        if element.shape == "rest":
            return _rest(cycle.durations[i], even_division(self.pieces[0], True), spacing, self.axis)
        whole = Division((0.0, 1.0), (True,))
        pieces = len(formulas.shape_pieces(element.shape))
        unread = even_division(self.parts, False)
        last = Division(unread.edges, (*unread.read[:-1], True))
        return Move(
            cycle.peak_rates[i],
            cycle.durations[i],
            cycle.ramps[i],
            jnp.zeros(0),
            jnp.zeros(()),
            shape=element.shape,
            axis=self.axis,
            cycles=1,
            divisions=(unread,) * (pieces - 1) + (last,),
            division_at_rest=whole,
        )


def make_coordinates(
    elements: tuple[Element, ...],
    limits: Limits,
    frame: Frame,
    *,
    cycles: int,
    others_read: bool,
    free: frozenset[str],
    nominal: Cycle | None = None,
    longest_piece: float = np.inf,
    axis: str = "x",
) -> Coordinates:
    """Coordinates from plain numbers. `nominal` None: every visit's time shared evenly, nothing turning.

    `longest_piece` s: a part of a turn is integrated in pieces of this length at most.

    Errors: `ValueError` that says which limits exclude each other.
    """
    if [e.group for e in elements] != sorted(e.group for e in elements):
        raise ValueError("the moves of a cycle must be in the order of its turns at the table")
    groups = elements[-1].group + 1
    for group in range(groups):
        least = sum(e.least for e in elements if e.group == group)
        if least > frame.own_time * (1.0 + 1e-9):
            raise ValueError(
                f"the moves need at least {least:.4g} s but the axis has {frame.own_time:.4g} s in each cycle: "
                "take fewer moves or a longer cycle"
            )
    slope = abs(frame.temperature_end - frame.temperature_start) / frame.motion_time
    if slope > limits.max_slope * (1.0 + 1e-9):
        raise ValueError(
            f"the ramp needs {slope * 60:.4g} K/min but the chamber manages "
            f"{limits.max_slope * 60:.4g} K/min: give it more time, or a smaller range"
        )
    used = cycles * groups * (frame.own_time + frame.other_time) - frame.other_time
    if used > frame.motion_time * (1.0 + 1e-9):
        raise ValueError(f"the cycles take {used:.6g} s but the ramp only {frame.motion_time:.6g} s")
    if nominal is None:
        share = [float(frame.own_time) / sum(o.group == e.group for o in elements) for e in elements]
        zeros = jnp.zeros(len(elements))
        nominal = Cycle(jnp.array(share), zeros, zeros, jnp.zeros(cycles * groups))
    as_arrays = lambda values: type(values)(*(jnp.asarray(v, dtype=float) for v in values))  # noqa: E731
    return Coordinates(
        elements,
        as_arrays(limits),
        as_arrays(frame),
        as_arrays(nominal),
        cycles,
        others_read,
        free,
        travels=bool(np.isfinite(limits.travel)),
        shared=frame.other_time > 0.0,
        tail=bool(frame.motion_time - used > 1e-6),
        parts=max(1, int(np.ceil(float(frame.own_time) / longest_piece))),
        axis=axis,
    )


def _with_elements(of: Coordinates, elements: tuple[Element, ...]) -> Coordinates:
    rest = (of.cycles, of.others_read, of.free, of.travels, of.shared, of.tail, of.parts, of.axis, of.pieces)
    return Coordinates(elements, of.limits, of.frame, of.nominal, *rest)


def even_division(count: int, read: bool) -> Division:
    """A part of a move in `count` equal pieces, all ending with a reading, or none."""
    return Division(tuple(float(k) / count for k in range(count + 1)), (read,) * count)


def _rest(duration: Array, division: Division, spacing: Array, axis: str) -> Move:
    zero = jnp.zeros(())
    return Move(
        zero, duration, zero, jnp.zeros(0), zero, "rest", axis, 1, (division,), division, spacing=spacing
    )  # fmt: skip
