"""The timeline: a plan written out as smooth pieces of one channel, with a reading at the end of some of them.

Symbols: `P` pieces in order of time. Within piece `k`, at the fraction `v ∈ [0, 1]` of its duration,

    u = u_start + (u_end − u_start)·v,   ω = terms_k · f(u)            (f: the motion family of `formulas`)
    T = trail_k + slope_k·t + excess_k·exp(−lag_rate·t),  t = v·duration_k

Times in s, rates in rad/s, temperatures in °C. What moves one axis is rest for the others, so each sensor axis has a
timeline of its own.
"""

import equinox as eqx
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float, Int

from gradcal_jax import formulas

EVERY = slice(None)


class IndexArray:
    """An integer array that is part of a computation's structure: hashable, so it may be a static field."""

    def __init__(self, values):
        self.values = np.asarray(values, dtype=np.int64)
        self._key = (self.values.shape, self.values.tobytes())
        self._hash = hash(self._key)

    def __hash__(self) -> int:
        return self._hash

    def __eq__(self, other: object) -> bool:
        return isinstance(other, IndexArray) and self._key == other._key

    def __len__(self) -> int:
        return len(self.values)


class Timeline(eqx.Module):
    """Pieces of one channel. Fields of shape `(P,)` unless said; see the module's head for the symbols.

    `read`: a reading at the end of the piece, which stands for `share` of them; `at_rest`: the axis stands then;
    `moving`: the rate is not zero throughout; `reset`: an independent stretch begins here (standard method);
    `segment`: the move or soak that the piece belongs to, an index into `segment_moves`, whose entries index the
    plan's moves (−1: standing). `moving_pieces` and, of them, `varying_pieces` (the rate is not constant) list
    indices; at the end of each of `gap_pieces`, whose data are not used, the angle's origin is read anew.
    `rate_reference`: the reading is of a held rate, over its piece, not of an angle. `lagged`: the sensor lags behind
    the chamber.
    """

    start: Float[Array, " P"]
    duration: Float[Array, " P"]
    u_start: Float[Array, " P"]
    u_end: Float[Array, " P"]
    terms: Float[Array, "P 10"]
    share: Float[Array, " P"]
    trail: Float[Array, " P"]
    slope: Float[Array, " P"]
    excess: Float[Array, " P"]
    lag_rate: Float[Array, ""]
    read: Bool[Array, " P"]
    at_rest: Bool[Array, " P"]
    moving: Bool[Array, " P"]
    reset: Bool[Array, " P"]
    segment: Int[Array, " P"]
    moving_pieces: IndexArray = eqx.field(static=True)
    varying_pieces: IndexArray = eqx.field(static=True)
    gap_pieces: IndexArray = eqx.field(static=True)
    segment_moves: tuple[int, ...] = eqx.field(static=True)
    axis: str = eqx.field(static=True, default="x")
    rate_reference: bool = eqx.field(static=True, default=False)
    lagged: bool = eqx.field(static=True, default=False)

    @property
    def piece_count(self) -> int:
        return self.duration.shape[0]

    def rate(self, v: Float[Array, "k q"], pieces: np.ndarray | slice = EVERY) -> Float[Array, "k q"]:
        """Rate (rad/s) at fractions `v` of each piece, or of each of the `k` given ones."""
        u_start, u_end = self.u_start[pieces][:, None], self.u_end[pieces][:, None]
        family = formulas.motion_rate(u_start + (u_end - u_start) * v)
        return jnp.einsum("kqm,km->kq", family, self.terms[pieces])

    def temperature(self, v: Float[Array, "k q"], pieces: np.ndarray | slice = EVERY) -> Float[Array, "k q"]:
        """Sensor temperature (°C) at fractions `v` of each piece, or of each of the `k` given ones."""
        since, start, slope, excess = (f[pieces][:, None] for f in (self.duration, self.trail, self.slope, self.excess))
        return formulas.lagged_temperature(v * since, start, slope, excess, self.lag_rate)

    def turned(self) -> Float[Array, " P"]:
        """Angle (rad) that each piece turns, closed form."""
        span = self.u_end - self.u_start
        whole = jnp.einsum(
            "pm,pm->p", formulas.motion_angle(self.u_end) - formulas.motion_angle(self.u_start), self.terms
        )
        return whole * self.duration / jnp.where(span > 0.0, span, 1.0)

    def end_rate(self) -> Float[Array, " P"]:
        """Rate (rad/s) at the end of each piece."""
        return jnp.einsum("pm,pm->p", formulas.motion_rate(self.u_end), self.terms)


def points_timeline(
    start: Float[Array, " P"],
    duration: Float[Array, " P"],
    rate: Float[Array, " P"],
    temperature: Float[Array, " P"],
    *,
    axis: str = "x",
    excess: Float[Array, " P"] | None = None,
    lag_rate: Float[Array, ""] | None = None,
) -> Timeline:
    """The standard method's points (s, rad/s, °C): one piece and one reading of a held rate each, all independent.

    `excess` and `lag_rate`: how a lagging sensor comes to the temperature; see the module's head.
    """
    count = start.shape[0]
    yes, nothing = jnp.ones(count, bool), jnp.zeros(count)
    return Timeline(
        start=start,
        duration=duration,
        u_start=nothing,
        u_end=jnp.ones(count),
        terms=rate[:, None] * jnp.asarray(formulas.CONSTANT)[None, :],
        share=jnp.ones(count),
        trail=temperature,
        slope=nothing,
        excess=nothing if excess is None else excess,
        lag_rate=jnp.zeros(()) if lag_rate is None else lag_rate,
        read=yes,
        at_rest=~yes,
        moving=yes,
        reset=yes,
        segment=jnp.arange(count),
        moving_pieces=IndexArray(np.arange(count)),
        varying_pieces=IndexArray(()),
        gap_pieces=IndexArray(()),
        segment_moves=(-1,) * count,
        axis=axis,
        rate_reference=True,
        lagged=lag_rate is not None,
    )
