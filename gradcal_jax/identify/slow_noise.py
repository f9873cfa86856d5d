"""Estimates bias instability and slow drift from a record at rest, to which a map over temperature is fitted too.

A map of bias over temperature, fitted while the sensor warms up once, absorbs the slowest part of the noise, so that
the residuals underestimate it. The restricted likelihood uses contrasts that are independent of the map's parameters,
`z = Qᵀy`, Q the complement of the map's columns `Φ`,

    y = Φβ + slow noise + white noise,    z ~ N(0, Qᵀ(W + B² F + σ² G)Q)

    y  mean rates of bins;  W = N²/(time in the bin) on the diagonal
    F  of 1/f noise of B = 1 (IEEE 952: S = B²/2πf): Markov processes a constant ratio of τ apart, each of the variance
       Δ(ln τ)/π, from the length of a bin to a third of the record's
    G  of one Markov process whose correlation time is the record's length: a rate random walk of K² = 2σ²/τ inside it,
       which has a level of its own

B and σ are estimated from few contrasts, and their uncertainty dominates the map's error. So the result is not the most
probable pair but the mean of B² and σ² over their posterior (flat in B and σ): the map's covariance is linear in both
except for its weights. For simulated drifts from a minute to random walks 90 to 100 of 100 intervals of 95 % contain
the map (`tests/estimation/test_warm_up.py`); for drifts much faster than the record the standard error is up to five
times too large.

Source: H. D. Patterson and R. Thompson, "Recovery of inter-block information when block sizes are unequal", Biometrika
58 (1971) 545.
"""

from typing import NamedTuple

import numpy as np
from jaxtyping import Float

_FLICKER = 5
_LONGEST_SHARE = 0.3
_DIRECTIONS, _SIZES = 9, 80
# Largest size in the posterior, relative to that of the contrasts without white noise.
_FARTHEST = 3.0


class SlowNoise(NamedTuple):
    """Slow noise of one channel, SI."""

    bias_instability: float
    """Bias instability B, rad/s."""
    drift_std: float
    """Standard deviation σ of the drift whose correlation time is the length of the record, rad/s."""
    processes: tuple[tuple[float, float], ...]
    """(σ rad/s, τ s) of the Markov processes whose sum is the slow noise: first those of B, then the drift."""


def slow_noise(
    centre_s: Float[np.ndarray, " bins"],
    held_s: Float[np.ndarray, " bins"],
    mean_rate: Float[np.ndarray, " bins"],
    columns: Float[np.ndarray, "bins p"],
    angle_random_walk: float,
    *,
    width_s: float,
) -> SlowNoise:
    """B and σ in the presence of a map.

    **Arguments:** means of the rate (rad/s) over bins about `centre_s` that are `width_s` long and contain `held_s`
    of data each; `columns`: the map's functions there; N, rad/√s, above zero.

    **Raises:** `ValueError` for fewer than twice as many bins as columns, and without white noise.
    """
    bins, p = columns.shape
    if bins < 2 * p + 8:
        raise ValueError(
            f"{bins} bins of data at rest are too few to separate the noise from {p} functions of temperature"
        )
    if not 0 < angle_random_walk < np.inf:
        raise ValueError(f"the angle random walk must be above zero, and this one is {angle_random_walk}")
    length = float(np.ptp(centre_s)) + width_s
    times = np.geomspace(width_s, _LONGEST_SHARE * length, _FLICKER)
    share = float(np.log(times[-1] / times[0])) / (_FLICKER - 1) / np.pi
    white = angle_random_walk / np.sqrt(held_s)
    flicker = share * sum(_markov(centre_s, width_s, float(tau)) for tau in times)
    drift = _markov(centre_s, width_s, length)
    # In units of the white noise of each bin.
    both = white[:, None] * white[None]
    complement = np.linalg.qr(columns / white[:, None], mode="complete")[0][:, p:]
    data = mean_rate / white
    angles = np.linspace(0.0, np.pi / 2, _DIRECTIONS)
    weight, squares = [], []
    for angle in angles.tolist():
        ours = (np.cos(angle) ** 2 * flicker + np.sin(angle) ** 2 * drift) / both
        spread, turn = np.linalg.eigh(complement.T @ ours @ complement)
        spread, power = np.maximum(spread, 0.0), ((complement @ turn).T @ data) ** 2
        telling = spread > 1e-12 * spread[-1]
        farthest = _FARTHEST * float(np.sqrt(np.mean(power[telling] / spread[telling])))
        # Denser towards zero: (k/n)², whose step grows with k.
        step = np.arange(1, _SIZES + 1) / _SIZES
        size = farthest * step**2
        variance = 1.0 + size[:, None] ** 2 * spread
        weight.append(-0.5 * np.sum(np.log(variance) + power / variance, axis=1) + np.log(size * farthest * step))
        squares.append(size**2)
    logs = np.array(weight)
    probable = np.exp(logs - logs.max())
    probable[[0, -1]] *= 0.5  # trapezoids over the directions
    mean = np.sum(probable * np.array(squares), axis=1) / probable.sum()
    instability, std = (float(np.sqrt(f(angles) ** 2 @ mean)) for f in (np.cos, np.sin))
    each = instability * float(np.sqrt(share))
    return SlowNoise(instability, std, (*((each, tau) for tau in times.tolist()), (std, length)))


def _markov(centre: Float[np.ndarray, " bins"], width: float, tau: float) -> Float[np.ndarray, "bins bins"]:
    """Covariance of the means over bins of a Markov process of variance one."""
    u = width / tau
    matrix = np.exp(-np.abs(centre[:, None] - centre[None]) / tau) * (2.0 * (np.cosh(u) - 1.0) / u**2)
    matrix[np.diag_indices(len(centre))] = 2.0 * (u + np.expm1(-u)) / u**2
    return matrix
