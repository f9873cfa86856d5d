"""The plans of the paper, static and dynamic: gradient (`GradientPlan`) and standard (`StandardPlan`).

A plan is data; `timeline(channel)` writes it out, differentiably in every duration, rate and slope.
"""

from itertools import pairwise
from typing import NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from gradcal_jax.formulas import reading_times, repetitions
from gradcal_jax.plans.motion import Division, Move, Pieces, divide, join, repeat, standing
from gradcal_jax.plans.programme import Programme
from gradcal_jax.plans.timeline import IndexArray, Timeline, points_timeline


class Stretch(NamedTuple):
    """Neighbouring stretches `first … last − 1` of the programme whose data are used; part of a plan's structure.

    The cycle is made `cycles` times, the last time its moves alone; then the axis stands, divided as `tail` says.
    """

    first: int
    last: int
    cycles: int
    tail: Division | None


class GradientPlan(eqx.Module):
    """The chamber follows `programme`; in each used stretch `moves`, then `after`, repeat.

    `moves` are the axes' own; `after` are rests that complete the cycle (the time that axes outside this plan take).
    `cuts`: for each channel the (piece, programme stretch) where the chamber changes its slope inside a piece.
    `tail_spacing`: true spacing of the readings after the last cycle, where they are relaxed (`motion.standing`).
    """

    programme: Programme
    moves: tuple[Move, ...]
    after: tuple[Move, ...]
    stretches: tuple[Stretch, ...] = eqx.field(static=True)
    cuts: tuple[tuple[str, tuple[tuple[int, int], ...]], ...] = eqx.field(static=True, default=())
    tail_spacing: Float[Array | np.ndarray, ""] | None = None

    @property
    def channels(self) -> tuple[str, ...]:
        """Axes that move, in the order of the moves; `("x",)` for a plan that stands."""
        return tuple(dict.fromkeys(m.axis for m in self.moves if m.shape != "rest")) or ("x",)

    def timeline(self, channel: str = "x", thermal_lag: Float[Array, ""] | float | None = None) -> Timeline:
        """The plan as the sensor on `channel` sees it; `thermal_lag` s, of the sensor behind the chamber."""
        pieces, segment, segment_moves = self._pieces(channel)
        times = self.programme.knots()[0]
        begin = times[self.stretches[0].first]
        start = begin + jnp.concatenate([jnp.zeros(1), jnp.cumsum(pieces.duration)[:-1]])
        cuts = dict(self.cuts).get(channel, ())
        if cuts:
            pieces, start, segment = _cut(pieces, start, segment, cuts, times)
        trail = self.programme.trail(thermal_lag)
        # The middle says which stretch a piece belongs to: at its start, rounding would.
        middle = jax.lax.stop_gradient(start + 0.5 * pieces.duration)
        within = jnp.clip(jnp.searchsorted(trail.times, middle, side="right") - 1, 0, trail.slope.shape[0] - 1)
        since = start - trail.times[within]
        count = len(pieces.read)
        return Timeline(
            start=start,
            duration=pieces.duration,
            u_start=pieces.u_start,
            u_end=pieces.u_end,
            terms=pieces.terms,
            share=pieces.share,
            trail=trail.trail[within] + trail.slope[within] * since,
            slope=trail.slope[within],
            excess=trail.excess[within] * jnp.exp(-trail.lag_rate * since),
            lag_rate=trail.lag_rate,
            read=jnp.asarray(pieces.read),
            at_rest=jnp.asarray(pieces.at_rest),
            moving=jnp.asarray(pieces.moving),
            reset=jnp.zeros(count, bool),
            segment=jnp.asarray(segment),
            moving_pieces=IndexArray(np.flatnonzero(pieces.moving)),
            varying_pieces=IndexArray(np.flatnonzero(pieces.varying)),
            gap_pieces=IndexArray(np.flatnonzero(pieces.gap)),
            segment_moves=segment_moves,
            axis=channel,
            lagged=thermal_lag is not None,
        )

    def _pieces(self, channel: str) -> tuple[Pieces, np.ndarray, tuple[int, ...]]:
        """All pieces, the segment of each, and each segment's move: an index into `moves + after`, −1 for standing."""
        times = self.programme.knots()[0]
        own, rests = ([m.pieces(channel) for m in moves] for moves in (self.moves, self.after))
        own_time, rest_time = (sum((m.duration for m in ms), start=jnp.zeros(())) for ms in (self.moves, self.after))
        sizes = [len(p.read) for p in own + rests]
        blocks: list[Pieces] = []
        counts: list[int] = []
        of_segment: list[int] = []
        for k, stretch in enumerate(self.stretches):
            begin, end = times[stretch.first], times[stretch.last]
            if k:
                gap = standing(begin - times[self.stretches[k - 1].last], Division((0.0, 1.0), (False,)), gap=True)
                blocks.append(gap)
                counts.append(1)
                of_segment.append(-1)
            whole = max(stretch.cycles - 1, 0)
            if whole:
                blocks.append(repeat(join(own + rests), whole))
                counts += sizes * whole
                of_segment += list(range(len(sizes))) * whole
            if stretch.cycles:
                blocks += own
                counts += sizes[: len(own)]
                of_segment += list(range(len(own)))
            if stretch.tail is not None:
                used = whole * (own_time + rest_time) + (own_time if stretch.cycles else 0.0)
                blocks.append(standing(end - begin - used, stretch.tail, spacing=self.tail_spacing))
                counts.append(len(stretch.tail.read))
                of_segment.append(-1)
        return join(blocks), np.repeat(np.arange(len(counts)), counts), tuple(of_segment)


def _cut(pieces: Pieces, start: Array, segment: np.ndarray, cuts, knot_times: Array):
    """Divide pieces at the instants where the chamber changes its slope, so that every piece is smooth."""
    inside: dict[int, list[int]] = {}
    for piece, knot in cuts:
        inside.setdefault(piece, []).append(knot)
    begin, end = -1, -2
    bounds = [
        (k, low, high)
        for k in range(len(pieces.read))
        for low, high in zip([begin, *inside.get(k, [])], [*inside.get(k, []), end], strict=True)
    ]
    source, low, high = (np.array(column) for column in zip(*bounds, strict=True))
    share = lambda knot: (knot_times[np.maximum(knot, 0)] - start[source]) / pieces.duration[source]  # noqa: E731
    v0 = jnp.where(low == begin, 0.0, share(low))
    v1 = jnp.where(high == end, 1.0, share(high))
    u0, width = pieces.u_start[source], (pieces.u_end - pieces.u_start)[source]
    last, moving = high == end, pieces.moving[source]
    cut = Pieces(
        pieces.duration[source] * (v1 - v0),
        u0 + width * v0,
        u0 + width * v1,
        pieces.terms[source],
        pieces.share[source],
        pieces.read[source] & last,
        pieces.at_rest[source] & (last | ~moving),
        moving,
        pieces.varying[source],
        pieces.gap[source],
    )
    return cut, start[source] + pieces.duration[source] * v0, segment[source]


def gradient_plan(
    programme: Programme,
    moves: tuple[Move, ...] = (),
    after: tuple[Move, ...] = (),
    *,
    used: tuple[tuple[int, int], ...] | None = None,
    read_every: float | None = 1.0,
) -> GradientPlan:
    """Fit the `moves` (and `after` them those of other axes) into the used parts of a programme, as often as they go.

    `used`: (first, last) of the programme's stretches, last not included; None: all. `read_every` s: spacing of the
    readings while the axis stands for what the cycles leave; None: unread. Errors: `ValueError` when the moves fit
    nowhere.
    """
    times = np.concatenate([[0.0], np.cumsum(np.asarray(programme.durations))])
    own = sum(float(m.duration) for m in moves)
    period = own + sum(float(m.duration) for m in after)
    stretches = []
    for first, last in used or ((0, len(times) - 1),):
        available = float(times[last] - times[first])
        cycles, left = repetitions(available, own, period) if moves else (0, available)
        tail = divide(left, reading_times(left, read_every)) if left > 1e-6 else None
        stretches.append(Stretch(first, last, cycles, tail))
    if moves and not any(s.cycles for s in stretches):
        raise ValueError(
            f"the moves take {own:.6g} s and fit into no used part of the temperature programme: shorten them"
        )
    plan = GradientPlan(programme, tuple(moves), tuple(after), tuple(stretches))
    inner = [j for s in stretches for j in range(s.first + 1, s.last)]
    inner += [j for a, b in pairwise(stretches) for j in range(a.last + 1, b.first)]
    cuts = []
    for channel in plan.channels if inner else ():
        end = times[plan.stretches[0].first] + np.cumsum(np.asarray(plan._pieces(channel)[0].duration))
        begin = np.concatenate([times[[plan.stretches[0].first]], end[:-1]])
        found = [
            (int(k), j) for j in inner for k in np.flatnonzero((begin < times[j] - 1e-6) & (end > times[j] + 1e-6))
        ]
        if found:
            cuts.append((channel, tuple(sorted(found))))
    return GradientPlan(programme, plan.moves, plan.after, plan.stretches, tuple(cuts))


class StandardPlan(eqx.Module):
    """Stable temperatures (°C), each after a soak (s), with rates (rad/s; 0: standing) for `integration` s each.

    Every point is an independent stretch with a noise state of its own and a reference *rate* whose error is common
    to the point, so splitting a point into several readings would buy nothing.
    """

    temperatures: Float[Array | np.ndarray, " t"]
    rates: Float[Array | np.ndarray, " r"]
    soak: Float[Array | np.ndarray, ""]
    integration: Float[Array | np.ndarray, ""]

    @property
    def channels(self) -> tuple[str, ...]:
        return ("x",)

    def timeline(self, channel: str = "x", thermal_lag: Float[Array, ""] | float | None = None) -> Timeline:
        """One piece a point. With a thermal lag, each temperature's step decays through its soak and points."""
        n_t, n_r = self.temperatures.shape[0], self.rates.shape[0]
        stay = self.soak + n_r * self.integration
        into = jnp.tile(self.soak + self.integration * jnp.arange(n_r, dtype=float), n_t)
        start = jnp.repeat(stay * jnp.arange(n_t, dtype=float), n_r) + into
        lag_rate = excess = None
        if thermal_lag is not None:
            lag_rate = 1.0 / jnp.asarray(thermal_lag, dtype=start.dtype)
            sensor, left = self.temperatures[0], []
            for k in range(n_t):
                left.append(sensor - self.temperatures[k])
                sensor = self.temperatures[k] + left[k] * jnp.exp(-lag_rate * stay)
            excess = jnp.repeat(jnp.stack(left), n_r) * jnp.exp(-lag_rate * into)
        return points_timeline(
            start,
            jnp.ones(n_t * n_r) * self.integration,
            jnp.tile(self.rates, n_t),
            jnp.repeat(self.temperatures, n_r),
            axis=channel,
            excess=excess,
            lag_rate=lag_rate,
        )


def standard_plan(temperatures, soak: float, integration: float, rates=(0.0,)) -> StandardPlan:
    """A standard plan: at each of `temperatures` (°C) a `soak` (s), then each of `rates` (rad/s) for `integration` (s).

    Errors: `ValueError` for what is no number.
    """
    as_array = lambda v: np.asarray(v, dtype=float)  # noqa: E731
    return StandardPlan(as_array(temperatures), as_array(rates), as_array(soak), as_array(integration))


Plan = GradientPlan | StandardPlan
