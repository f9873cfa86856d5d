"""What the calibrations of several IMUs show about their type: a hierarchical model of a map.

    x_i ~ N(μ, S + C_i),        i = 1 … n

`x_i` `(q,)` are the coefficients of IMU i in functions whose mean square over the calibrated range is the square of the
coefficients' norm, `C_i` `(q, q)` the covariance of its own calibration, which is known, and S the spread of the type.

* μ and S maximise the restricted likelihood, which does not count the mean as known (Harville 1977).
* k shapes: `x_i = μ + U z_i` with `U` `(q, k)`, common to all, and free amplitudes `z_i`. The least sum of squares
  weighted by `C_i⁻¹` is a weighted low-rank approximation (Srebro and Jaakkola 2003). What is left has
  `(n − k − 1)(q − k)` degrees of freedom: nq values, less the affine subspace's `(k + 1)(q − k)` and nk amplitudes.
* A stranger is an IMU that the others do not predict: Hotelling's T² of its amplitudes, whose spread is estimated from
  `n − 1` others, and χ² of what their shapes leave of it.
* Groups: the sum of squares against that within two groups, along the line that separates them best, compared with the
  same of samples drawn from the fitted model.
"""

from typing import Any, Final, NamedTuple

import numpy as np
from numpy.typing import NDArray
from scipy.optimize import minimize
from scipy.stats import chi2, f, norm, t

Floats = NDArray[np.floating[Any]]

LEVEL: Final = 0.01
"""Significance level of the tests for the number of shapes, for outliers and for groups."""
COVERAGE: Final = 0.95
"""Probability that each stated interval contains the true value."""
FEW: Final = 6
"""With fewer IMUs than this, nothing is stated about outliers, groups and the next IMU."""

ENOUGH: Final = 5
"""With fewer degrees of freedom than this, it cannot be shown that shapes repeat."""
NORMAL: Final = float(norm.ppf(0.5 + 0.5 * COVERAGE))
"""Half the width of such an interval for a normal error, in standard deviations."""

_ROUNDS, _SETTLED, _REFITTED = 300, 1e-9, 30
_SIMULATIONS, _AT_ONCE, _ENOUGH = 40_000, 500, 20
_LARGEST = 1e6
_HALVINGS = 60


class Spread(NamedTuple):
    """`mean` `(q,)` with its `mean_covariance` `(q, q)`, and the type's `covariance` `(q, q)`."""

    mean: Floats
    mean_covariance: Floats
    covariance: Floats


class ShapeCount(NamedTuple):
    """A test of so many `shapes`: χ² of what they leave, its degrees of freedom, and the chance of as much or more."""

    shapes: int
    chi_squared: float
    degrees: int
    chance: float


class LowRank(NamedTuple):
    """`mean` `(q,)`, orthonormal `shapes` `(q, k)`, the `amplitudes` `(n, k)` of the IMUs with their covariances
    `noise` `(n, k, k)`, and what is left of each, `chi_squared` `(n,)`."""

    mean: Floats
    shapes: Floats
    amplitudes: Floats
    noise: Floats
    chi_squared: Floats


class Groups(NamedTuple):
    """`members` `(n,)`: number of the group of each IMU; `chance` of a split as clear, if there is one group."""

    members: NDArray[np.int64]
    chance: float


def restricted_likelihood(values: Floats, covariances: Floats) -> Spread:
    """Mean and spread of `values` `(n, q)` with `covariances` `(n, q, q)`, by restricted maximum likelihood.

    Errors: `ValueError` for fewer than two values.
    """
    count, size = values.shape
    if count < 2:
        raise ValueError(f"a spread needs two or more calibrations, and there are {count}")
    unit = np.sqrt(np.mean((values - values.mean(axis=0)) ** 2 + np.einsum("ijj->ij", covariances)) + 1e-300)
    x, own = values / unit, covariances / unit**2

    def parts(root: Floats) -> tuple[Floats, Floats, Floats, Floats]:
        inverse = np.linalg.inv(root @ root.T + own)
        known = np.linalg.inv(inverse.sum(axis=0))
        mean = known @ np.einsum("ijk,ik->j", inverse, x)
        return inverse, known, mean, np.einsum("ijk,ik->ij", inverse, x - mean)

    def minus_log(flat: Floats) -> tuple[float, Floats]:
        root = flat.reshape(size, size)
        inverse, known, mean, weighted = parts(root)
        logs = -np.linalg.slogdet(inverse)[1].sum() - np.linalg.slogdet(known)[1]
        slope = inverse.sum(axis=0) - weighted.T @ weighted - np.einsum("ijk,kl,ilm->jm", inverse, known, inverse)
        return 0.5 * float(logs + np.sum(weighted * (x - mean))), (slope @ root).ravel()

    moments = np.cov(x.T).reshape(size, size) - own.mean(axis=0)
    # No direction starts at zero, which is a stationary point.
    start = _root(_positive(moments) + 1e-4 * np.eye(size))
    found = minimize(minus_log, start.ravel(), jac=True, method="L-BFGS-B", options={"maxiter": 2000, "ftol": 1e-13})
    root = found.x.reshape(size, size)
    _, known, mean, _ = parts(root)
    return Spread(mean * unit, known * unit**2, root @ root.T * unit**2)


def low_rank(values: Floats, covariances: Floats, count: int, start: LowRank | None = None) -> LowRank:
    """The mean and `count` shapes that leave least of `values` `(n, q)`, weighted by their `covariances` `(n, q, q)`.

    Alternating least squares; `start`: a fit of nearly the same values, from which few rounds are enough.
    """
    size = values.shape[1]
    weights = np.linalg.inv(covariances)
    mean = np.linalg.solve(weights.sum(axis=0), np.einsum("ijk,ik->j", weights, values))
    if start is not None:
        mean, shapes = start.mean, start.shapes
    else:
        # Of equal covariances this is the solution.
        white = _root(weights.mean(axis=0)).T
        directions = np.linalg.svd((values - mean) @ white.T, full_matrices=False)[2][:count]
        shapes = np.linalg.qr(np.linalg.solve(white, directions.T))[0]
    fit, before = _amplitudes(values, weights, mean, shapes), np.inf
    for _ in range(0 if count in (0, size) else _ROUNDS if start is None else _REFITTED):
        if before - (now := float(fit.chi_squared.sum())) <= _SETTLED * (now + 1.0):
            break
        before, amplitudes = now, fit.amplitudes
        factors = np.concatenate([np.ones((len(values), 1)), amplitudes], axis=1)
        width = size * (count + 1)
        normal = np.einsum("ia,ib,iqr->aqbr", factors, factors, weights).reshape(width, width)
        right = np.einsum("ia,iqr,ir->aq", factors, weights, values).ravel()
        solved = np.linalg.lstsq(normal, right, rcond=None)[0].reshape(count + 1, size)
        fit = _amplitudes(values, weights, solved[0], np.linalg.qr(solved[1:].T)[0])
    return fit


def _amplitudes(values: Floats, weights: Floats, mean: Floats, shapes: Floats) -> LowRank:
    """The best amplitudes for a mean and shapes."""
    weighted = np.einsum("qk,iqr->ikr", shapes, weights)
    noise = np.linalg.inv(weighted @ shapes)
    amplitudes = np.einsum("ijk,ikr,ir->ij", noise, weighted, values - mean)
    rest = values - mean - amplitudes @ shapes.T
    return LowRank(mean, shapes, amplitudes, noise, np.einsum("ij,ijk,ik->i", rest, weights, rest))


def count_shapes(values: Floats, covariances: Floats) -> tuple[list[ShapeCount], LowRank | None]:
    """Tests of none, one, two … shapes up to the first that is accepted, and its fit; None if none is, or if what it
    leaves has fewer than `ENOUGH` degrees of freedom.

    A constant, of one coefficient, has but one shape.
    """
    n, q = values.shape
    tests: list[ShapeCount] = []
    for count in range(q):
        if count and (n - count - 1) * (q - count) < ENOUGH:
            break
        fit = low_rank(values, covariances, count)
        left, degrees = float(fit.chi_squared.sum()), (n - count - 1) * (q - count)
        tests.append(ShapeCount(count, left, degrees, float(chi2.sf(left, degrees))))
        if tests[-1].chance >= LEVEL:
            return tests, fit
    return tests, low_rank(values, covariances, 1) if q == 1 else None


def intervals(values: Floats, variances: Floats, spread: Floats) -> tuple[Floats, Floats, Floats]:
    """Of `values` `(n, g)` at g places with their own `variances`: the mean `(g,)`, half its interval, and the
    interval `(2, g)` of the spread's standard deviation; `spread` `(g,)`: its estimated variance.

    The mean's is Student's with the weighted scatter (Hartung and Knapp 2001), the spread's the range of variances
    with which the weighted sum of squares is within its χ² (Viechtbauer 2007): both hold for few IMUs, too.
    """
    n = len(values)
    weights = 1.0 / (spread + variances)
    total = weights.sum(axis=0)
    mean = (weights * values).sum(axis=0) / total
    scatter = (weights * (values - mean) ** 2).sum(axis=0) / (n - 1)
    half = float(t.ppf(0.5 + 0.5 * COVERAGE, n - 1)) * np.sqrt(scatter / total)
    tails = chi2.ppf([0.5 + 0.5 * COVERAGE, 0.5 - 0.5 * COVERAGE], n - 1)
    return mean, half, np.sqrt([_variance_with(values, variances, float(tail)) for tail in tails])


def spread_factor(count: int, tail: float) -> float:
    """Ratio of the true to the sample variance of `count` IMUs that is exceeded with the chance `tail`."""
    return (count - 1) / float(chi2.ppf(tail, count - 1))


def _variance_with(values: Floats, variances: Floats, chi_squared: float) -> Floats:
    """The spread's variance `(g,)` with which the weighted sum of squares is `chi_squared`; 0 where it is smaller."""
    low = np.zeros(values.shape[1])
    high = np.sum((values - values.mean(axis=0)) ** 2, axis=0) / chi_squared * 2.0 + 1e-300
    for _ in range(_HALVINGS):
        middle = 0.5 * (low + high)
        weights = 1.0 / (middle + variances)
        mean = (weights * values).sum(axis=0) / weights.sum(axis=0)
        above = (weights * (values - mean) ** 2).sum(axis=0) > chi_squared
        low, high = np.where(above, middle, low), np.where(above, high, middle)
    return np.where(low > 0.0, high, 0.0)


def strangers(
    values: Floats, covariances: Floats, fit: LowRank | None, *, scaled: bool = False
) -> tuple[Floats, Floats] | None:
    """The chance `(n,)` that an IMU of the type is as far from what all others predict, and χ² `(n,)` of what the
    shapes leave of these; None for too few IMUs.

    `fit`: its shapes are refitted without the IMU; None: no shape repeats, and all coefficients count. `scaled`: what
    the shapes leave of the others is the measure of what they leave of the IMU, where it is more than their noise.
    """
    n, q = values.shape
    count = q if fit is None else fit.shapes.shape[1]
    if n < max(FEW, count + 4):
        return None
    chances, left = zip(*(_stranger(values, covariances, fit, i, scaled) for i in range(n)), strict=True)
    return np.array(chances), np.array(left)


def _stranger(values: Floats, covariances: Floats, fit: LowRank | None, i: int, scaled: bool) -> tuple[float, float]:
    n, q = values.shape
    others = np.delete(np.arange(n), i)
    left = 0.0
    if fit is None:
        mean, shapes = np.zeros(q), np.eye(q)
        amplitudes, noise = values[others], covariances[others]
    else:
        refitted = low_rank(values[others], covariances[others], fit.shapes.shape[1], fit)
        mean, shapes, amplitudes, noise, _ = refitted
        left = float(refitted.chi_squared.sum())
    count = shapes.shape[1]
    weight = np.linalg.inv(covariances[i])
    own_noise = np.linalg.inv(shapes.T @ weight @ shapes)
    amplitude = own_noise @ shapes.T @ weight @ (values[i] - mean)
    rest = values[i] - mean - shapes @ amplitude
    chances: list[float] = []
    leverage = 1.0 / len(others)
    if count:
        apart = amplitude - amplitudes.mean(axis=0)
        sample = np.cov(amplitudes.T).reshape(count, count)
        leverage += float(apart @ np.linalg.solve(sample * (len(others) - 1), apart))
        predicted = _positive(sample - noise.mean(axis=0)) + own_noise
        squared = float(apart @ np.linalg.solve(predicted, apart)) / (1.0 + 1.0 / len(others))
        # The estimated part of the prediction has n - 2 degrees of freedom, and the IMU's own noise is known.
        estimated = np.linalg.eigvals(np.linalg.solve(predicted, sample)).real
        freedom = max((len(others) - 1) / float(np.mean(estimated**2)), len(others) - 1.0)
        last = freedom - count + 1.0
        chances.append(float(f.sf(squared * last / (freedom * count), count, last)))
    if count < q:
        # Mean and shapes are as uncertain as the others' calibrations, by their weights.
        together = np.linalg.inv(np.linalg.inv(covariances[others]).mean(axis=0))
        ratio = float(np.trace(together @ weight)) / q
        squared, degrees = rest @ weight @ rest / (1.0 + leverage * ratio), (len(others) - count - 1) * (q - count)
        scale = max(left / degrees, 1.0) * (q - count)
        chances.append(float(f.sf(squared / scale, q - count, degrees) if scaled else chi2.sf(squared, q - count)))
    return float(1.0 - (1.0 - min(chances)) ** len(chances)), left


def groups(values: Floats, covariances: Floats, spread: Spread, seed: int = 0, tests: int = 1) -> Groups | None:
    """The split of the IMUs into groups, if the chance of one as clear is below `LEVEL / tests`; groups are split
    again. None: there is one group."""
    least = max(3, len(values) // 10)
    if len(values) < 2 * least or len(values) < FEW:
        return None
    statistic, right = _clearest_split(values[None], least)
    seen = float(statistic[0])
    rng, more, drawn = np.random.default_rng(seed), 0, 0
    roots = np.stack([_root(spread.covariance + own) for own in covariances])
    # Enough to tell a chance of the level.
    wanted = int(min(max(_ENOUGH * tests / LEVEL, 1000), _SIMULATIONS))
    while drawn < wanted and more < _ENOUGH:
        sample = np.einsum("ijk,sik->sij", roots, rng.standard_normal((_AT_ONCE, *values.shape)))
        more += int(np.count_nonzero(_clearest_split(sample, least)[0] >= seen))
        drawn += _AT_ONCE
    chance = (more + 1) / (drawn + 1)
    if chance >= LEVEL / tests:
        return None
    members = right[0].astype(np.int64)
    for part in (0, 1):
        own = np.flatnonzero(members == part)
        if len(own) >= FEW:
            within = restricted_likelihood(values[own], covariances[own])
            inner = groups(values[own], covariances[own], within, seed + 1, tests)
            if inner is not None:
                members[own] = np.where(inner.members == 0, part, members.max() + inner.members)
    return Groups(members, chance)


def _clearest_split(samples: Floats, least: int) -> tuple[Floats, NDArray[np.bool_]]:
    """Of samples `(s, n, q)`: the largest ratio of the sum of squares to that within two groups of `least` or more
    along a line, `(s,)`, and which are in the second group, `(s, n)`.

    The lines are the principal directions of the sample, no more than a fifth of its size and three, and Fisher's
    discriminants of the best splits along these.
    """
    n = samples.shape[1]
    centred = samples - samples.mean(axis=1, keepdims=True)
    directions = np.linalg.eigh(np.einsum("sij,sik->sjk", centred, centred))[1][:, :, ::-1]
    scores = centred @ directions[:, :, : min(3, max(1, n // 5))]
    best, members = np.zeros(len(samples)), np.zeros(samples.shape[:2], dtype=bool)
    for k in range(scores.shape[2]):
        line = np.eye(scores.shape[2])[:, k : k + 1]
        for _ in range(3):
            ratio, second = _split_along((scores @ line)[:, :, 0], least)
            better = ratio > best
            best, members = np.where(better, ratio, best), np.where(better[:, None], second, members)
            share = second.mean(axis=1)[:, None]
            apart = np.einsum("sn,snd->sd", second / share - (~second) / (1.0 - share), scores) / n
            within = scores - (second - share)[:, :, None] * apart[:, None, :]
            scatter = np.einsum("snd,sne->sde", within, within)
            scatter += np.einsum("sdd->s", scatter)[:, None, None] / _LARGEST * np.eye(scatter.shape[1])
            line = np.linalg.solve(scatter, apart[:, :, None])
    return best, members


def _split_along(scores: Floats, least: int) -> tuple[Floats, NDArray[np.bool_]]:
    """The best split of `scores` `(s, n)` along a line: as `_clearest_split`."""
    n = scores.shape[1]
    order = np.argsort(scores, axis=1)
    rising = np.take_along_axis(scores, order, axis=1)
    rising = rising - rising.mean(axis=1, keepdims=True)
    below = np.arange(1, n)
    between = np.cumsum(rising, axis=1)[:, :-1] ** 2 * (1.0 / below + 1.0 / (n - below))
    between = np.where((below < least) | (n - below < least), 0.0, between)
    total = np.sum(rising**2, axis=1) + 1e-300
    place = np.argmax(between, axis=1)
    ratio = total / np.maximum(total - np.max(between, axis=1), total / _LARGEST)
    return ratio, np.argsort(order, axis=1) > place[:, None]


def rest_bound(fit: LowRank, values: Floats, covariances: Floats) -> float:
    """The largest standard deviation of each coefficient beyond the shapes with which what they leave is not too
    small, at 95 %, and at least that of the expected χ²; 0 where the shapes leave nothing by their number."""
    n, q = values.shape
    count = fit.shapes.shape[1]
    if (degrees := (n - count - 1) * (q - count)) <= 0:
        return 0.0
    rest, low = values - fit.mean, 0.0

    def left(variance: float) -> float:
        weights = np.linalg.inv(covariances + variance * np.eye(q))
        seen = np.einsum("qk,iqr->ikr", fit.shapes, weights)
        explained = np.einsum("ikr,ir->ik", seen, rest)
        solved = np.linalg.solve(seen @ fit.shapes, explained[..., None])[..., 0] if count else explained
        return float(np.einsum("ij,ijk,ik->", rest, weights, rest) - np.sum(explained * solved))

    least = float(chi2.ppf(1.0 - COVERAGE, degrees)) * min(1.0, left(0.0) / degrees)
    high = float(np.einsum("ijj->", covariances)) / (n * q) + float(np.mean(rest**2))
    while left(high) > least and high < _LARGEST:
        high *= 2.0
    for _ in range(_HALVINGS):
        middle = 0.5 * (low + high)
        low, high = (middle, high) if left(middle) > least else (low, middle)
    return float(np.sqrt(high))


def next_covariance(fit: LowRank, values: Floats, covariances: Floats) -> Floats:
    """Mean square `(q, q)` of the next IMU's coefficients about zero, with what n IMUs leave open: the squared mean,
    the shapes by the spread of their amplitudes, and what may be beyond them."""
    n, q = values.shape
    count = fit.shapes.shape[1]
    around = fit.mean + fit.shapes @ fit.amplitudes.mean(axis=0)
    square = np.outer(around, around) + rest_bound(fit, values, covariances) ** 2 * np.eye(q)
    # Mean and shapes are as uncertain as all calibrations together.
    square = square + (1 + count) * np.linalg.inv(np.linalg.inv(covariances).sum(axis=0))
    if count:
        spread = restricted_likelihood(fit.amplitudes, fit.noise).covariance
        # Variance of Student's t, as of an IMU drawn from a type that n others have shown.
        square = square + fit.shapes @ spread @ fit.shapes.T * (1.0 + 1.0 / n) * (n - 1) / max(n - 3, 1)
    return square


def _positive(matrix: Floats) -> Floats:
    """The nearest matrix without negative eigenvalues."""
    values, vectors = np.linalg.eigh(matrix)
    return (vectors * np.maximum(values, 0.0)) @ vectors.T


def _root(matrix: Floats) -> Floats:
    """A square root of a covariance, which may be singular."""
    values, vectors = np.linalg.eigh(matrix)
    return vectors * np.sqrt(np.maximum(values, 0.0))
