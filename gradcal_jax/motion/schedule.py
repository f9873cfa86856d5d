"""A plan as arrays: moves and their times, their pieces, the chamber's programme.

The discrete part of a plan (which pieces there are, which are read) is in index arrays. They are *arguments* of every
computation like its times and rates, so that a compiled program serves every plan of its sizes.

Symbols: `M` moves, `P` pieces, `F` fillers (standing that fills what the moves of a stretch leave of it).
"""

from dataclasses import replace
from itertools import pairwise
from typing import Literal

import equinox as eqx
import jax
import numpy as np
from jaxtyping import Bool, Float, Int

from gradcal_jax import formulas
from gradcal_jax.arrays import AnyArray, PytreeModule, namespace, put, running_sum, taken
from gradcal_jax.formulas import reading_times, repetitions
from gradcal_jax.motion.motion import Move, PieceTable, divide, joined, standing
from gradcal_jax.motion.programme import Programme
from gradcal_jax.motion.trajectory import Trajectory

Points = Literal["one run", "independent"]

_NO_KNOT = -1
# Times this close to a knot are at the knot; s.
_AT_KNOT = 1e-6


class Pieces(PytreeModule):
    """Pieces `(P,)`, `of` their moves.

    `move`: index of the move with its times and rates; `segment` numbers the executed moves. `gap`: its data are not
    used, and a new origin is read at its end. A piece is the part of its move's piece from the knot `low` of the
    programme to the knot `high` (−1: no knot), so that the temperature within is smooth.
    """

    of: PieceTable
    move: Int[AnyArray, " P"]
    gap: Bool[AnyArray, " P"]
    segment: Int[AnyArray, " P"]
    low: Int[AnyArray, " P"]
    high: Int[AnyArray, " P"]


class Schedule(PytreeModule):
    """A plan of one channel. `duration` s, `peak_rate` rad/s, `ramp` s of each move; `fill_move` last for the
    time between the knots `fill_from` and `fill_to` of the programme less that of all moves, `fill_counts` times each.

    `varying_pieces`: the numbers of those whose rate is not constant. `cut`: whether knots of the programme may divide
    pieces. The first piece begins at the knot `first_knot`. `rates`: the reference is a held rate
    at set points (standard method) instead of an angle; `points`: whether the set points share the run's noise or are
    independent.
    """

    duration: Float[AnyArray, " M"]
    peak_rate: Float[AnyArray, " M"]
    ramp: Float[AnyArray, " M"]
    programme: Programme
    pieces: Pieces
    varying_pieces: Int[AnyArray, " V"]
    fill_move: Int[AnyArray, " F"]
    fill_from: Int[AnyArray, " F"]
    fill_to: Int[AnyArray, " F"]
    fill_counts: Float[AnyArray, "F M"]
    first_knot: Int[AnyArray, ""]
    cut: bool = eqx.field(static=True, default=False)
    rates: bool = eqx.field(static=True, default=False)
    points: Points = eqx.field(static=True, default="one run")

    @property
    def piece_count(self) -> int:
        return self.pieces.move.shape[0]

    def durations(self) -> Float[AnyArray, " M"]:
        """Durations of all moves (s), fillers included."""
        times = self.programme.times()
        left = times[self.fill_to] - times[self.fill_from] - self.fill_counts @ self.duration
        return put(self.duration, self.fill_move, left) if self.fill_move.shape[0] else self.duration

    def trajectory(self, thermal_lag: Float[AnyArray, ""] | float | None = None) -> Trajectory:
        """The plan's trajectory; `thermal_lag` s, of the sensor behind the chamber."""
        p, of = self.pieces, self.pieces.of
        durations = self.durations()
        xp = namespace(durations, self.peak_rate, p, self.programme, thermal_lag)
        whole = (of.u_end - of.u_start) * (
            of.by_duration * taken(durations, p.move) + of.by_ramp * taken(self.ramp, p.move)
        )
        sensor = self.programme.sensor(thermal_lag)
        # The whole time of a divided piece counts once, at the end of its last part.
        last = p.high < 0
        counted = running_sum(xp.where(last, whole, 0.0))
        begins = sensor.times[self.first_knot] + xp.concatenate([xp.zeros(1), counted[:-1]])

        def fraction(knot):
            # A piece of 1e-100 s counts as none: the inverse of its square, in a slope, would overflow.
            return (sensor.times[xp.maximum(knot, 0)] - begins) / xp.where(whole > 1e-100, whole, 1.0)

        duration, start, u_start, u_end = whole, begins, of.u_start, of.u_end
        if self.cut:
            v0 = xp.where(p.low < 0, 0.0, fraction(p.low))
            v1 = xp.where(last, 1.0, fraction(p.high))
            duration, start = whole * (v1 - v0), begins + whole * v0
            width = of.u_end - of.u_start
            u_start, u_end = of.u_start + width * v0, of.u_start + width * v1
        # The middle of a piece defines its stretch: at its start rounding would decide.
        middle = start + 0.5 * duration
        within = xp.clip(xp.searchsorted(sensor.times, middle, side="right") - 1, 0, sensor.slope.shape[0] - 1)
        since = start - sensor.times[within]
        return Trajectory(
            start=start,
            duration=duration,
            u_start=u_start,
            u_end=u_end,
            terms=of.terms * taken(self.peak_rate, p.move)[:, None],
            share=xp.ones(duration.shape),
            level=sensor.level[within] + sensor.slope[within] * since,
            slope=sensor.slope[within],
            excess=sensor.excess[within] * (1.0 if thermal_lag is None else xp.exp(-sensor.lag_rate * since)),
            lag_rate=sensor.lag_rate,
            read=of.read & last,
            at_rest=of.at_rest & (last | ~of.moving),
            moving=of.moving,
            gap=p.gap,
            segment=p.segment,
            varying_pieces=self.varying_pieces,
            rates=self.rates,
            points=self.points,
            lagged=thermal_lag is not None,
        )


def make_schedule(
    programme: Programme,
    moves: list[tuple[float, float, float]],
    placed: list[tuple[int, PieceTable]],
    *,
    first_knot: int,
    gaps: tuple[int, ...] = (),
    fillers: list[tuple[int, int, int, np.ndarray]] | None = None,
    inner_knots: tuple[int, ...] = (),
    rates: bool = False,
    points: Points = "one run",
) -> Schedule:
    """A schedule from `moves` (duration, peak rate, ramp) in the order in which they are `placed` (move, pieces).

    `gaps`: placements whose data are not used. `fillers`: (move, from knot, to knot, counts). `inner_knots`: those of
    the programme at which the chamber may change its slope within a piece.
    """
    table = joined([pieces for _, pieces in placed])
    sizes = [len(pieces.read) for _, pieces in placed]
    segment = np.repeat(np.arange(len(placed)), sizes)
    count = len(segment)
    whole = np.full(count, _NO_KNOT)
    move = np.repeat(np.array([move for move, _ in placed]), sizes)
    pieces = Pieces(table, move, np.isin(segment, np.array(gaps, int)), segment, whole, whole)
    duration, peak, ramp = (np.array(column, dtype=float) for column in zip(*moves, strict=True))
    fillers = fillers or []
    fill_move, fill_from, fill_to = (np.array([f[i] for f in fillers], int) for i in range(3))
    counts = np.array([f[3] for f in fillers], float).reshape(len(fillers), len(moves))
    schedule = Schedule(
        duration, peak, ramp, programme, pieces, np.flatnonzero(pieces.of.varying),
        fill_move, fill_from, fill_to, counts, np.asarray(first_knot), bool(inner_knots), rates, points,
    )  # fmt: skip
    return _cut_at_knots(schedule, inner_knots) if inner_knots else schedule


def _cut_at_knots(schedule: Schedule, knots: tuple[int, ...]) -> Schedule:
    """Divide pieces at the instants at which the chamber changes its slope, so that every piece is smooth."""
    line, times = schedule.trajectory(), schedule.programme.times()
    begin, end = line.start, line.start + line.duration
    at = times[list(knots)]
    divided, k = np.nonzero((begin[:, None] < at - _AT_KNOT) & (end[:, None] > at + _AT_KNOT))
    # A piece begins at its own begin, or at one of the knots within it.
    number = np.concatenate([np.arange(len(begin)), divided])
    low = np.concatenate([np.full(len(begin), _NO_KNOT), np.array(knots)[k]])
    order = np.lexsort((low, number))
    number, low = number[order], low[order]
    high = np.where(np.diff(number, append=-1) == 0, np.append(low[1:], _NO_KNOT), _NO_KNOT)
    pieces = replace(jax.tree.map(lambda of: of[number], schedule.pieces), low=low, high=high)
    return replace(schedule, pieces=pieces, varying_pieces=np.flatnonzero(pieces.of.varying))


def gradient_plan(
    programme: Programme,
    moves: tuple[Move, ...] = (),
    after: tuple[Move, ...] = (),
    *,
    used: tuple[tuple[int, int], ...] | None = None,
    read_every: float | None = 1.0,
    divided: bool = True,
) -> Schedule:
    """Repeat the `moves`, each time with the moves `after` of other axes, as often as they fit into the used parts of a
    programme.

    `used`: (first, last) of the programme's stretches, last not included; None: all.
    `read_every` s: spacing of the readings while the axis stands in the remaining time; None: one at its end.
    `divided`: pieces end where the chamber's slope changes. Errors: `ValueError` when the moves fit nowhere.
    """
    times = programme.times()
    own = sum(m.duration for m in moves)
    period = own + sum(m.duration for m in after)
    spans = used or ((0, len(times) - 1),)
    cycle = (*moves, *after)
    tables = [m.pieces for m in cycle]
    numbers = [(m.duration, m.peak_rate, m.ramp) for m in cycle]
    placed: list[tuple[int, PieceTable]] = []
    fillers: list[tuple[int, int, int, np.ndarray]] = []
    gaps: list[int] = []

    def fill(begin: int, end: int, counts: np.ndarray, pieces: PieceTable) -> None:
        move = len(numbers)
        numbers.append((0.0, 0.0, 0.0))
        fillers.append((move, begin, end, counts))
        placed.append((move, pieces))

    fits = False
    for k, (first, last) in enumerate(spans):
        if k:
            gaps.append(len(placed))
            fill(spans[k - 1][1], first, np.zeros(len(cycle)), standing(((0.0, 1.0), (False,))))
        available = float(times[last] - times[first])
        cycles, left = repetitions(available, own, period) if moves else (0, available)
        fits |= cycles > 0
        for n in range(cycles):
            placed += [(i, tables[i]) for i in range(len(moves) if n == cycles - 1 else len(cycle))]
        if left > _AT_KNOT:
            counts = np.repeat([cycles, max(cycles - 1, 0)], [len(moves), len(after)]).astype(float)
            times_read = (left,) if read_every is None else tuple(reading_times(left, read_every))
            fill(first, last, counts, standing(divide(left, times_read)))
    if moves and not fits:
        raise ValueError(
            f"the moves take {own:.6g} s, longer than every used part of the temperature programme: shorten the moves"
        )
    parts = [*spans, *((a[1], b[0]) for a, b in pairwise(spans))] if divided else []
    inner = [j for first, last in parts for j in range(first + 1, last)]
    fillers = [(m, a, b, np.pad(c, (0, len(numbers) - len(c)))) for m, a, b, c in fillers]
    return make_schedule(
        programme, numbers, placed, first_knot=spans[0][0], gaps=tuple(gaps), fillers=fillers, inner_knots=tuple(inner)
    )


_HELD = PieceTable(
    np.ones(1), np.zeros(1), np.zeros(1), np.ones(1), np.array([formulas.CONSTANT]), np.ones(1, bool),
    np.zeros(1, bool), np.ones(1, bool), np.zeros(1, bool),
)  # fmt: skip


def standard_plan(
    temperatures, soak: float, integration: float, rates=(0.0,), *, points: Points = "one run"
) -> Schedule:
    """At each of `temperatures` (°C) a `soak` (s), then each of `rates` (rad/s; 0: standing) for `integration` s.

    The reference is a *rate* with one error for each point, so that dividing a point into several readings gains
    nothing. `points`: "one run", in which drifts, clock and turn-on bias continue from point to point, or
    "independent", each with noise of its own (as in the paper). Errors: `ValueError` for values that are no numbers.
    """
    temperatures, rates = (np.asarray(v, dtype=float) for v in (temperatures, rates))
    counts = len(temperatures), len(rates)
    stay = float(soak) + counts[1] * float(integration)
    level, jumps = np.zeros(counts[0]), np.diff(temperatures, prepend=temperatures[0])
    programme = Programme(np.asarray(temperatures[0]), np.full(counts[0], stay), level, jumps)
    soaking = (0, standing(((0.0, 1.0), (False,))))
    placed = [p for _ in temperatures for p in (soaking, *((1 + k, _HELD) for k in range(counts[1])))]
    numbers = [(float(soak), 0.0, 0.0), *((float(integration), float(rate), 0.0) for rate in rates)]
    gaps = tuple(range(0, len(placed), 1 + counts[1]))
    return make_schedule(programme, numbers, placed, first_knot=0, gaps=gaps, rates=True, points=points)
