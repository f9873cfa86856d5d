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

With limited travel the turns in the direction that prevails are scaled down until a cycle ends where it began, then all
of them until the largest excursion fits: scaling down keeps every other limit.
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
SEARCHED_SHAPES = tuple(_STEEPNESS)

# A rest is searched with this many pieces; each one's reading stands for all that fall into it.
_PIECES_A_REST = 2
_PIECES_OF_OTHERS = 8

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
    goes on after the last cycle. `parts`: pieces that each smooth part of a turn is integrated in.
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
        decoded = self._rates(self._durations(timed), turns, ramps)
        return self._within_travel(decoded)._replace(steps=self._steps(steps))

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

    def _rates(self, durations: Array, z_rates: Array, z_ramps: Array) -> Cycle:
        limits = self.limits
        peak, ramp = self.nominal.peak_rates, self.nominal.ramps
        turns, ramped = self._turns, self._ramped
        steep = np.array([_STEEPNESS.get(e.shape, 0.0) for e in self.elements])
        time = jnp.where(np.isin(np.arange(len(self.elements)), ramped), 0.5, 1.0) * durations
        cap = jnp.minimum(limits.max_rate, limits.max_acceleration * time / np.where(steep > 0.0, steep, 1.0))
        low, high = np.array([self.elements[i].band for i in turns]).reshape(-1, 2).T
        share = 0.5 * (low + high) + 0.5 * (high - low) * jnp.tanh(z_rates) if z_rates.shape[0] else None
        free = peak if share is None else peak.at[turns].set(cap[turns] * share)
        peak = jnp.clip(free, -cap, cap)
        least = steep * jnp.abs(peak) / limits.max_acceleration
        if z_ramps.shape[0]:
            room = 0.5 * durations[ramped] - least[ramped]
            ramp = ramp.at[ramped].set(least[ramped] + room * jax.nn.sigmoid(z_ramps))
        else:
            ramp = jnp.clip(ramp, least, 0.5 * durations)
        return Cycle(durations, peak, ramp, self.nominal.steps)

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

    def _within_travel(self, cycle: Cycle) -> Cycle:
        if not self.travels or not len(self._turns):
            return cycle
        angles = jnp.stack([self._angle(cycle, int(i)) for i in self._turns])
        there, back = jnp.sum(jnp.maximum(angles, 0.0)), jnp.sum(jnp.maximum(-angles, 0.0))
        share = lambda a, b: jnp.minimum(1.0, b / jnp.where(a > 0.0, a, 1.0))  # noqa: E731
        factor = jnp.where(angles > 0.0, share(there, back), share(back, there))
        excursion = jnp.max(jnp.abs(jnp.cumsum(angles * factor)))
        factor = factor * jnp.minimum(1.0, self.limits.travel / jnp.where(excursion > 0.0, excursion, 1.0))
        return cycle._replace(peak_rates=cycle.peak_rates.at[self._turns].multiply(factor, unique_indices=True))

    def _angle(self, cycle: Cycle, i: int) -> Array:
        return formulas.turned_angle(self.elements[i].shape, cycle.peak_rates[i], cycle.durations[i], cycle.ramps[i])

    def vector(self, cycle: Cycle) -> Float[np.ndarray, " size"]:
        """Free numbers whose cycle is nearly the given one: bounds can only be approached. Travel is left out."""
        durations, peaks, ramps = (np.asarray(v) for v in cycle[:3])
        spare = np.maximum(durations - np.array([e.least for e in self.elements]), 1e-4)
        turns, ramped = self._turns, self._ramped
        steep = np.array([_STEEPNESS.get(e.shape, 0.0) for e in self.elements])
        time = np.where(np.isin(np.arange(len(durations)), ramped), 0.5, 1.0) * durations
        limits = [float(v) for v in self.limits]
        cap = np.minimum(limits[0], limits[1] * time / np.where(steep > 0.0, steep, 1.0))
        low, high = np.array([self.elements[i].band for i in turns]).reshape(-1, 2).T
        rates = (peaks[turns] / cap[turns] - 0.5 * (low + high)) / (0.5 * (high - low))
        least = (steep * np.abs(peaks) / limits[1])[ramped]
        share = (ramps[ramped] - least) / np.maximum(0.5 * durations[ramped] - least, 1e-12)
        share = np.clip(share, 1e-3, 1.0 - 1e-3)
        steps = np.maximum(
            np.asarray(cycle.steps) / float(self.frame.temperature_end - self.frame.temperature_start), 1e-4
        )
        parts = (
            np.log(spare),
            np.arctanh(np.clip(rates, -1 + 1e-4, 1 - 1e-4)),
            np.log(share / (1.0 - share)),
            np.log(steps),
        )
        return np.concatenate([p for p, size in zip(parts, self._sizes, strict=True) if size])

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
        others = even_division(_PIECES_OF_OTHERS, self.others_read)
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
            return _rest(cycle.durations[i], even_division(_PIECES_A_REST, True), spacing, self.axis)
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
    rest = (of.cycles, of.others_read, of.free, of.travels, of.shared, of.tail, of.parts, of.axis)
    return Coordinates(elements, of.limits, of.frame, of.nominal, *rest)


def even_division(count: int, read: bool) -> Division:
    """A part of a move in `count` equal pieces, all ending with a reading, or none."""
    return Division(tuple(float(k) / count for k in range(count + 1)), (read,) * count)


def _rest(duration: Array, division: Division, spacing: Array, axis: str) -> Move:
    zero = jnp.zeros(())
    return Move(
        zero, duration, zero, jnp.zeros(0), zero, "rest", axis, 1, (division,), division, spacing=spacing
    )  # fmt: skip
