"""The trajectory: a plan as smooth pieces of one channel, with a reading at the end of some of them.

Symbols: `P` pieces in order of time. Within piece `k`, at the fraction `v ∈ [0, 1]` of its duration,

    u = u_start + (u_end − u_start)·v,   ω = terms_k · f(u)            (f: the motion family of `formulas`)
    T = level_k + slope_k·t + excess_k·exp(−lag_rate·t),  t = v·duration_k

Times in s, rates in rad/s, temperatures in °C. A move of one axis is a rest for the others, so each sensor axis has a
trajectory of its own.

**Parts of one run on a table**, cut at times and joined across pauses: in a pause nothing is read and every axis
returns to the angle at which the next part begins, up to whole turns. The noise continues; at the end of the pause the
angles have a new origin, in a standstill of their own.
"""

from dataclasses import fields, replace
from functools import lru_cache
from typing import Any, Literal

import equinox as eqx
import numpy as np
from jaxtyping import Bool, Float, Int

from gradcal_jax import formulas
from gradcal_jax.arrays import AnyArray, PytreeModule, namespace, once, placed, taken

_EVERY_PIECE = slice(None)


class Trajectory(PytreeModule):
    """Pieces of one channel. Fields of shape `(P,)` unless stated; see the module's head for the symbols.

    `read`: a reading at the end of the piece, which represents `share` readings; `at_rest`: the axis stands then;
    `moving`: the rate is not zero throughout; `gap`: its data are not used, and a new origin is read at its end;
    `segment` numbers the moves. `varying_pieces`: the numbers of those whose rate is not constant. `rates`, `points`:
    see `schedule.Schedule`; `lagged`: whether `excess` may be other than zero.
    """

    start: Float[AnyArray, " P"]
    duration: Float[AnyArray, " P"]
    u_start: Float[AnyArray, " P"]
    u_end: Float[AnyArray, " P"]
    terms: Float[AnyArray, "P m"]
    share: Float[AnyArray, " P"]
    level: Float[AnyArray, " P"]
    slope: Float[AnyArray, " P"]
    excess: Float[AnyArray, " P"]
    lag_rate: Float[AnyArray, ""]
    read: Bool[AnyArray, " P"]
    at_rest: Bool[AnyArray, " P"]
    moving: Bool[AnyArray, " P"]
    gap: Bool[AnyArray, " P"]
    segment: Int[AnyArray, " P"]
    varying_pieces: Int[AnyArray, " V"]
    rates: bool = eqx.field(static=True, default=False)
    points: Literal["one run", "independent"] = eqx.field(static=True, default="one run")
    lagged: bool = eqx.field(static=True, default=False)

    @property
    def piece_count(self) -> int:
        return self.duration.shape[0]

    def rate(self, v: Float[AnyArray, "k q"], pieces: Any = _EVERY_PIECE) -> Float[AnyArray, "k q"]:
        """Rate (rad/s) at fractions `v` of each of the `pieces`."""
        u_start, u_end = taken(self.u_start, pieces)[:, None], taken(self.u_end, pieces)[:, None]
        family = formulas.motion_rate(u_start + (u_end - u_start) * v)
        return (family @ taken(self.terms, pieces)[:, :, None])[..., 0]

    def angle(self, v: Float[AnyArray, "k q"], pieces: Any = _EVERY_PIECE) -> Float[AnyArray, "k q"]:
        """Angle (rad) since the begin of the piece, at fractions `v` of each of the `pieces`."""
        u_start = taken(self.u_start, pieces)[:, None]
        span = taken(self.u_end, pieces)[:, None] - u_start
        family = formulas.motion_angle(u_start + span * v) - formulas.motion_angle(u_start)
        xp = namespace(family, self.terms)
        shares = taken(self.duration, pieces)[:, None] / xp.where(span > 0.0, span, 1.0)
        return (family @ taken(self.terms, pieces)[:, :, None])[..., 0] * shares

    def temperature(self, v: Float[AnyArray, "k q"], pieces: Any = _EVERY_PIECE) -> Float[AnyArray, "k q"]:
        """Sensor temperature (°C) at fractions `v` of each of the `pieces`."""
        of = self.duration, self.level, self.slope, self.excess
        since, level, slope, excess = (taken(f, pieces)[:, None] for f in of)
        if not self.lagged:
            return level + slope * (v * since)
        return formulas.lagged_temperature(v * since, level, slope, excess, self.lag_rate)

    def temperature_slope(self, since: Float[AnyArray, "k q"], pieces: Any = _EVERY_PIECE) -> Float[AnyArray, "k q"]:
        """dT/dt (K/s) at times (s) since the begin of each of the `pieces`."""
        xp, slope = namespace(since, self.slope), taken(self.slope, pieces)[:, None]
        if not self.lagged:
            return xp.broadcast_to(slope, since.shape)
        return slope - self.lag_rate * self.excess[pieces][:, None] * xp.exp(-self.lag_rate * since)

    def ends(self) -> tuple[Float[AnyArray, " P"], Float[AnyArray, " P"]]:
        """Sensor temperature (°C) as each piece begins and ends."""
        xp = namespace(self.duration, self.level)
        both = self.temperature(xp.broadcast_to(xp.asarray([0.0, 1.0]), (self.piece_count, 2)))
        return both[:, 0], both[:, 1]

    @once
    def turned(self) -> Float[AnyArray, " P"]:
        """Angle (rad) that each piece turns, closed form."""
        span = self.u_end - self.u_start

        def shares(rows):
            return formulas.motion_angle(self.u_end[rows]) - formulas.motion_angle(self.u_start[rows])

        return self._motion(shares) * self.duration / namespace(span).where(span > 0.0, span, 1.0)

    @once
    def end_rate(self) -> Float[AnyArray, " P"]:
        """Rate (rad/s) at the end of each piece."""
        return self._motion(lambda rows: formulas.motion_rate(self.u_end[rows]))

    @once
    def turning(self) -> Bool[np.ndarray, " P"]:
        """Which pieces turn, of known numbers."""
        # (A fifth of the time of `any` along rows.)
        return np.abs(self.terms) @ np.ones(self.terms.shape[1]) != 0.0

    def _motion(self, family) -> Float[AnyArray, " P"]:
        """The combination of `family(pieces) -> (k, 10)` that is the motion of each piece."""
        if (xp := namespace(self.u_end, self.terms)) is not np:
            return xp.sum(family(_EVERY_PIECE) * self.terms, axis=1)
        # Most pieces of a plan stand.
        rows = np.flatnonzero(self.turning())
        return placed((self.piece_count,), (rows, np.sum(family(rows) * self.terms[rows], axis=1)))

    def divided(self, pieces: Int[np.ndarray, " n"], at: Float[np.ndarray, " n"]) -> tuple["Trajectory", np.ndarray]:
        """The same trajectory with `pieces` divided at the fractions `at`, and the former number of each of its pieces.

        A piece with two divisions is named twice.
        """
        number = np.concatenate([np.arange(self.piece_count), pieces])
        place = np.concatenate([np.zeros(self.piece_count), at])
        order = np.lexsort((place, number))
        source, v0 = number[order], place[order]
        last = np.diff(source, append=-1) != 0
        v1 = np.where(last, 1.0, np.append(v0[1:], 1.0))
        since, width = v0 * self.duration[source], (self.u_end - self.u_start)[source]
        u_start = self.u_start[source]
        changes = {name: getattr(self, name)[source] for name in _OF_PIECES} | {
            "start": self.start[source] + since,
            "duration": (v1 - v0) * self.duration[source],
            "u_start": u_start + width * v0,
            "u_end": u_start + width * v1,
            "level": self.level[source] + self.slope[source] * since,
            "excess": self.excess[source] * namespace(since).exp(-self.lag_rate * since),
            "read": self.read[source] & last,
            "at_rest": self.at_rest[source] & (last | ~self.moving[source]),
        }
        varying = np.flatnonzero(np.isin(source, self.varying_pieces))
        return replace(self, **changes, varying_pieces=varying), source


_SINGLE = ("varying_pieces", "lag_rate", "rates", "points", "lagged")
_OF_PIECES = tuple(f.name for f in fields(Trajectory) if f.name not in _SINGLE)


def held(
    start: Float[np.ndarray, " P"],
    duration: Float[np.ndarray, " P"],
    rate: Float[np.ndarray, " P"],
    temperature: Float[np.ndarray, " P"],
    temperature_end: Float[np.ndarray, " P"],
    *,
    read: Bool[np.ndarray, " P"],
    at_rest: Bool[np.ndarray, " P"],
    moving: Bool[np.ndarray, " P"],
    gap: Bool[np.ndarray, " P"],
    rates: bool = False,
    points: Literal["one run", "independent"] = "one run",
) -> Trajectory:
    """A trajectory of constant rates (rad/s) and linear temperatures (°C), the mean motion of a log's pieces."""
    count = len(duration)
    none = np.zeros(count)
    slope = np.where(duration > 0.0, (temperature_end - temperature) / np.where(duration > 0.0, duration, 1.0), 0.0)
    return Trajectory(
        start, duration, none, np.ones(count), rate[:, None] * np.array([formulas.CONSTANT]), np.ones(count),
        temperature, slope, none, np.zeros(()), read, at_rest, moving, gap, np.arange(count),
        np.zeros(0, int), rates, points,
    )  # fmt: skip


@lru_cache(maxsize=64)
def quadrature(nodes: int) -> tuple[np.ndarray, np.ndarray]:
    """Gauss–Legendre nodes and weights on [0, 1], in shared read-only arrays."""
    x, w = np.polynomial.legendre.leggauss(nodes)
    x, w = (x + 1.0) / 2.0, w / 2.0
    x.flags.writeable = w.flags.writeable = False
    return x, w
