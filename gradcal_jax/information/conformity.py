"""Conformity with a limit and the risk of a false decision: JCGM 106:2012, for normal errors about zero.

Symbols: `T` the limit (the tolerance interval is −T … T), `A` the acceptance limit, `y` a measured value with standard
uncertainty `u`, `s` the standard deviation of the errors before that measurement (the prior).

* *Specific risk* (9.3.2, 7.2): the probability that the error exceeds ±T, given its estimate y and its u.
* *Guard band* (8.3): accepting within ±A, A < T, so that an accepted value's specific risk stays below a chosen one.
* *Global risks* (9.5.3): before the measurement, the probability that an error beyond ±T is accepted (consumer's risk),
  and that one within is rejected (producer's risk),

      R_C = ∫_{|e| > T} F(e) g(e) de,   R_P = ∫_{|e| ≤ T} (1 − F(e)) g(e) de,   F(e) = Φ((A − e)/u) − Φ((−A − e)/u)

  with g the normal density of standard deviation s. Both integrands are smooth but for steps of width u at ±A, so
  Gauss–Legendre between places set by T, A, u and s is exact to rounding.
"""

from collections.abc import Callable
from math import erfc, sqrt
from statistics import NormalDist
from typing import NamedTuple

import numpy as np
from jaxtyping import Float

# Standard deviations beyond which lies 1e-23 of a normal distribution.
_FAR = 10.0
# Number of errors drawn together, and the share of the largest principal direction below which one is left out.
_BATCH, _NEGLIGIBLE = 500, 1e-9
_NODES, _WEIGHTS = np.polynomial.legendre.leggauss(24)


def _beyond(z: float) -> float:
    """Probability of a standard normal value above z."""
    return 0.5 * erfc(z / sqrt(2.0))


def specific_risk(y: float, u: float, limit: float) -> float:
    """Probability that an error with estimate `y` and standard uncertainty `u` lies beyond ±`limit`."""
    if u == 0.0:
        return float(abs(y) > limit)
    return _beyond((limit - y) / u) + _beyond((limit + y) / u)


def coverage_of_risk(risk: float) -> float:
    """Number of standard deviations that the magnitude of an error about zero exceeds with probability `risk`."""
    return NormalDist().inv_cdf(1.0 - 0.5 * risk)


def acceptance_limit(u: float, limit: float, risk: float) -> float | None:
    """The largest |y| whose specific risk is at most `risk`; None where even zero has more."""
    if specific_risk(0.0, u, limit) > risk:
        return None
    low, high = 0.0, limit + _FAR * u
    for _ in range(200):
        middle = 0.5 * (low + high)
        low, high = (middle, high) if specific_risk(middle, u, limit) <= risk else (low, middle)
    return low


class GlobalRisks(NamedTuple):
    """Probabilities before a measurement: acceptance, false acceptance (consumer's), false rejection (producer's)."""

    accepted: float
    false_accept: float
    false_reject: float


def global_risks(s: float, u: float, limit: float, acceptance: float) -> GlobalRisks:
    """Risks for errors of standard deviation `s`, measured to `u`: accepted within ±`acceptance`, limit ±`limit`.

    All four in one unit. Errors: `ValueError` unless `s` and `u` are positive.
    """
    if not (s > 0.0 and u > 0.0):
        raise ValueError(
            "for risks, the spread of the errors and the uncertainty of the measurement must both be positive"
        )
    # By symmetry one half suffices. Edges at steps of u about the acceptance limit and of s from zero.
    ends = {0.0, limit, *(k * s for k in (0.5, 1, 2, 3, 4, 6, 8)), *(acceptance + k * u for k in range(-10, 11, 2))}
    far = _FAR * s
    edges = np.array(sorted(end for end in ends | {far} if 0.0 <= end <= far))
    half = 0.5 * np.diff(edges)[:, None]
    errors = (0.5 * (edges[1:] + edges[:-1])[:, None] + half * _NODES).ravel()
    weights = 2.0 * (half * _WEIGHTS).ravel() * np.exp(-0.5 * (errors / s) ** 2) / (s * sqrt(2.0 * np.pi))
    accepting = np.array([_beyond((e - acceptance) / u) - _beyond((e + acceptance) / u) for e in errors])
    outside = errors > limit
    return GlobalRisks(
        float(np.sum(weights * accepting)),
        float(np.sum((weights * accepting)[outside])),
        float(np.sum((weights * (1.0 - accepting))[~outside])),
    )


def chance_of_keeping(
    root: Float[np.ndarray, "m s T w r"],
    statistic: Callable[[Float[np.ndarray, "m T w d"]], Float[np.ndarray, " d"]],
    limit: float,
    draws: int = 4000,
) -> tuple[float, float]:
    """Share of sensors whose error after a calibration is within `limit`: by a statistic of the magnitudes, and at
    every place.

    `root`: of the errors' covariance over m quantities in s states, of which the worst counts, at places T × w. Errors
    are drawn (binomial standard error 0.5 % and less) along its principal directions, so that a result does not depend
    on the parameters behind it.
    """
    shape, (left, sizes, _) = root.shape[:-1], np.linalg.svd(root.reshape(-1, root.shape[-1]), full_matrices=False)
    left = left[:, sizes > _NEGLIGIBLE * sizes[0]] * sizes[sizes > _NEGLIGIBLE * sizes[0]]
    largest = np.argmax(np.abs(left), axis=0)
    left = left * np.sign(left[largest, np.arange(left.shape[1])])
    rng, kept = np.random.default_rng(0), np.zeros(2)
    for _ in range(0, draws, _BATCH):
        errors = np.abs(left @ rng.standard_normal((left.shape[1], _BATCH))).reshape(*shape, _BATCH).max(axis=1)
        kept += np.count_nonzero(statistic(errors) <= limit), np.count_nonzero(errors.max(axis=(0, 1, 2)) <= limit)
    shares = kept / (_BATCH * -(-draws // _BATCH))
    return float(shares[0]), float(shares[1])
