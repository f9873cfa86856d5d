"""Moves of a table axis: shapes by name, resolved into smooth pieces.

A move is described by peak rate, duration and (for the shapes with ramps) ramp time; the angle follows. What of these a
user gives, and what is worked out, is settled where the spec is read.
"""

from typing import NamedTuple

import equinox as eqx
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from gradcal_jax import formulas


class Pieces(NamedTuple):
    """Smooth pieces of one move on one channel, in order; the flags are part of the structure.

    Arrays: `duration` s, `u_start`, `u_end`, `terms`, `share` (see `plans.timeline`). Flags: a reading at the end;
    standing then; the rate not zero throughout; the rate not constant; a gap, at whose end the angle's origin is read
    anew.
    """

    duration: Array
    u_start: Array
    u_end: Array
    terms: Array
    share: Array
    read: np.ndarray
    at_rest: np.ndarray
    moving: np.ndarray
    varying: np.ndarray
    gap: np.ndarray


_ARRAYS = 5


class Division(NamedTuple):
    """How a smooth part of a move is divided: `edges` (fractions, 0 to 1), and which pieces end with a reading."""

    edges: tuple[float, ...]
    read: tuple[bool, ...]


def divide(duration: float, readings: list[float], longest: float = np.inf) -> Division:
    """Divide a part of `duration` at its readings (from its start), until no piece is longer than `longest`."""
    if duration <= 0.0:
        return Division((0.0, 1.0), (bool(readings),))
    stops = [float(t) / duration for t in readings]
    ends = stops if stops and stops[-1] > 1.0 - 1e-9 else [*stops, 1.0]
    if ends is stops:
        ends = [*stops[:-1], 1.0]
    edges, read = [0.0], []
    for k, end in enumerate(ends):
        begin = edges[-1]
        count = max(1, int(np.ceil((end - begin) * duration / longest * (1.0 - 1e-9))))
        edges += [begin + (end - begin) * i / count for i in range(1, count)] + [end]
        read += [False] * (count - 1) + [k < len(stops)]
    return Division(tuple(edges), tuple(read))


class Move(eqx.Module):
    """A turn (any of `formulas.SHAPES`), or a rest (`shape="rest"`), of the table axis `axis`.

    `peak_rate` rad/s, signed; `duration` s, the whole move's; `ramp` s, each ramp's; `controls` a spline's rates over
    the peak rate; `unevenness` of a turn by hand. `divisions`: of each smooth part; `division_at_rest`: of the same
    time for an axis that stands meanwhile, `spacing` the true spacing of its readings where it is relaxed (`standing`).
    """

    peak_rate: Float[Array | np.ndarray, ""]
    duration: Float[Array | np.ndarray, ""]
    ramp: Float[Array | np.ndarray, ""]
    controls: Float[Array | np.ndarray, " c"]
    unevenness: Float[Array | np.ndarray, ""]
    shape: str = eqx.field(static=True)
    axis: str = eqx.field(static=True)
    cycles: int = eqx.field(static=True)
    divisions: tuple[Division, ...] = eqx.field(static=True)
    division_at_rest: Division = eqx.field(static=True)
    spacing: Float[Array | np.ndarray, ""] | None = None

    @property
    def angle(self) -> Float[Array, ""]:
        """Net angle, rad."""
        pieces = self.pieces(self.axis)
        span = formulas.motion_angle(pieces.u_end) - formulas.motion_angle(pieces.u_start)
        width = pieces.u_end - pieces.u_start
        return jnp.sum(jnp.einsum("pm,pm->p", span, pieces.terms) * pieces.duration / jnp.where(width > 0, width, 1.0))

    def pieces(self, channel: str) -> Pieces:
        """The move as the given channel sees it: its own motion, or standing while another axis moves."""
        if self.shape == "rest" or channel != self.axis:
            return standing(self.duration, self.division_at_rest, spacing=self.spacing)
        blocks = []
        parts = self._parts()
        for i, ((duration, coefficients, varying), (edges, read)) in enumerate(zip(parts, self.divisions, strict=True)):
            count, at = len(read), jnp.asarray(edges)
            ends_move = np.arange(count) == (count - 1 if i == len(parts) - 1 else count)
            blocks.append(
                Pieces(
                    jnp.diff(at) * duration,
                    at[:-1],
                    at[1:],
                    jnp.tile(coefficients * self.peak_rate, (count, 1)),
                    jnp.ones(count),
                    np.array(read),
                    ends_move,
                    np.ones(count, bool),
                    np.full(count, varying),
                    np.zeros(count, bool),
                )
            )
        return join(blocks)

    def _parts(self) -> list[tuple[Array, Array, bool]]:
        """(duration, coefficients for unit peak rate, whether the rate varies) of each smooth part; differentiable."""
        duration, ramp = jnp.asarray(self.duration), jnp.asarray(self.ramp)
        if self.shape == "hand":
            by_hand = formulas.shape_pieces("hand", unevenness=1.0)[0][2]
            even = jnp.asarray(formulas.shape_pieces("hand")[0][2])
            return [(duration, even + self.unevenness * (jnp.asarray(by_hand) - even), True)]
        if self.shape == "spline":
            count = self.controls.shape[0]
            unit = [formulas.shape_pieces("spline", controls=tuple(np.eye(count)[k])) for k in range(count)]
            spans = jnp.asarray([[piece[2] for piece in control] for control in unit])
            shares = [piece[1] for piece in unit[0]]
            coefficients = jnp.einsum("c,csm->sm", self.controls, spans)
            return [(share * duration, coefficients[s], True) for s, share in enumerate(shares)]
        lasting = {"ramp": ramp, "flat": duration - 2.0 * ramp}
        return [
            (lasting[what] if what in lasting else share * duration, jnp.asarray(coefficients), what != "flat")
            for what, share, coefficients in formulas.shape_pieces(self.shape, cycles=self.cycles)
        ]


def standing(
    duration: Float[Array | np.ndarray, ""],
    division: Division,
    *,
    spacing: Float[Array | np.ndarray, ""] | None = None,
    gap: bool = False,
) -> Pieces:
    """Standing for `duration`, divided as told; `gap`: a time whose data are not used.

    `spacing`: the true spacing of readings, of which each piece's one stands for as many as fit, not a whole number:
    the relaxation in which a design is searched.
    """
    count, at = len(division.read), jnp.asarray(division.edges)
    yes = np.ones(count, bool)
    lasts = jnp.diff(at) * duration
    return Pieces(
        lasts,
        jnp.zeros(count),
        jnp.ones(count),
        jnp.zeros((count, len(formulas.MOTION_TERMS))),
        jnp.ones(count) if spacing is None else lasts / spacing,
        np.array(division.read),
        yes,
        ~yes,
        ~yes,
        yes & gap,
    )


def join(blocks: list[Pieces]) -> Pieces:
    """Blocks of pieces, one after the other."""
    if len(blocks) == 1:
        return blocks[0]
    fields = list(zip(*blocks, strict=True))
    arrays = [jnp.concatenate(f) for f in fields[:_ARRAYS]]
    return Pieces._make([*arrays, *(np.concatenate(f) for f in fields[_ARRAYS:])])


def repeat(block: Pieces, count: int) -> Pieces:
    """A block of pieces `count` times over."""
    arrays = [jnp.tile(f, (count,) + (1,) * (f.ndim - 1)) for f in block[:_ARRAYS]]
    return Pieces._make([*arrays, *(np.tile(f, count) for f in block[_ARRAYS:])])


def rest(duration: float, read_every: float | None = None, *, read_at_end: bool = False) -> Move:
    """A rest of `duration` s, read every `read_every` s, or (None) at its end alone if `read_at_end`.

    Errors: `ValueError` for what is no number.
    """
    at_end = [float(duration)] if read_at_end else []
    division = divide(float(duration), formulas.reading_times(float(duration), read_every) or at_end)
    return _move("rest", 0.0, duration, (division,), division)


def turn(
    shape: str,
    peak_rate: float,
    duration: float,
    *,
    ramp: float = 0.0,
    axis: str = "x",
    cycles: int = 1,
    controls: tuple[float, ...] = (),
    unevenness: float = 0.0,
    read_at_end: bool = True,
    read_every: float | None = None,
    others_read_every: float | None = None,
    longest_piece: float = np.inf,
) -> Move:
    """A turn of `axis` from plain numbers: `peak_rate` rad/s, signed; `duration` and each `ramp` in s.

    `shape`: one of `formulas.SHAPES`; `cycles` of a sinusoid, `controls` of a spline (over the peak rate), `unevenness`
    of a turn by hand. `read_at_end`: the angle is read where the turn ends; `others_read_every` s: of axes that stand
    meanwhile. `read_every` reads on the move, too, and then `read_at_end` does not matter. `longest_piece` (a few of
    the shortest correlation time of the noise) divides the parts on which the rate varies.

    Errors: `ValueError` for an unknown shape or ramps longer than the move.
    """
    if 2.0 * ramp > duration * (1 + 1e-9):
        raise ValueError(f"two ramps of {ramp} s do not fit into a move of {duration} s: shorten the ramp or the rate")
    lasting = {"ramp": ramp, "flat": max(duration - 2.0 * ramp, 0.0)}
    if shape == "hand":
        # Its rate goes up and down four times, and the powers of it in M(T, ω) more often than one quadrature follows.
        longest_piece = min(longest_piece, duration / 8)
    readings = formulas.reading_times(duration, read_every) or ([duration] if read_at_end else [])
    divisions, begin = [], 0.0
    parts = formulas.shape_pieces(shape, cycles=cycles, controls=controls, unevenness=unevenness)
    for i, (what, share, _) in enumerate(parts):
        part = lasting.get(what, share * duration)
        last = i == len(parts) - 1
        inside = [t - begin for t in readings if t > begin + 1e-12 * duration and (last or t <= begin + part)]
        divisions.append(divide(part, [min(t, part) for t in inside], np.inf if what == "flat" else longest_piece))
        begin += part
    others = divide(duration, formulas.reading_times(duration, others_read_every))
    return _move(
        shape, peak_rate, duration, tuple(divisions), others, ramp, controls, unevenness, axis=axis, cycles=cycles
    )


def _move(
    shape, peak_rate, duration, divisions, at_rest, ramp=0.0, controls=(), unevenness=0.0, *, axis="x", cycles=1
) -> Move:
    numbers = (np.asarray(v, dtype=float) for v in (peak_rate, duration, ramp, controls, unevenness))
    return Move(*numbers, shape=shape, axis=axis, cycles=cycles, divisions=divisions, division_at_rest=at_rest)
