"""The covariance of Allan variances V(τ) under a mixture of quantisation, white noise, 1/f noise and rate random walk.

Source: C. A. Greenhall and W. J. Riley, "Uncertainty of stability variances based on finite differences", PTTI 2003.
Symbols as in `allan`.

Each of the four noises has a generalised autocovariance s(j) of θ (δ_j, -|j|, j² ln|j|, |j|³), from which the
covariance of u at two averaging times follows by summing over the 3 × 3 taps of both differences, and from that, for
Gaussian noise,

    cov[V(τ), V(τ')] = 2/(n n' 4 τ² τ'²) Σ_(i, i') cov[u_i, u'_i']²
"""

from functools import lru_cache

import numpy as np
from jaxtyping import Float, Int

Steps = Int[np.ndarray, " times"]
Squares = Float[np.ndarray, " 4"]
Runs = tuple[tuple[int, int], ...]
"""(length, count) of the unbroken stretches."""
_TAPS = (1.0, -2.0, 1.0)
# Lags of a smooth sum, for each doubling of the distance from a kink.
_PER_OCTAVE = 8
# Reach of the slowly decaying correlation of 1/f noise, relative to the support of the others.
_FLICKER_REACH = 6


def variance_covariance(
    steps: Steps, runs: Runs, interval: float, squares: Squares, rounding: float = 0.0
) -> Float[np.ndarray, "times times"]:
    """Covariance of the Allan variances under a mixture."""
    row, column = np.triu_indices(len(steps))
    pairs = tuple(zip(steps[row].tolist(), steps[column].tolist(), strict=True))
    matrix = np.zeros((len(steps), len(steps)))
    matrix[row, column] = matrix[column, row] = covariances(pairs, runs, interval, squares, rounding)
    return matrix


def covariances(
    pairs: Runs, runs: Runs, interval: float, squares: Squares, rounding: float
) -> Float[np.ndarray, " pairs"]:
    """Of pairs of averaging times (in samples), under the mixture `squares`, Q² … K²."""
    # The scale of each generalised autocovariance follows from E u² = 2τ²·(its Allan variance) at any one m.
    each = squares * np.array([1.0, interval / 2, interval**2 / (2 * np.pi), interval**3 / 12])
    return np.einsum("pkl,k,l->p", _products(pairs, runs, float(f"{rounding:.2g}")), each, each) / interval**4


@lru_cache(maxsize=16)
def _products(pairs: Runs, runs: Runs, rounding: float) -> Float[np.ndarray, "pairs 4 4"]:
    """2 Σ cov[u_i, u'_i']² / (n n' 4 m² m'²) of pairs of averaging times, as a form in the strengths of the noises.

    The forms depend only on the lengths of the record, so they serve every mixture and every record of these lengths.
    """
    forms = np.zeros((len(pairs), 4, 4))
    reach = max(length for length, _ in runs)
    for form, (short, long) in zip(forms, pairs, strict=True):
        kinks, which = np.unique([b * long - a * short for a in range(3) for b in range(3)], return_inverse=True)
        jumps = np.bincount(which, np.outer(_TAPS, _TAPS).ravel())
        # Between the kinks all is smooth: steps proportional to the distance from the nearest one suffice.
        far = _FLICKER_REACH * 2 * long
        away = np.rint(np.geomspace(1, far, round(_PER_OCTAVE * np.log2(far)))).astype(np.int64)
        lags = np.unique(np.concatenate([kinks, *(kink + side * away for kink in kinks for side in (-1, 1))]))
        lags = lags[np.abs(lags) < reach]
        weight = np.ones(len(lags))
        if len(lags) > 1:
            weight[[0, -1]] = (lags[[1, -1]] - lags[[0, -2]]) / 2 + 0.5
            weight[1:-1] = (lags[2:] - lags[:-2]) / 2
        smooth = _smooth(lags, short, long, rounding)
        form[1:, 1:] = (smooth * (weight * _pairs(lags, short, long, runs))) @ smooth.T
        inside = np.abs(kinks) < reach
        weight = _pairs(kinks[inside], short, long, runs) * jumps[inside]
        form[0, 0] = weight @ jumps[inside]
        form[0, 1:] = form[1:, 0] = _smooth(kinks[inside], short, long, rounding) @ weight
        count, other = (sum(max(n - 2 * m + 1, 0) * times for n, times in runs) for m in (short, long))
        form *= 2 / (count * other * 4 * float(short * long) ** 2)
    return forms


def _smooth(lags: Int[np.ndarray, " lags"], short: int, long: int, rounding: float) -> Float[np.ndarray, "3 lags"]:
    """cov[u_i, u'_(i - lag)] of unit generalised autocovariances: random walk, flicker, rate random walk."""
    total = np.zeros((3, len(lags)))
    for a, tap in enumerate(_TAPS):
        for b, other in enumerate(_TAPS):
            j = np.abs(lags + float(a * short - b * long))
            square = j * j
            each = (-np.hypot(j, rounding) if rounding > 0 else -j, square * np.log(np.maximum(j, 1.0)), square * j)
            total += tap * other * np.stack(each)
    return total


def _pairs(lags: Int[np.ndarray, " lags"], short: int, long: int, runs: Runs) -> Float[np.ndarray, " lags"]:
    """Number of pairs (i, i') of differences within one stretch with i - i' = lag."""
    total = np.zeros(len(lags))
    for length, times in runs:
        count, other = length - 2 * short + 1, length - 2 * long + 1
        if count > 0 and other > 0:
            total += times * np.maximum(np.minimum(count, other + lags) - np.maximum(lags, 0), 0)
    return total
