"""Overlapping Allan deviation of a gyro at rest, with confidence, and the noise coefficients behind it.

Sources: IEEE Std 952-1997, annex C (the model and its coefficients); W. J. Riley, "Handbook of Frequency Stability
Analysis", NIST SP 1065 (the estimator); C. A. Greenhall and W. J. Riley, "Uncertainty of stability variances based on
finite differences", PTTI 2003 (generalised autocovariances).

    θ_i             running angle after i samples of τ₀ seconds
    u_i             θ_(i+2m) - 2θ_(i+m) + θ_i, second difference over τ = m τ₀
    V(τ)            mean over i of u_i²/(2τ²): the overlapping Allan variance

    E V(τ) = 3 Q²/τ² + N²/τ + (2 ln 2/π) B² + K² τ/3

    Q  quantisation (rad), white in the angle; N angle random walk (rad/√s); B bias instability (rad/s), 1/f noise;
    K  rate random walk (rad/s/√s)

Each of the four has a generalised autocovariance s(j) of θ (δ_j, -|j|, j² ln|j|, |j|³), from which the covariance of
u at two averaging times follows by summing over the 3 × 3 taps of both differences, and from that, for Gaussian noise,

    cov[V(τ), V(τ')] = 2/(n n' 4 τ² τ'²) Σ_(i, i') cov[u_i, u'_i']²

No table of degrees of freedom by noise type is needed: the mixture that was fitted is the noise type. The fit weighs
each V with its variance under the fitted mixture (iterated), the coefficients are kept from going negative, and their
standard errors come from the full covariance, since overlapping estimates at neighbouring τ are far from independent.
"""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from jaxtyping import Bool, Float, Int
from scipy import optimize, special

from gradcal_jax import formulas

TERMS = ("quantisation", "angle_random_walk", "bias_instability", "rate_random_walk")
_FLICKER = 2.0 * np.log(2.0) / np.pi
# Second differences are summed in pieces that stay in the cache.
_PIECE = 1 << 15
# Averaging times farther apart than this are taken for uncorrelated, and smooth sums take this many steps per τ.
_UNCORRELATED_RATIO = 64
_STEPS = 24
# How many τ the slowly falling correlation of 1/f noise is followed beyond the support of the others.
_FLICKER_REACH = 6


@dataclass(frozen=True)
class AllanDeviation:
    """Overlapping Allan deviation of one channel; see `overlapping_allan`."""

    averaging_time_s: Float[np.ndarray, " times"]
    """τ, whole samples, s."""
    deviation: Float[np.ndarray, " times"]
    """√V, in the unit of the rates (rad/s in this package)."""
    difference_count: Int[np.ndarray, " times"]
    """How many second differences were averaged."""
    sample_interval_s: float
    stretch_lengths: tuple[int, ...]
    """Samples in each unbroken stretch; what the confidence rests on."""


@dataclass(frozen=True)
class Coefficient:
    """An identified noise coefficient, SI, with its standard error."""

    value: float
    standard_error: float
    """One sigma, to first order; where the value is zero, the value that would be one sigma above it."""
    shows: bool
    """Whether its part of the variance is more than two standard errors above nothing."""


@dataclass(frozen=True)
class AllanFit:
    """Noise coefficients of one channel and the confidence in its Allan deviation; see `fit_allan`."""

    quantisation: Coefficient
    """Q, rad."""
    angle_random_walk: Coefficient
    """N, rad/√s."""
    bias_instability: Coefficient
    """B, rad/s; the floor of the curve is 0.664 B."""
    rate_random_walk: Coefficient
    """K, rad/s/√s."""
    averaging_time_s: Float[np.ndarray, " times"]
    model_deviation: Float[np.ndarray, " times"]
    """The fitted model's Allan deviation."""
    degrees_of_freedom: Float[np.ndarray, " times"]
    """Equivalent degrees of freedom of V(τ) under the fitted model."""
    lower: Float[np.ndarray, " times"]
    upper: Float[np.ndarray, " times"]
    """Confidence limits of the true deviation, from the measured one and χ² with those degrees of freedom."""
    confidence: float
    chi_squared: float
    """Σ (V - model)²/var V. The V are correlated: not χ², but many times their number says that the model is bad."""


def averaging_times(samples: int, sample_interval_s: float, *, per_decade: int = 10) -> Float[np.ndarray, " times"]:
    """Whole multiples of the sample interval, evenly spread on a logarithmic scale, up to a third of the record, s."""
    if samples < 3:
        raise ValueError(f"an Allan deviation needs at least 3 samples, not {samples}")
    longest = samples // 3
    count = max(2, round(per_decade * np.log10(longest)) + 1) if longest > 1 else 1
    return np.unique(np.rint(np.geomspace(1, longest, count))) * sample_interval_s


def overlapping_allan(
    rate: Float[np.ndarray, " samples"],
    sample_interval_s: float,
    averaging_times_s: Float[np.ndarray, " times"] | None = None,
    *,
    valid: Bool[np.ndarray, " samples"] | None = None,
) -> AllanDeviation:
    """Overlapping Allan deviation of evenly sampled rates.

    No difference spans a sample that is not `valid`: what was missed cannot be integrated over. Gaps in time are given
    as invalid samples on the even grid. `averaging_times_s` are rounded to whole samples (without them,
    `averaging_times` of the longest stretch); those too long for every stretch are left out.

    **Raises:** `ValueError` where nothing is left, and where a usable rate is not finite.
    """
    usable = np.ones(len(rate), bool) if valid is None else valid
    if usable.shape != rate.shape:
        raise ValueError(f"the mask of usable samples has the shape {usable.shape}, the rates {rate.shape}")
    edges = formulas.runs(usable)
    lengths = tuple((edges[:, 1] - edges[:, 0]).tolist())
    longest = max(lengths, default=0)
    if longest < 2:
        raise ValueError("an Allan deviation needs two usable samples in a row")
    if averaging_times_s is None:
        averaging_times_s = averaging_times(max(longest, 3), sample_interval_s)
    steps = _whole_samples(averaging_times_s, sample_interval_s)
    steps = steps[2 * steps <= longest]
    if len(steps) == 0:
        raise ValueError(
            f"the shortest averaging time is longer than half of {longest * sample_interval_s:g} s of data"
        )
    total, count = np.zeros(len(steps)), np.zeros(len(steps), np.int64)
    for start, stop in edges.tolist():
        if stop - start < 2 * int(steps[0]):
            continue
        angle = np.zeros(stop - start + 1)
        angle[1:] = rate[start:stop]
        mean = angle[1:].mean()
        if not np.isfinite(mean):
            bad = start + int(np.flatnonzero(~np.isfinite(angle[1:]))[0])
            raise ValueError(f"the rate of sample {bad} is not finite: mark such samples as not valid")
        angle[1:] -= mean  # changes no second difference and keeps the sums small
        np.cumsum(angle, out=angle)
        for row, m in enumerate(steps.tolist()):
            if 2 * m <= stop - start:
                total[row] += _sum_of_squares(angle, m)
                count[row] += stop - start - 2 * m + 1
    return AllanDeviation(
        steps * sample_interval_s, np.sqrt(total / (2 * count)) / steps, count, sample_interval_s, lengths
    )


def overlapping_allan_of_angle(
    angle: Float[np.ndarray, " instants"],
    sample_interval_s: float,
    averaging_times_s: Float[np.ndarray, " times"] | None = None,
) -> AllanDeviation:
    """Overlapping Allan deviation of a running angle (rad), where NaN marks an instant that was not read.

    Unlike rates, angles bridge a gap: any three angles give a difference, however many between them are missing. The
    degrees of freedom of a gapped record are those of an unbroken one with as many angles: a little too many.
    """
    read = np.isfinite(angle)
    instants = int(np.count_nonzero(read))
    if instants < 3:
        raise ValueError("an Allan deviation needs at least three angles that were read")
    centred = angle - angle[read].mean()
    if averaging_times_s is None:
        averaging_times_s = averaging_times(max(len(angle) - 1, 3), sample_interval_s)
    steps, deviation, counts = [], [], []
    for m in _whole_samples(averaging_times_s, sample_interval_s).tolist():
        if 2 * m >= len(angle):
            continue
        difference = centred[2 * m :] - 2 * centred[m:-m] + centred[: -2 * m]
        known = np.isfinite(difference)
        if known.any():
            steps.append(m)
            counts.append(int(np.count_nonzero(known)))
            deviation.append(np.sqrt(np.sum(difference[known] ** 2) / (2 * counts[-1])) / (m * sample_interval_s))
    if not steps:
        raise ValueError("no three angles that were read stand at any of the averaging times")
    return AllanDeviation(
        np.array(steps) * sample_interval_s,
        np.array(deviation),
        np.array(counts),
        sample_interval_s,
        (instants - 1,),
    )


def model_variance(
    averaging_time_s: Float[np.ndarray, " times"],
    quantisation: float,
    angle_random_walk: float,
    bias_instability: float,
    rate_random_walk: float,
) -> Float[np.ndarray, " times"]:
    """`3Q²/τ² + N²/τ + (2 ln 2/π) B² + K²τ/3`, (rad/s)²; IEEE Std 952, annex C."""
    squares = np.array([quantisation, angle_random_walk, bias_instability, rate_random_walk]) ** 2
    return _design(averaging_time_s) @ squares


def fit_allan(allan: AllanDeviation, *, terms: Sequence[str] = TERMS, confidence: float = 0.683) -> AllanFit:
    """The coefficients whose model fits an Allan deviation best, with standard errors, and its confidence limits.

    Weighted least squares on the variances, none negative. `terms` says which of `TERMS` the sensor may have; a term
    left out is zero. Deterministic drift (a temperature ramp) passes for rate random walk: take it out first.

    **Raises:** `ValueError` for unknown terms, fewer averaging times than terms, or a confidence outside (0, 1).
    """
    unknown = [term for term in terms if term not in TERMS]
    if unknown or not terms:
        raise ValueError(f"terms are taken from {', '.join(TERMS)}; not {', '.join(unknown) or 'none at all'}")
    if not 0 < confidence < 1:
        raise ValueError(f"a confidence lies between 0 and 1, not {confidence}")
    chosen = np.array([term in terms for term in TERMS])
    tau, variance = allan.averaging_time_s, allan.deviation**2
    if len(tau) < chosen.sum():
        raise ValueError(f"{len(tau)} averaging times do not determine {chosen.sum()} coefficients: record for longer")
    if not np.any(variance > 0):
        raise ValueError("the rate does not change: there is no noise to fit")
    design = _design(tau) * chosen
    steps = np.rint(tau / allan.sample_interval_s).astype(np.int64)
    runs = _alike(allan.stretch_lengths)

    # To begin with every V is as uncertain, relatively, as if its differences were independent over τ.
    expected = np.maximum(variance, variance.max() * 1e-12)
    spread = expected * np.sqrt(2 * steps / allan.difference_count)
    squares = np.zeros(4)
    for _ in range(30):
        previous = squares
        squares = _non_negative(design, variance, spread, chosen)
        expected = design @ squares
        spread = np.sqrt(np.diag(_covariance(steps, runs, allan.sample_interval_s, squares, neighbours=0)))
        if np.allclose(squares, previous, rtol=1e-6, atol=0.0):
            break
    covariance = _covariance(steps, runs, allan.sample_interval_s, squares, neighbours=_UNCORRELATED_RATIO)
    freedom = 2 * expected**2 / spread**2
    tail = (1 - confidence) / 2
    lower = allan.deviation * np.sqrt(freedom / special.chdtri(freedom, tail))
    upper = allan.deviation * np.sqrt(freedom / special.chdtri(freedom, 1 - tail))

    coefficients = []
    for index in range(4):
        # The standard error of a term at zero is what it would have if it were let in beside the others.
        present = (squares > 0) | (np.arange(4) == index)
        if not chosen[index]:
            coefficients.append(Coefficient(0.0, 0.0, False))
            continue
        weighed = design[:, present] / spread[:, None]
        scale = np.linalg.norm(weighed, axis=0)
        gain = np.linalg.pinv(weighed / scale) / scale[:, None] / spread
        place = int(np.count_nonzero(present[:index]))
        error = float(np.sqrt(gain[place] @ covariance @ gain[place]))
        value = float(np.sqrt(squares[index]))
        coefficients.append(
            Coefficient(
                value, error / (2 * value) if value > 0 else float(np.sqrt(error)), bool(squares[index] > 2 * error)
            )
        )
    return AllanFit(
        *coefficients,
        averaging_time_s=tau,
        model_deviation=np.sqrt(expected),
        degrees_of_freedom=freedom,
        lower=lower,
        upper=upper,
        confidence=confidence,
        chi_squared=float(np.sum(((variance - expected) / spread) ** 2)),
    )


def _design(tau: Float[np.ndarray, " times"]) -> Float[np.ndarray, "times 4"]:
    return np.stack([3 / tau**2, 1 / tau, np.full_like(tau, _FLICKER), tau / 3], axis=1)


def _non_negative(
    design: Float[np.ndarray, "times 4"],
    variance: Float[np.ndarray, " times"],
    spread: Float[np.ndarray, " times"],
    chosen: Bool[np.ndarray, " 4"],
) -> Float[np.ndarray, " 4"]:
    weighed = design / spread[:, None]
    scale = np.where(chosen, np.linalg.norm(weighed, axis=0), 1.0)
    solution, _ = optimize.nnls((weighed / scale)[:, chosen], variance / spread)
    squares = np.zeros(4)
    squares[chosen] = solution / scale[chosen]
    return squares


def _alike(stretch_lengths: tuple[int, ...]) -> list[tuple[int, int]]:
    """(length, how many) of the unbroken stretches."""
    lengths, counts = np.unique(np.array(stretch_lengths), return_counts=True)
    return list(zip(lengths.tolist(), counts.tolist(), strict=True))


def _covariance(
    steps: Int[np.ndarray, " times"],
    runs: list[tuple[int, int]],
    interval: float,
    squares: Float[np.ndarray, " 4"],
    *,
    neighbours: int,
) -> Float[np.ndarray, "times times"]:
    """Covariance of the Allan variances under a mixture, for averaging times whose ratio is up to `neighbours`."""
    size = len(steps)
    matrix = np.zeros((size, size))
    for row in range(size):
        for column in range(row, size):
            if row == column or steps[column] <= neighbours * steps[row]:
                value = _covariance_of_two(int(steps[row]), int(steps[column]), runs, interval, squares)
                matrix[row, column] = matrix[column, row] = value
    return matrix


def _covariance_of_two(
    short: int, long: int, runs: list[tuple[int, int]], interval: float, squares: Float[np.ndarray, " 4"]
) -> float:
    """cov[V(τ), V(τ')]; the smooth part of the sum over lags by steps, the jumps of white angle noise one by one."""
    reach = max(length for length, _ in runs)
    tail = _FLICKER_REACH * long if squares[2] > 0 else 0
    first, last = -min(2 * short + tail, reach), min(2 * long + tail, reach)
    stride = max(1, short // _STEPS)
    # The grid holds lag zero, where a step would otherwise miss the crest.
    lags = np.arange(first - first % stride, last + 1, stride)
    smooth = _smooth_covariance(lags.astype(float), short, long, interval, squares)
    total = stride * float(np.sum(_pairs(lags, short, long, runs) * smooth**2))
    if squares[0] > 0:
        jumps: dict[int, float] = {}
        for a, tap in ((0, 1.0), (1, -2.0), (2, 1.0)):
            for b, other in ((0, 1.0), (1, -2.0), (2, 1.0)):
                lag = b * long - a * short
                jumps[lag] = jumps.get(lag, 0.0) + tap * other * squares[0]
        at = np.array(list(jumps))
        height = np.array(list(jumps.values()))
        beside = _smooth_covariance(at.astype(float), short, long, interval, squares)
        total += float(np.sum(_pairs(at, short, long, runs) * (2 * beside * height + height**2)))
    count, other_count = (sum(max(n - 2 * m + 1, 0) * times for n, times in runs) for m in (short, long))
    return 2 * total / (count * other_count * 4 * (short * long * interval**2) ** 2)


def _smooth_covariance(
    lags: Float[np.ndarray, " lags"], short: int, long: int, interval: float, squares: Float[np.ndarray, " 4"]
) -> Float[np.ndarray, " lags"]:
    """cov[u_i, u'_(i - lag)] of all noises but quantisation, rad²."""
    # The scale of each generalised autocovariance follows from E u² = 2τ²·(its Allan variance) at any one m.
    walk, flicker = squares[1] * interval / 2, squares[2] * interval**2 / (2 * np.pi)
    rate_walk = squares[3] * interval**3 / 12
    total = np.zeros_like(lags)
    for a, tap in ((0, 1.0), (1, -2.0), (2, 1.0)):
        for b, other in ((0, 1.0), (1, -2.0), (2, 1.0)):
            j = np.abs(lags + float(a * short - b * long))
            value = -walk * j + rate_walk * j**3
            if flicker > 0:
                value += flicker * j**2 * np.log(np.maximum(j, 1.0))
            total += tap * other * value
    return total


def _pairs(
    lags: Int[np.ndarray, " lags"], short: int, long: int, runs: list[tuple[int, int]]
) -> Float[np.ndarray, " lags"]:
    """How many pairs (i, i') of differences within one stretch have i - i' = lag."""
    total = np.zeros(len(lags))
    for length, times in runs:
        count, other = length - 2 * short + 1, length - 2 * long + 1
        if count > 0 and other > 0:
            total += times * np.maximum(np.minimum(count, other + lags) - np.maximum(lags, 0), 0)
    return total


def _sum_of_squares(angle: Float[np.ndarray, " instants"], m: int) -> float:
    total = 0.0
    differences = len(angle) - 2 * m
    buffer = np.empty(min(_PIECE, differences))
    for first in range(0, differences, _PIECE):
        last = min(first + _PIECE, differences)
        piece = buffer[: last - first]
        np.subtract(angle[first + 2 * m : last + 2 * m], angle[first + m : last + m], out=piece)
        piece -= angle[first + m : last + m]
        piece += angle[first:last]
        total += float(piece @ piece)
    return total


def _whole_samples(times_s: Float[np.ndarray, " times"], sample_interval_s: float) -> Int[np.ndarray, " distinct"]:
    if not 0 < sample_interval_s < np.inf:
        raise ValueError(f"the sample interval must be positive, not {sample_interval_s} s")
    if len(times_s) == 0 or not (np.all(times_s > 0) and np.all(np.isfinite(times_s))):
        raise ValueError("averaging times must be positive, and at least one is needed")
    return np.unique(np.maximum(np.rint(times_s / sample_interval_s), 1)).astype(np.int64)
