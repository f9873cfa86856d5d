"""The plans of the paper, static and dynamic: gradient (`GradientPlan`) and standard (`StandardPlan`).

A plan is data; `timeline(channel)` writes it out, differentiably in every duration, rate and slope.
"""

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from gradcal_jax.formulas import CONSTANT
from gradcal_jax.plans.motion import Move, Pieces, join, readings_in, rest_pieces
from gradcal_jax.plans.programme import Programme
from gradcal_jax.plans.timeline import IndexArray, Timeline


class Schedule(eqx.Module):
    """How the moves fill the time: part of the structure, worked out once from plain numbers.

    `lead_readings`: readings of the standing axis in the used soak, before the motion; `whole_cycles`; `begun`: how many moves
    of one more, cut cycle still fit; `rest_of_time`: what the axis does then, the index of the rest that is cut or −1, and
    `tail_readings` its readings. `cuts`: (piece, stretch) where the programme changes slope inside a piece.
    """

    lead_readings: int = eqx.field(static=True)
    whole_cycles: int = eqx.field(static=True)
    begun: int = eqx.field(static=True)
    rest_of_time: int = eqx.field(static=True)
    tail_readings: int = eqx.field(static=True)


class GradientPlan(eqx.Module):
    """The chamber follows `programme`; from its stretch `first_stretch` on, `moves` repeat until it ends.

    `soak_used`: whether the readings of the standing axis before the motion count. The last cycle is cut: moves that no
    longer fit are not begun, and the axis stands for the rest of the time. A plan without moves stands all the time.
    """

    programme: Programme
    moves: tuple[Move, ...]
    schedule: Schedule
    first_stretch: int = eqx.field(static=True)
    soak_used: bool = eqx.field(static=True)
    cuts: dict[str, tuple[tuple[int, int], ...]] = eqx.field(static=True)

    @property
    def channels(self) -> tuple[str, ...]:
        """Axes that move, in the order of the moves; `("x",)` for a plan that stands."""
        return tuple(dict.fromkeys(m.axis for m in self.moves if m.shape != "rest")) or ("x",)

    @property
    def total_time(self) -> Float[Array, ""]:
        return self.programme.total

    @property
    def soak_time(self) -> Float[Array, ""]:
        return jnp.sum(self.programme.durations[: self.first_stretch])

    @property
    def period(self) -> Float[Array, ""]:
        return sum((m.duration for m in self.moves), start=jnp.zeros(()))

    def timeline(self, channel: str = "x", thermal_lag: Float[Array, ""] | float | None = None) -> Timeline:
        """The plan as the sensor on `channel` sees it."""
        pieces, segment, segment_moves = self._pieces(channel)
        begin = jnp.zeros(()) if self.soak_used else self.soak_time
        start = begin + jnp.concatenate([jnp.zeros(1), jnp.cumsum(pieces.duration)[:-1]])
        cuts = self.cuts.get(channel, ())
        if cuts:
            pieces, start, segment = _cut(pieces, start, segment, cuts, self.programme.knots()[0])
        trail = self.programme.trail(thermal_lag)
        middle = jax.lax.stop_gradient(start + 0.5 * pieces.duration)
        stretch = jnp.clip(jnp.searchsorted(trail.times, middle, side="right") - 1, 0, trail.slope.shape[0] - 1)
        since = start - trail.times[:-1][stretch]
        slope = trail.slope[stretch]
        return Timeline(
            start=start,
            duration=pieces.duration,
            u_start=pieces.u_start,
            u_end=pieces.u_end,
            terms=pieces.terms,
            trail=trail.trail[stretch] + slope * since,
            slope=slope,
            excess=trail.excess[stretch] * jnp.exp(-trail.lag_rate * since),
            lag_rate=trail.lag_rate,
            read=jnp.asarray(pieces.read),
            at_rest=jnp.asarray(pieces.at_rest),
            moving=jnp.asarray(pieces.moving),
            reset=jnp.zeros(len(pieces.read), bool),
            segment=jnp.asarray(segment),
            moving_pieces=IndexArray(np.flatnonzero(pieces.moving)),
            varying_pieces=IndexArray(np.flatnonzero(pieces.varying)),
            segment_moves=segment_moves,
            axis=channel,
        )

    def _pieces(self, channel: str) -> tuple[Pieces, np.ndarray, tuple[int, ...]]:
        """Lead, whole cycles (written once and tiled), the cut cycle and the tail; with the segment of each piece."""
        s = self.schedule
        of_moves = [m.pieces(channel) for m in self.moves]
        blocks: list[tuple[Pieces, int]] = []
        if self.soak_used and self.first_stretch:
            blocks.append((rest_pieces(self.soak_time, s.lead_readings), -1))
        if s.whole_cycles and of_moves:
            cycle = join(of_moves)
            sizes = [len(p.read) for p in of_moves]
            repeated = Pieces(
                *(jnp.tile(f, (s.whole_cycles,) + (1,) * (f.ndim - 1)) for f in cycle[:4]),
                *(np.tile(f, s.whole_cycles) for f in cycle[4:]),
            )
        else:
            repeated, sizes = None, []
        tail_blocks = [(of_moves[i], i) for i in range(s.begun)]
        used = s.whole_cycles * self.period + sum((m.duration for m in self.moves[: s.begun]), start=jnp.zeros(()))
        left = self.total_time - self.soak_time - used
        if s.rest_of_time >= -1:
            tail_blocks.append((rest_pieces(left, s.tail_readings), s.rest_of_time))
        joined = join([b for b, _ in blocks] + ([repeated] if repeated is not None else []) + [b for b, _ in tail_blocks])
        segment_moves = [i for _, i in blocks] + list(range(len(self.moves))) * s.whole_cycles + [i for _, i in tail_blocks]
        counts = [len(b.read) for b, _ in blocks] + sizes * s.whole_cycles + [len(b.read) for b, _ in tail_blocks]
        return joined, np.repeat(np.arange(len(counts)), counts), tuple(segment_moves)


def _cut(pieces: Pieces, start, segment, cuts, knot_times):
    """Divide pieces at the instants where the chamber changes its slope, so that every piece is smooth."""
    before: dict[int, list[int]] = {}
    for piece, knot in cuts:
        before.setdefault(piece, []).append(knot)
    source, low, high = [], [], []
    for k in range(len(pieces.read)):
        edges = [-1, *before.get(k, []), -2]
        for a, b in zip(edges[:-1], edges[1:], strict=True):
            source.append(k)
            low.append(a)
            high.append(b)
    source, low, high = np.array(source), np.array(low), np.array(high)
    share = lambda knot: (knot_times[np.maximum(knot, 0)] - start[source]) / pieces.duration[source]  # noqa: E731
    v0 = jnp.where(low == -1, 0.0, share(low))
    v1 = jnp.where(high == -2, 1.0, share(high))
    u0, width = pieces.u_start[source], (pieces.u_end - pieces.u_start)[source]
    last = high == -2
    cut = Pieces(
        pieces.duration[source] * (v1 - v0),
        u0 + width * v0,
        u0 + width * v1,
        pieces.terms[source],
        pieces.read[source] & last,
        pieces.at_rest[source] & (last | ~pieces.moving[source]),
        pieces.moving[source],
        pieces.varying[source],
    )
    return cut, start[source] + pieces.duration[source] * v0, segment[source]


def gradient_plan(
    programme: Programme,
    moves: tuple[Move, ...] = (),
    *,
    first_stretch: int = 0,
    soak_used: bool = False,
    read_every: float | None = 1.0,
) -> GradientPlan:
    """Fit the moves into the programme. `read_every` s: spacing of readings while the axis stands outside the moves.

    Errors: `ValueError` when the moves take longer than the programme leaves.
    """
    available = float(jnp.sum(programme.durations[first_stretch:]))
    soak = float(jnp.sum(programme.durations[:first_stretch]))
    durations = [float(m.duration) for m in moves]
    period = sum(durations)
    slack = 1e-9 * available
    cycles = int((available + slack) // period) if period > 0 else 0
    left = available - cycles * period
    begun = 0
    while begun < len(moves) and durations[begun] <= left + slack:
        left -= durations[begun]
        begun += 1
    if moves and cycles == 0 and begun < len(moves):
        raise ValueError(
            f"one cycle takes {period:.6g} s but the temperature programme leaves {available:.6g} s: "
            "shorten the cycle or slow the gradient"
        )
    what, tail_readings = -2, 0
    if left > max(slack, 1e-6):
        cut_rest = begun < len(moves) and moves[begun].shape == "rest"
        what = begun if cut_rest else -1
        if cut_rest:
            readings = moves[begun].readings_at_rest
            read_every = durations[begun] / readings if readings else None
        tail_readings = readings_in(left, read_every)
    schedule = Schedule(readings_in(soak, read_every) if soak_used else 0, cycles, begun, what, tail_readings)
    plan = GradientPlan(programme, tuple(moves), schedule, first_stretch, soak_used, {})
    times = np.asarray(programme.knots()[0])[1:-1]
    cuts: dict[str, tuple[tuple[int, int], ...]] = {}
    for channel in plan.channels:
        line = plan.timeline(channel)
        begin, end = np.asarray(line.start), np.asarray(line.start + line.duration)
        found = [
            (int(k), j + 1) for j, t in enumerate(times) for k in np.flatnonzero((begin < t - 1e-6) & (end > t + 1e-6))
        ]
        if found:
            cuts[channel] = tuple(sorted(found))
    return GradientPlan(programme, tuple(moves), schedule, first_stretch, soak_used, cuts)


class StandardPlan(eqx.Module):
    """Stable temperatures (°C), each with a soak (s), and at each the rates (rad/s; 0 is standing) for `integration` s each.

    Every point is an independent stretch with a noise state of its own and a reference *rate* whose error is common to the
    point, so splitting a point into several readings would buy nothing.
    """

    temperatures: Float[Array, " t"]
    rates: Float[Array, " r"]
    soak: Float[Array, ""]
    integration: Float[Array, ""]

    @property
    def channels(self) -> tuple[str, ...]:
        return ("x",)

    @property
    def total_time(self) -> Float[Array, ""]:
        count = self.temperatures.shape[0]
        return count * (self.soak + self.rates.shape[0] * self.integration)

    @property
    def soak_time(self) -> Float[Array, ""]:
        return self.temperatures.shape[0] * self.soak

    def timeline(self, channel: str = "x", thermal_lag: Float[Array, ""] | float | None = None) -> Timeline:
        """One piece a point. With a thermal lag the rest of each temperature's step decays through its soak and points."""
        n_t, n_r = self.temperatures.shape[0], self.rates.shape[0]
        stay = self.soak + n_r * self.integration
        into = jnp.tile(self.soak + self.integration * jnp.arange(n_r, dtype=float), n_t)
        start = jnp.repeat(stay * jnp.arange(n_t, dtype=float), n_r) + into
        step = jnp.concatenate([jnp.zeros(1), self.temperatures[:-1] - self.temperatures[1:]])
        lag_rate = jnp.zeros(()) if thermal_lag is None else 1.0 / jnp.asarray(thermal_lag, dtype=start.dtype)
        excess = jnp.zeros(n_t * n_r) if thermal_lag is None else jnp.repeat(step, n_r) * jnp.exp(-lag_rate * into)
        count = n_t * n_r
        rates = jnp.tile(self.rates, n_t)
        flags = jnp.ones(count, bool)
        return Timeline(
            start=start,
            duration=jnp.full((count,), 1.0) * self.integration,
            u_start=jnp.zeros(count),
            u_end=jnp.ones(count),
            terms=rates[:, None] * jnp.asarray(CONSTANT),
            trail=jnp.repeat(self.temperatures, n_r),
            slope=jnp.zeros(count),
            excess=excess,
            lag_rate=lag_rate,
            read=flags,
            at_rest=~flags,
            moving=flags,
            reset=flags,
            segment=jnp.arange(count),
            moving_pieces=IndexArray(np.arange(count)),
            varying_pieces=IndexArray(()),
            segment_moves=(-1,) * count,
            axis=channel,
            rate_reference=True,
        )


def standard_plan(temperatures, soak: float, integration: float, rates=(0.0,)) -> StandardPlan:
    """A standard plan from plain numbers: °C, s, s, rad/s."""
    as_array = lambda v: jnp.asarray(v, dtype=float)  # noqa: E731
    return StandardPlan(as_array(temperatures), as_array(rates), as_array(soak), as_array(integration))


Plan = GradientPlan | StandardPlan
