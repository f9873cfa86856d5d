"""The rows of a whole unit on a table, and the one joint noise system behind them.

A *segment* is a rest or one move of one axis. At its end every gyro has one row, its integral over the segment less
the turned angle; every accelerometer has one where the table stood. A table that holds its
position does not turn, so the encoder enters a rest only through the direction of the axes.

State `x = [C integrals, the processes of every channel, the encoders' errors now, and before the last move]`. All
channels see the error of an axis's encoder, so the channels are correlated: one filter takes their rows one after
another (without a step between the rows of one segment). The error `e_l` of axis l at a standstill is a rotation of the
body about `a_l`. It adds to a row

    gyro i            while l turns: a_li (e_now − e_before) + ∫(ω_outer × a_l)_i e(t) dt, e(t) in between by angle;
                      else ∫(ω_outer × a_l)_i dt · e_now
    accelerometer i   ∫(f × a_l)_i dt · e_now

and every move of its axis draws `e_now` anew. Where the angle is read while the table stands, a segment is what lies
between two readings, at rest or on the move, and every reading has its own error: a white part, and the offset of its
standstill (a third state) or, on the move, the rate times the error of its time. A row of gyro i then has
`ā_li (e_now − e_before)` of every axis, ā its mean direction; for an axis that stands, the attitude error is the mean
of both. Where the reference is a held rate, every segment's error is one draw of the reference, `ā_li e_now`.
"""

from collections.abc import Mapping, Sequence
from typing import Any, NamedTuple

import jax
import numpy as np
from jaxtyping import Bool, Float, Int

from gradcal_jax.arrays import AnyArray, namespace, placed, put, summed, taken
from gradcal_jax.information.noise_steps import NoisePart, NoiseSteps, drive_rates, process_steps
from gradcal_jax.model import BodyNodes, ImuModel, NodeGroup
from gradcal_jax.model.terms import Term
from gradcal_jax.motion import TableMotion

# Columns below this share of the largest one of the same unit are rounding.
_ROUNDING = 1e-11
# rad: in a move with a smaller net angle, the encoder's error cannot be interpolated by angle.
_RETURNS = 1e-3


class Segments(NamedTuple):
    """Rests and moves of a motion, `S` of them: `first` and `last` piece, an `axis` that turns (−1: none); and the
    rows `(R,)` in order of time, each of one channel and segment. A segment without any has one that is not `used`.
    """

    first: Int[np.ndarray, " S"]
    last: Int[np.ndarray, " S"]
    axis: Int[AnyArray, " S"]
    row_segment: Int[np.ndarray, " R"]
    row_channel: Int[np.ndarray, " R"]
    used: Bool[AnyArray, " R"]

    def sums(self, of_pieces: AnyArray) -> AnyArray:
        """Sums over the pieces of each segment, `(P, …) -> (S, …)`."""
        return summed(of_pieces, self.first)


def segments_of(motion: TableMotion, model: ImuModel) -> Segments:
    """The segments of a motion and a unit's rows of them."""
    line, number = motion.line, np.asarray(motion.line.segment)
    begins, gap = np.diff(number, prepend=number[0] - 1) != 0, np.asarray(line.gap)
    if between_readings := line.rates or not model.encoder.held:
        begins[1:] = np.asarray(line.read)[:-1] | (begins[1:] & (gap[1:] | gap[:-1]))
    first = np.flatnonzero(begins)
    last = np.append(first[1:], len(number)) - 1
    axis = np.maximum.reduceat(np.asarray(motion.axis), first)
    read = ~gap[first]
    if between_readings:
        read &= np.asarray(line.read)[last]
    rows = np.stack([read & ((axis < 0) | (c.kind == "gyro")) for c in model.channels], axis=1)
    kept = np.array(rows)
    kept[:, 0] |= ~np.any(rows, axis=1)
    segment, channel = np.nonzero(kept)
    return Segments(first, last, axis, segment, channel, rows[segment, channel])


def rows_of_terms(
    model: ImuModel, nodes: BodyNodes, at: Segments, terms: Sequence[tuple[int, Term]]
) -> Float[AnyArray, "R k"]:
    """Columns of terms of one parameter, as if the channels of these numbers had them."""
    columns: list[Any] = []
    for k, (number, term) in enumerate(terms):
        channel, rows = model.channels[number], np.flatnonzero(at.row_channel == number)
        of_pieces = term.columns(nodes.sensed_by(channel.kind, channel.axis))
        columns.append(((rows, slice(k, k + 1)), at.sums(of_pieces)[at.row_segment[rows]]))
    return placed((len(at.row_segment), len(terms)), *columns)


def imu_system(
    motion: TableMotion,
    model: ImuModel,
    nodes: BodyNodes,
    at: Segments | None = None,
    common: Float[AnyArray, "rows k"] | None = None,
    beside: Float[AnyArray, "rows j"] | None = None,
) -> tuple[NoiseSteps, Float[AnyArray, "R p"]]:
    """Noise steps and regressors of all rows, those of `common` errors first, those `beside` last. `at`: the segments,
    where the axes or the used rows are traced."""
    at = segments_of(motion, model) if at is None else at
    steps, row = _joint_steps(motion, model, nodes, at)
    every = [of for of in (common, _columns(model, nodes, at), beside) if of is not None]
    columns = every[0] if len(every) == 1 else namespace(*every).concatenate(every, axis=1)
    return steps, _by_steps(columns, row)


def noise_parts(motion: TableMotion, models: Mapping[str, ImuModel], nodes: BodyNodes) -> dict[str, NoisePart]:
    """The parts of a system's noise, by models of one structure."""
    at = segments_of(motion, next(iter(models.values())))
    return {name: NoisePart(*_moving_steps(motion, model, nodes, at)[1:]) for name, model in models.items()}


def row_of_steps(motion: TableMotion, model: ImuModel) -> np.ndarray:
    """The row that each step of `imu_system` reads (−1: none)."""
    return _order(segments_of(motion, model), _by_pieces(model))[1]


def _by_steps(of_rows: AnyArray, row: np.ndarray) -> AnyArray:
    """Values of rows `(R, k)` in the order of the steps; zero for steps without one."""
    same = len(row) == len(of_rows)
    return of_rows if same else namespace(of_rows).where((row >= 0)[:, None], of_rows[row], 0.0)


def _by_pieces(model: ImuModel) -> bool:
    """Whether every piece is a step: where a rate drives a process, so that it is constant or smooth."""
    return any(bool(np.any(np.asarray(c.processes.rate_gain))) for c in model.channels)


def _columns(model: ImuModel, nodes: BodyNodes, at: Segments) -> Float[AnyArray, "R p"]:
    """Regressors of every row."""
    own, shared = model.columns(nodes)
    shared = at.sums(taken(shared, nodes.kind))
    parts, calibrated = [], model.calibrated
    for i, (c, block) in enumerate(zip(model.channels, own, strict=True)):
        rows = np.flatnonzero(at.row_channel == i)
        # (All segments are most often rows of an only channel.)
        segment = slice(None) if len(rows) == len(at.row_channel) == len(at.first) else at.row_segment[rows]
        parts.append(((rows, model.where(c.kind, c.axis)), taken(at.sums(block), segment)))
        if model.installation:
            parts.append(((rows, slice(calibrated, None)), taken(shared[:, c.index], segment)))
    return _without_rounding(placed((len(at.row_channel), model.size), *parts), model.units())


def _without_rounding(columns: Float[AnyArray, "R p"], units: list[str]) -> Float[AnyArray, "R p"]:
    """The columns with zeros for those that are rounding beside others of the same unit: the information scales columns
    to unit length, so that they would count as observable.
    """
    xp = namespace(columns)
    size = xp.maximum(xp.max(columns, axis=0), -xp.min(columns, axis=0))
    _, kind = np.unique(units, return_inverse=True)
    largest = xp.max(xp.where(kind[:, None] == kind[None, :], size[None, :], 0.0), axis=1)
    seen = size > _ROUNDING * largest
    return columns if xp is np and np.all(seen) else xp.where(seen[None, :], columns, 0.0)


def _joint_steps(motion: TableMotion, model: ImuModel, nodes: BodyNodes, at: Segments) -> tuple[NoiseSteps, np.ndarray]:
    """The steps, and the row that each reads (−1: none)."""
    through, noise, initial = _moving_steps(motion, model, nodes, at)
    # No step lies between rows of one segment; steps within a segment have no row.
    source, row = _order(at, _by_pieces(model))
    fresh, stays = np.flatnonzero(np.diff(source, prepend=-1)), np.ones(len(row), bool)
    stays[fresh] = False
    if len(fresh) < len(row):
        still = np.broadcast_to(np.eye(len(initial)), (len(row), *initial.shape))
        through, noise = put(still, fresh, through), put(np.zeros(still.shape), fresh, noise)
    observed = _by_steps(_observations(motion, model, nodes, at, len(initial)), row)
    used = at.used[row] & (row >= 0)
    return NoiseSteps(through, noise, observed, namespace(through).zeros(len(row)), used, initial, stays), row


def _moving_steps(
    motion: TableMotion, model: ImuModel, nodes: BodyNodes, at: Segments
) -> tuple[Float[AnyArray, "M n n"], Float[AnyArray, "M n n"], Float[AnyArray, "n n"]]:
    """Transition and covariance of every step between rows, and the covariance of the initial state."""
    xp, line, by_pieces, every = namespace(motion, model, nodes), motion.line, _by_pieces(model), slice(None)
    # One step for each segment, or for each piece.
    duration = line.duration if by_pieces else at.sums(line.duration)
    count, gap = duration.shape[0], np.asarray(line.gap)[every if by_pieces else at.first]
    begins = np.isin(np.arange(count), at.first) if by_pieces else np.ones(count, bool)
    before = np.cumprod(gap).astype(bool)[:, None] if gap[0] else None
    # The direction about which each piece turns, and what a gain multiplies: the rate that a gyro senses.
    axes = nodes.axes_before if nodes.across_axes is None else nodes.axes_before + nodes.across_axes
    along = xp.sum(xp.where(motion.turns[..., None], axes[nodes.kind], 0.0), axis=1)
    driving, varying = along * line.end_rate()[:, None], line.varying_pieces
    transition: list[tuple] = []
    covariance: list[tuple] = []
    initial: list[tuple] = []
    begin = len(model.channels)
    for i, c in enumerate(model.channels):
        rates, along_rates = xp.zeros(count), None
        if by_pieces and c.kind == "gyro":
            rates = driving[:, c.axis]
            if varying.shape[0]:
                along_rates = varying, drive_rates(line, varying) * along[varying, c.axis][:, None]
        afresh = line.points == "independent"
        to_integral, decayed, variance, q_cross, q_self = process_steps(
            c.processes, duration, rates, along_rates, before, afresh=afresh
        )
        own = slice(begin, begin + c.processes.count)
        each = np.arange(own.start, own.stop)
        transition += [
            ((every, i, i), np.where(begins, 0.0, 1.0)),
            ((every, i, own), to_integral),
            ((every, each, each), decayed),
        ]
        covariance += [
            ((every, i, i), c.angle_random_walk**2 * duration + variance),
            ((every, i, own), q_cross),
            ((every, own, i), q_cross),
            ((every, each, each), q_self),
        ]
        initial.append(((each, each), c.processes.initial_std**2))
        begin = own.stop
    of_encoders, drawn, first_errors = _encoder_errors(motion, model, at)
    n = begin + len(first_errors)
    if by_pieces:
        # Between the ends of segments the errors stay as they are.
        still = np.broadcast_to(np.eye(n - begin), (count, n - begin, n - begin))
        of_encoders, drawn = put(still, at.last, of_encoders), put(np.zeros(still.shape), at.last, drawn)
    errors = slice(begin, n)
    transition.append(((every, errors, errors), of_encoders))
    covariance.append(((every, errors, errors), drawn))
    initial.append(((errors, errors), first_errors))
    through, noise = (placed((count, n, n), *parts) for parts in (transition, covariance))
    return through, noise, placed((n, n), *initial)


def _order(at: Segments, by_pieces: bool) -> tuple[np.ndarray, np.ndarray]:
    """For every step of the filter its noise step and its row (−1: none)."""
    if not by_pieces:
        return at.row_segment, np.arange(len(at.row_segment))
    inner = np.setdiff1d(np.arange(at.last[-1] + 1), at.last)
    source = np.concatenate([inner, at.last[at.row_segment]])
    row = np.concatenate([np.full(len(inner), -1), np.arange(len(at.row_segment))])
    order = np.lexsort((row, source))
    return source[order], row[order]


def _encoder_errors(motion: TableMotion, model: ImuModel, at: Segments) -> tuple[AnyArray, AnyArray, AnyArray]:
    """Transition, covariance and initial covariance of the `e` states of the encoders' errors, at the end of every
    segment: `now` of every axis, then `before`, then the offset of its standstill; a held rate has the first alone, a
    table without offsets no third."""
    line, of, axes = motion.line, model.encoder, motion.geometry.axis_count
    xp, kinds = namespace(line.duration, of, motion.axis), 1 if line.rates else 2 if of.held or not of.has_offset else 3

    def of_kinds(entries: Mapping[tuple[int, int], AnyArray], *shape: int) -> AnyArray:
        """Matrices of the states by their diagonals `(…, L)` between two kinds."""
        each, size = np.arange(axes), kinds * axes
        parts = [
            ((..., a * axes + each, b * axes + each), value) for (a, b), value in entries.items() if max(a, b) < kinds
        ]
        return placed((*shape, size, size), *parts)

    count = len(at.first)
    if line.rates:
        turned = at.sums(xp.where(motion.turns, line.turned()[:, None], 0.0))
        spread = of_kinds({(0, 0): xp.square(of.rate * turned)}, count)
        return np.zeros((count, axes, axes)), spread, np.zeros((axes, axes))
    moved = xp.where(_moves(motion, at), 1.0, 0.0)
    share = xp.asarray(line.share)[at.last][:, None]
    offset, reading, timing = (of.offset**2)[None], (of.reading**2)[None], (np.zeros(axes) + of.timing)[None]
    if of.held:
        readings = readings_of_standstills(motion, model, at)
        shares = xp.concatenate([xp.ones((1, axes)), xp.where(moved > 0.0, share, 1.0)])
        every = offset + reading / (readings * shares)
        first, drawn = every[0], every[1:]
        fresh, spread, stands = moved, moved * drawn, moved
    else:
        gap, read, at_rest = (np.asarray(x)[at.last][:, None] for x in (line.gap, line.read, line.at_rest))
        # The empty slots of a search take no time, and are not read.
        reads = xp.where(at.sums(line.duration)[:, None] > 0.0, (read | gap).astype(float), 0.0)
        stands = reads * xp.where(motion.turns[at.last], at_rest.astype(float), 1.0)
        timed = xp.square(line.end_rate()[at.last][:, None] * timing) * (reads - stands)
        fresh, first, drawn = reads * np.ones((1, axes)), (reading + offset)[0], offset
        spread = reads * reading / share + timed + stands * moved * drawn
    now, before, still = range(3)
    stays, kept, both = 1.0 - fresh, 1.0 - moved, stands * moved * drawn
    transition = {(now, now): stays, (before, before): stays, (before, now): fresh}
    transition |= {(now, still): stands * kept, (still, still): kept}
    covariance = {(now, now): spread, (still, still): moved * drawn, (now, still): both, (still, now): both}
    initial = {(now, now): first} | dict.fromkeys([(now, still), (still, now), (still, still)], drawn[0])
    return of_kinds(transition, count), of_kinds(covariance, count), of_kinds(initial)


def _moves(motion: TableMotion, at: Segments) -> Bool[AnyArray, "S L"]:
    """Whether each segment moves each axis."""
    return at.sums(namespace(motion.turns).where(motion.turns, 1.0, 0.0)) > 0.0


def readings_of_standstills(
    motion: TableMotion, model: ImuModel, at: Segments | None = None
) -> Float[AnyArray, "readings L"]:
    """How often every axis of a table that is held is read before it moves again: before all segments, and after
    each."""
    at, line = at or segments_of(motion, model), motion.line
    xp, moves, gap = namespace(motion, model.encoder), _moves(motion, at), np.asarray(line.gap)[at.last]
    start, lasting = line.start[at.first], at.sums(line.duration)
    end = start[-1:] + lasting[-1:]
    # Of a move in a gap, nothing is read in the whole gap.
    of_gap = np.maximum.accumulate(np.where(gap & ~np.append(False, gap[:-1]), np.arange(len(gap)), 0))
    after = np.flatnonzero(~np.append(gap, False))
    following = after[np.searchsorted(after, np.arange(len(gap)))]
    ends = xp.where(gap, xp.concatenate([start, end])[following], start + lasting)
    begins = xp.concatenate([start[:1], ends])[:, None]
    # A standstill lasts until the axis moves again: of every segment, the begin of the next one that moves it.
    marked = xp.where(moves, xp.where(gap, start[of_gap], start)[:, None], end[None])
    marked = xp.flip(xp.concatenate([marked, xp.broadcast_to(end[None], (1, moves.shape[1]))]), axis=0)
    stops = xp.flip(np.minimum.accumulate(marked) if xp is np else jax.lax.cummin(marked), axis=0)
    return xp.floor((stops - begins) / model.encoder.every[None] * (1.0 + 1e-9) + 1e-9) + 1.0


def encoder_rows(
    motion: TableMotion, model: ImuModel, nodes: BodyNodes, at: Segments | None = None
) -> Float[AnyArray, "R 2 L"]:
    """What an encoder error of one rad adds to every row (rad, m/s): at the end of its segment, and before it. `at`: as
    of `imu_system`."""
    axes, at = motion.geometry.axis_count, at or segments_of(motion, model)
    xp, held = namespace(nodes.axes_before, motion.line.duration), model.encoder.held and not motion.line.rates
    before, after = motion.angles()
    # For an example of each kind: begin and total angle of its segment.
    segment = np.searchsorted(at.first, motion.example, side="right") - 1
    began = taken(before, at.first[segment])
    whole = taken(after, at.last[segment]) - taken(before, at.first[segment])
    stands = 1.0 if model.encoder.held or motion.line.rates else 0.5
    # Of the rates and forces along the body's axes those that a channel senses.
    sensed = np.array([c.index for c in model.channels])
    of_sensed = lambda of: xp.moveaxis(taken(xp.moveaxis(of, -1, 0), sensed), 0, -1)  # noqa: E731
    rates = lambda of: of_sensed(xp.concatenate([of, xp.zeros(of.shape)], axis=-1))  # noqa: E731

    def of_group(g: NodeGroup):
        begin, span = taken(began, g.kinds)[:, None], taken(whole, g.kinds)[:, None]
        # The share of the move that is completed interpolates the error between the two standstills.
        turns = motion.turns[motion.example[g.kinds]][:, None, :]
        away = turns & (abs(span) > _RETURNS)
        gone = xp.clip((g.angle - begin) / xp.where(away, span, 1.0), 0.0, 1.0)
        share = xp.where(turns, xp.where(away, gone, 0.5), stands)
        shares = xp.stack([share, 1.0 - share], axis=-1) * g.weight[..., None, None]
        parts = [xp.swapaxes(shares[:, :, k], -1, -2) @ of_sensed(g.turned(k)) for k in range(axes)]
        return xp.concatenate([xp.stack(parts, axis=2), rates(g.integral(g.axes))[:, None]], axis=1)

    sums = at.sums(taken(nodes.of_kinds(of_group, (3, axes, len(sensed))), nodes.kind))
    if held:
        own = at.axis[:, None] == np.arange(axes)[None, :]
        along = rates(xp.where(own[..., None], taken(nodes.axes_before, nodes.kind[at.first]), 0.0))
    else:
        lasting = at.sums(motion.line.duration)[:, None, None]
        along = sums[:, 2] / xp.where(lasting > 0.0, lasting, 1.0)
    slow = sums[:, :2] + xp.stack([along, -along], axis=1)
    by_channel = xp.reshape(xp.moveaxis(slow, -1, 1), (-1, 2, axes))
    return taken(by_channel, at.row_segment * len(sensed) + at.row_channel)


def rows_of_angles(
    at: Segments,
    of_errors: Float[AnyArray, "R 2 L"],
    before: Float[AnyArray, "P L k"],
    after: Float[AnyArray, "P L k"],
) -> Float[AnyArray, "R k"]:
    """What errors of the shown angles (rad), before and after every piece, add to the rows; `of_errors`: see
    `encoder_rows`."""
    xp = namespace(of_errors, before, after)
    ends = xp.stack([after[at.last], before[at.first]], axis=1)[at.row_segment]
    return xp.einsum("rsl,rslk->rk", of_errors, ends)


def _observations(
    motion: TableMotion, model: ImuModel, nodes: BodyNodes, at: Segments, n: int
) -> Float[AnyArray, "R n"]:
    """H of every row."""
    of_errors = encoder_rows(motion, model, nodes, at)
    count, axes = len(at.row_channel), motion.geometry.axis_count
    each, begin = np.arange(count), model.own_states
    parts: list[Any] = [((each, at.row_channel), np.ones(count))]
    for k in range(1 if motion.line.rates else 2):
        parts.append(((slice(None), slice(begin + k * axes, begin + (k + 1) * axes)), of_errors[:, k]))
    return placed((count, n), *parts)
