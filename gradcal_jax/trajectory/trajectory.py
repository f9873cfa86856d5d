"""The trajectory: a plan written out as smooth pieces of one channel, with a reading at the end of some of them.

Symbols: `P` pieces in order of time. Within piece `k`, at the fraction `v ∈ [0, 1]` of its duration,

    u = u_start + (u_end − u_start)·v,   ω = terms_k · f(u)            (f: the motion family of `formulas`)
    T = level_k + slope_k·t + excess_k·exp(−lag_rate·t),  t = v·duration_k

Times in s, rates in rad/s, temperatures in °C. What moves one axis is rest for the others, so each sensor axis has a
trajectory of its own.
"""

from typing import Any, Literal

import equinox as eqx
import numpy as np
from jaxtyping import Bool, Float, Int

from gradcal_jax import formulas
from gradcal_jax.arrays import AnyArray, namespace

Everything = slice(None)


class Trajectory(eqx.Module):
    """Pieces of one channel. Fields of shape `(P,)` unless said; see the module's head for the symbols.

    `read`: a reading at the end of the piece, which stands for `share` of them; `at_rest`: the axis stands then;
    `moving`: the rate is not zero throughout; `gap`: its data are not used, and the origin is read anew at its end;
    `segment` counts the moves. `moving_pieces` and, of them, `varying_pieces` (the rate is not constant) list
    pieces. `has_gaps`, `rates`, `points`: see `schedule.Schedule`.
    """

    start: Float[AnyArray, " P"]
    duration: Float[AnyArray, " P"]
    u_start: Float[AnyArray, " P"]
    u_end: Float[AnyArray, " P"]
    terms: Float[AnyArray, "P 10"]
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
    moving_pieces: Int[AnyArray, " K"]
    varying_pieces: Int[AnyArray, " V"]
    has_gaps: bool = eqx.field(static=True, default=False)
    rates: bool = eqx.field(static=True, default=False)
    points: Literal["one run", "independent"] = eqx.field(static=True, default="one run")

    @property
    def piece_count(self) -> int:
        return self.duration.shape[0]

    def rate(self, v: Float[AnyArray, "k q"], pieces: Any = Everything) -> Float[AnyArray, "k q"]:
        """Rate (rad/s) at fractions `v` of each piece, or of each of the `k` given ones."""
        u_start, u_end = self.u_start[pieces][:, None], self.u_end[pieces][:, None]
        family = formulas.motion_rate(u_start + (u_end - u_start) * v)
        return (family @ self.terms[pieces][:, :, None])[..., 0]

    def angle(self, v: Float[AnyArray, "k q"], pieces: Any = Everything) -> Float[AnyArray, "k q"]:
        """Angle (rad) turned since the piece began, at fractions `v` of each piece, or of each of the `k` given."""
        u_start = self.u_start[pieces][:, None]
        span = self.u_end[pieces][:, None] - u_start
        family = formulas.motion_angle(u_start + span * v) - formulas.motion_angle(u_start)
        xp = namespace(family, self.terms)
        shares = self.duration[pieces][:, None] / xp.where(span > 0.0, span, 1.0)
        return (family @ self.terms[pieces][:, :, None])[..., 0] * shares

    def temperature(self, v: Float[AnyArray, "k q"], pieces: Any = Everything) -> Float[AnyArray, "k q"]:
        """Sensor temperature (°C) at fractions `v` of each piece, or of each of the `k` given ones."""
        since, level, slope, excess = (f[pieces][:, None] for f in (self.duration, self.level, self.slope, self.excess))
        return formulas.lagged_temperature(v * since, level, slope, excess, self.lag_rate)

    def ends(self) -> tuple[Float[AnyArray, " P"], Float[AnyArray, " P"]]:
        """Sensor temperature (°C) as each piece begins and ends."""
        xp = namespace(self.duration, self.level)
        both = self.temperature(xp.broadcast_to(xp.asarray([0.0, 1.0]), (self.piece_count, 2)))
        return both[:, 0], both[:, 1]

    def turned(self) -> Float[AnyArray, " P"]:
        """Angle (rad) that each piece turns, closed form."""
        xp = namespace(self.u_end, self.terms)
        span = self.u_end - self.u_start
        family = formulas.motion_angle(self.u_end) - formulas.motion_angle(self.u_start)
        return xp.sum(family * self.terms, axis=1) * self.duration / xp.where(span > 0.0, span, 1.0)

    def end_rate(self) -> Float[AnyArray, " P"]:
        """Rate (rad/s) at the end of each piece."""
        xp = namespace(self.u_end, self.terms)
        return xp.sum(formulas.motion_rate(self.u_end) * self.terms, axis=1)


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
    """A trajectory of held rates (rad/s) while the temperature (°C) runs straight: what a log's pieces were, on the
    whole.
    """
    count = len(duration)
    none = np.zeros(count)
    slope = np.where(duration > 0.0, (temperature_end - temperature) / np.where(duration > 0.0, duration, 1.0), 0.0)
    return Trajectory(
        start, duration, none, np.ones(count), rate[:, None] * np.array([formulas.CONSTANT]), np.ones(count),
        temperature, slope, none, np.zeros(()), read, at_rest, moving, gap, np.arange(count), np.flatnonzero(moving),
        np.zeros(0, int), bool(gap.any()), rates, points,
    )  # fmt: skip


def quadrature(nodes: int) -> tuple[np.ndarray, np.ndarray]:
    """Gauss–Legendre nodes and weights on [0, 1]."""
    x, w = np.polynomial.legendre.leggauss(nodes)
    return (x + 1.0) / 2.0, w / 2.0
