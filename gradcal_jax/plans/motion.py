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
    """Smooth pieces of one move on one channel; the flags are part of the structure."""

    duration: Array
    u_start: Array
    u_end: Array
    terms: Array
    read: np.ndarray
    at_rest: np.ndarray
    moving: np.ndarray
    varying: np.ndarray


class Steps(NamedTuple):
    """How one smooth part of a move is divided: into `count` equal pieces, with a reading after every `stride` of them.

    A stride of 0 leaves the part unread.
    """

    count: int = 1
    stride: int = 0


class Move(eqx.Module):
    """A turn (any of `formulas.SHAPES`), or a rest (`shape="rest"`), of the table axis `axis`.

    `peak_rate` rad/s, signed; `duration` s, the whole move's; `ramp` s, each ramp's; `controls` a spline's rates over the
    peak rate; `unevenness` of a turn by hand. `steps`: the division of each smooth part. `readings_at_rest`: how many readings a
    standing axis gets meanwhile.
    """

    peak_rate: Float[Array, ""]
    duration: Float[Array, ""]
    ramp: Float[Array, ""]
    controls: Float[Array, " c"]
    unevenness: Float[Array, ""]
    shape: str = eqx.field(static=True)
    axis: str = eqx.field(static=True, default="x")
    cycles: int = eqx.field(static=True, default=1)
    steps: tuple[Steps, ...] = eqx.field(static=True, default=())
    readings_at_rest: int = eqx.field(static=True, default=0)

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
            return rest_pieces(self.duration, self.readings_at_rest)
        blocks = []
        parts = self._parts()
        for i, ((duration, coefficients, varying), (count, stride)) in enumerate(zip(parts, self.steps, strict=True)):
            edges = jnp.linspace(0.0, 1.0, count + 1)
            order = np.arange(1, count + 1)
            blocks.append(
                Pieces(
                    jnp.full((count,), 1.0 / count) * duration,
                    edges[:-1],
                    edges[1:],
                    jnp.tile(coefficients * self.peak_rate, (count, 1)),
                    (order % stride == 0) if stride else np.zeros(count, bool),
                    (order == count) & (i == len(parts) - 1),
                    np.ones(count, bool),
                    np.full(count, varying),
                )
            )
        return join(blocks)

    def _parts(self) -> list[tuple[Array, Array, bool]]:
        """(duration, coefficients for unit peak rate, whether the rate varies) of each smooth part; differentiable."""
        if self.shape == "hand":
            by_hand = formulas.shape_pieces("hand", unevenness=1.0)[0][2]
            even = jnp.asarray(formulas.shape_pieces("hand")[0][2])
            return [(self.duration, even + self.unevenness * (jnp.asarray(by_hand) - even), True)]
        if self.shape == "spline":
            count = self.controls.shape[0]
            unit = [formulas.shape_pieces("spline", controls=tuple(np.eye(count)[k])) for k in range(count)]
            spans = jnp.asarray([[piece[2] for piece in control] for control in unit])
            shares = [piece[1] for piece in unit[0]]
            coefficients = jnp.einsum("c,csm->sm", self.controls, spans)
            return [(share * self.duration, coefficients[s], True) for s, share in enumerate(shares)]
        lasting = {"ramp": self.ramp, "flat": self.duration - 2.0 * self.ramp}
        return [
            (lasting[what] if what in lasting else share * self.duration, jnp.asarray(coefficients), what != "flat")
            for what, share, coefficients in formulas.shape_pieces(self.shape, cycles=self.cycles)
        ]


def rest_pieces(duration: Float[Array, ""], readings: int) -> Pieces:
    """Standing for `duration` with that many equally spaced readings, the last at the end; 0 is one piece, unread."""
    steps = max(readings, 1)
    yes = np.ones(steps, bool)
    return Pieces(
        jnp.full((steps,), 1.0 / steps) * duration,
        jnp.zeros(steps),
        jnp.ones(steps),
        jnp.zeros((steps, len(formulas.MOTION_TERMS))),
        yes & (readings > 0),
        yes,
        ~yes,
        ~yes,
    )


def join(blocks: list[Pieces]) -> Pieces:
    """Blocks of pieces, one after the other."""
    if len(blocks) == 1:
        return blocks[0]
    arrays, flags = range(4), range(4, 8)
    return Pieces(
        *(jnp.concatenate([b[i] for b in blocks]) for i in arrays), *(np.concatenate([b[i] for b in blocks]) for i in flags)
    )


def readings_in(duration: float, every: float | None) -> int:
    """How many readings fit at a spacing of at least `every`; they are then spaced equally. None: none."""
    if every is None or duration <= 0.0:
        return 0
    return max(1, int(np.floor(duration / every * (1 + 1e-9))))


def rest(duration: float, read_every: float | None = None) -> Move:
    """A rest of `duration` s, read every `read_every` s (None: unread)."""
    return _move("rest", 0.0, duration, readings_at_rest=readings_in(float(duration), read_every))


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
    """A turn from plain numbers (rad/s, s); see `Move`. `read_every` reads on the move, too; parts on which the rate varies
    are divided until none is longer than `longest_piece` (a few of the shortest correlation time of the noise).

    Errors: `ValueError` for an unknown shape or ramps longer than the move.
    """
    if 2.0 * ramp > duration * (1 + 1e-12):
        raise ValueError(f"two ramps of {ramp} s do not fit into a move of {duration} s: shorten the ramp or the rate")
    lasting = {"ramp": ramp, "flat": duration - 2.0 * ramp}
    parts = formulas.shape_pieces(shape, cycles=cycles, controls=controls, unevenness=unevenness)
    steps = []
    for i, (what, share, _) in enumerate(parts):
        part = lasting.get(what, share * duration)
        readings = max(readings_in(part, read_every), int(read_at_end and i == len(parts) - 1))
        apart = part / max(readings, 1)
        within = max(1, int(np.ceil(apart / longest_piece))) if what != "flat" else 1
        steps.append(Steps(max(readings, 1) * within, within if readings else 0))
    return _move(
        shape,
        peak_rate,
        duration,
        ramp=ramp,
        axis=axis,
        cycles=cycles,
        controls=controls,
        unevenness=unevenness,
        steps=tuple(steps),
        readings_at_rest=readings_in(float(duration), others_read_every),
    )


def _move(shape, peak_rate, duration, *, ramp=0.0, controls=(), unevenness=0.0, **structure) -> Move:
    as_array = lambda v: jnp.asarray(v, dtype=float)  # noqa: E731
    return Move(
        as_array(peak_rate), as_array(duration), as_array(ramp), as_array(controls), as_array(unevenness), shape, **structure
    )
