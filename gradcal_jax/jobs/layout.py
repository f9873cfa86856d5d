"""Plans of one kind in one layout, so that a single compiled program serves thousands of them.

What a sweep changes (a gradient, a rest) changes how many cycles and how many readings a plan has, and with that the
shapes of its arrays. A `Layout` has room for all plans of a group: each part of each move as many pieces as any of them
needs, and as many cycles. What a plan does not need it fills with pieces that last no time and are not read. They add
nothing to any integral and nothing to any noise, so a plan's numbers do not depend on the room around it, but for
rounding. The cost is the room: about a tenth of the time where numbers of cycles are rounded up to 1, 2, 3, 4, 6, 8,
12, 16 and so on, of which every step is compiled once.

All of this is NumPy on the few hundred pieces of *one* cycle; the compiled program repeats it.
"""

from functools import lru_cache
from itertools import pairwise
from typing import NamedTuple

import numpy as np

from gradcal_jax import formulas
from gradcal_jax.assemble.build import move_of, shortest_correlation_time
from gradcal_jax.files import Spec
from gradcal_jax.files.moves import ResolvedMove
from gradcal_jax.files.schedule import GradientSchedule
from gradcal_jax.jobs.room import Counts, Kind, Layout
from gradcal_jax.plans.motion import divide

_TERMS = len(formulas.MOTION_TERMS)
_CORRELATION_TIMES_A_PIECE = 3.0


class Part(NamedTuple):
    """A smooth part of a move, in its pieces `(k,)`: durations (s), fractions, motion terms `(10,)`, readings.

    `kind`: "rest", "held" (constant rate) or "varying"; `stops`: the axis stands at the part's end.
    """

    kind: str
    duration: np.ndarray
    u_start: np.ndarray
    u_end: np.ndarray
    terms: np.ndarray
    read: np.ndarray
    stops: bool


class Plan(NamedTuple):
    """A plan as numbers, not yet in a layout. `made`: whether the cycle is made at all in a stretch."""

    kind: Kind
    counts: Counts
    own: tuple[Part, ...]
    after: tuple[Part, ...]
    tails: tuple[Part, ...]
    made: tuple[bool, ...]
    start: float
    durations: np.ndarray
    slopes: np.ndarray
    lag: float


def plans_of(spec: Spec) -> tuple[Plan, ...] | None:
    """The plan of a spec for each of its channels; None where it has no layout and is computed in its own shape.

    That is a standard plan, and one whose chamber changes its slope inside a stretch of used data.
    """
    schedule = spec.schedule
    if not isinstance(schedule, GradientSchedule):
        return None
    ends = np.array([segment.start for segment in schedule.segments] + [schedule.duration])
    nearest = lambda time: int(np.argmin(np.abs(ends - time)))  # noqa: E731
    stretches = tuple((nearest(s.start), nearest(s.start + s.duration)) for s in schedule.stretches)
    bounds = [(0, *stretches[0]), *((a[1], *b) for a, b in pairwise(stretches))]
    if any(last - first > 1 for _, first, last in bounds) or any(first - end > 1 for end, first, _ in bounds[1:]):
        return None
    cycle = schedule.cycle
    if cycle is None:
        every = schedule.read_every
        channels, moves = ("x",), ()
    else:
        every = cycle.other_read_every
        moves = tuple(move for move in cycle.moves for _ in range(move.repeat))
        channels = tuple(dict.fromkeys(m.axis for m in moves if not m.is_rest)) or ("x",)
    longest = _CORRELATION_TIMES_A_PIECE * shortest_correlation_time(spec.sensor)
    lag = spec.sensor.thermal_lag
    found: list[Plan] = []
    for channel in channels:
        own = tuple((i, part) for i, m in enumerate(moves) for part in parts_of(m, channel, every, longest))
        after: list[tuple[int, Part]] = []
        if cycle is not None and cycle.other > 0.0:
            after.append((0, rest(cycle.other, every)))
        if cycle is not None and cycle.idle > 0.0:
            after.append((1, rest(cycle.idle, None)))
        tails = tuple(rest(s.leftover, every) if s.leftover > 1e-6 else _nothing() for s in schedule.stretches)
        kind = Kind(
            channel,
            tuple((i, part.kind) for i, part in own),
            tuple((i, part.kind) for i, part in after),
            stretches,
            len(schedule.segments),
            lag is not None,
        )
        counts = Counts(
            tuple(len(part.read) for _, part in own),
            tuple(len(part.read) for _, part in after),
            tuple(max(s.cycles - 1, 0) for s in schedule.stretches),
            tuple(len(tail.read) for tail in tails),
        )
        found.append(
            Plan(
                kind,
                counts,
                tuple(part for _, part in own),
                tuple(part for _, part in after),
                tails,
                tuple(s.cycles > 0 for s in schedule.stretches),
                schedule.segments[0].temperature_start,
                np.array([segment.duration for segment in schedule.segments]),
                np.array([segment.slope for segment in schedule.segments]),
                0.0 if lag is None else float(lag),
            )
        )
    return tuple(found)


@lru_cache(maxsize=4096)
def parts_of(move: ResolvedMove, channel: str, others_read_every: float | None, longest: float) -> tuple[Part, ...]:
    """A move as the channel sees it: `plans.Move.pieces` in NumPy, which is a hundred times quicker one by one."""
    if move.is_rest:
        return (rest(move.duration, move.read_every, move.read_end),)
    if channel != move.axis:
        return (rest(move.duration, others_read_every),)
    divided = move_of(move, others_read_every, longest).divisions
    lasting = {"ramp": move.ramp, "flat": move.duration - 2.0 * move.ramp}
    shapes = formulas.shape_pieces(move.shape, cycles=move.cycles, controls=move.controls, unevenness=move.unevenness)
    parts: list[Part] = []
    for i, ((what, share, coefficients), (edges, read)) in enumerate(zip(shapes, divided, strict=True)):
        at = np.asarray(edges, dtype=float)
        parts.append(
            Part(
                "held" if what == "flat" else "varying",
                np.diff(at) * lasting.get(what, share * move.duration),
                at[:-1],
                at[1:],
                np.asarray(coefficients) * move.peak_rate,
                np.array(read),
                i == len(shapes) - 1,
            )
        )
    return tuple(parts)


@lru_cache(maxsize=4096)
def rest(duration: float, read_every: float | None, read_at_end: bool = False) -> Part:
    """Standing still, read every so often, at its end alone, or not."""
    times = formulas.reading_times(duration, read_every) or ([duration] if read_at_end else [])
    edges, read = divide(duration, times)
    count = len(read)
    return Part(
        "rest", np.diff(np.asarray(edges, dtype=float)) * duration, np.zeros(count), np.ones(count), np.zeros(_TERMS),
        np.array(read), True,
    )  # fmt: skip


def _nothing() -> Part:
    return Part("rest", np.zeros(0), np.zeros(0), np.zeros(0), np.zeros(_TERMS), np.zeros(0, bool), True)


def filled(plan: Plan, layout: Layout) -> dict[str, np.ndarray]:
    """A plan's numbers in a layout: arrays whose shapes the layout alone decides."""
    room = layout.room
    arrays = {
        "start": np.asarray(plan.start),
        "durations": plan.durations,
        "slopes": plan.slopes,
        "lag": np.asarray(plan.lag),
        "whole": np.array(plan.counts.whole),
        "made": np.array(plan.made),
    }
    for name, parts, counts in (("own", plan.own, room.own), ("after", plan.after, room.after)):
        arrays |= {f"{name} {field}": values for field, values in _block(parts, counts).items()}
    for k, (tail, count) in enumerate(zip(plan.tails, room.tail, strict=True)):
        arrays |= {f"tail {k} {field}": values for field, values in _block((tail,), (count,)).items()}
    return arrays


def _block(parts: tuple[Part, ...], counts: tuple[int, ...]) -> dict[str, np.ndarray]:
    total = sum(counts)
    duration, u_start, u_end = np.zeros(total), np.zeros(total), np.zeros(total)
    terms = np.zeros((total, _TERMS))
    read, at_rest, moving = np.zeros(total, bool), np.ones(total, bool), np.zeros(total, bool)
    begin = 0
    for part, room in zip(parts, counts, strict=True):
        here = slice(begin, begin + len(part.read))
        duration[here], u_start[here], u_end[here], terms[here] = part.duration, part.u_start, part.u_end, part.terms
        read[here] = part.read
        if part.kind != "rest":
            moving[here], at_rest[here] = True, False
            if part.stops and len(part.read):
                at_rest[here.stop - 1] = True
        begin += room
    return {
        "duration": duration, "u_start": u_start, "u_end": u_end, "terms": terms, "read": read, "at_rest": at_rest,
        "moving": moving,
    }  # fmt: skip
