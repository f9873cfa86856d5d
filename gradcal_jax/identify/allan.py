"""Overlapping Allan deviation of a gyro at rest, with confidence, and the noise coefficients behind it.

Sources: IEEE Std 952-1997, annex C (the model and its coefficients); W. J. Riley, "Handbook of Frequency Stability
Analysis", NIST SP 1065 (the estimator); C. A. Greenhall and W. J. Riley, "Uncertainty of stability variances based on
finite differences", PTTI 2003 (generalised autocovariances: `allan_covariance`).

    θ_i             running angle after i samples of τ₀ seconds
    u_i             θ_(i+2m) - 2θ_(i+m) + θ_i, second difference over τ = m τ₀
    V(τ)            mean over i of u_i²/(2τ²): the overlapping Allan variance

    E V(τ) = 3 Q²/τ² + N²/τ + (2 ln 2/π) B² + K² τ/3

    Q  quantisation (rad), white in the angle; N angle random walk (rad/√s); B bias instability (rad/s), 1/f noise;
    K  rate random walk (rad/s/√s)

No table of degrees of freedom by noise type is needed, since the fitted mixture is the noise type. The fit is
generalised least squares (no coefficient negative) with the covariance under the fitted mixture, iterated, over
averaging times an octave apart, since intermediate times add almost no information. The standard errors are those of
the fit. The distance of the V from the fit, in cube roots, is χ² with as many degrees as times less nonzero
coefficients; its probability tests the model. Where the test fails, the longest times are left out one by one until it
passes; where it never passes, the standard deviation of each V is increased to its residual.

**Low-pass.** Nearly every sensor averages its output over some samples. That reduces the white noise at the shortest τ,
from which a fit would determine N. A sum of the four powers of τ is convex in logarithms; white noise behind a low-pass
is not: V rises or stays level below the low-pass's length and falls as N²/τ beyond. Where ln V is concave at the
shortest times by more than five standard deviations, the fit begins at twice the τ of the sharpest bend. The reduction
beyond the low-pass's length is c/τ², exactly so for a moving mean (for M samples c = N² τ₀ (M² - 1)/(2M)), and a column
of the fit; quantisation, which has the same form, cannot be determined then.
"""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from jaxtyping import Bool, Float, Int
from scipy import optimize, special

from gradcal_jax import formulas
from gradcal_jax.identify.allan_covariance import Runs, Squares, covariances, variance_covariance
from gradcal_jax.identify.largest_drift import running_angle
from gradcal_jax.tables.display import summary

Times = Float[np.ndarray, " times"]
Steps = Int[np.ndarray, " times"]

TERMS = ("quantisation", "angle_random_walk", "bias_instability", "rate_random_walk")
_FLICKER = 2.0 * np.log(2.0) / np.pi
# Second differences are summed in pieces that fit into the cache, and are too short for BLAS to start threads, which on
# a busy machine wait for one another.
_PIECE = 1 << 13
# Standard deviations of concavity of ln V for a low-pass, and by which N², B², … must exceed zero to be significant.
_BENT = 5.0
_SHOWS = 3.0
# Least probability of a record's distance from its fit under the model.
MISFIT = 0.01
_SLOWEST_LOW_PASS_S = 1.0


@dataclass(frozen=True)
class AllanDeviation:
    """Overlapping Allan deviation of one channel; see `overlapping_allan`."""

    averaging_time_s: Times
    """Averaging times τ, s; each is a whole number of samples."""
    deviation: Times
    """Allan deviation √V, in the unit of the rates (rad/s in this package)."""
    difference_count: Steps
    """Number of averaged second differences at each τ."""
    sample_interval_s: float
    stretch_lengths: tuple[int, ...]
    """Number of samples in each unbroken stretch; the confidence is computed from these numbers."""

    __repr__ = summary


@dataclass(frozen=True)
class Coefficient:
    """An identified noise coefficient, SI, with its standard error."""

    value: float
    standard_error: float
    """Standard error (1σ, to first order); if the value is zero, the value that would be one standard error above
    zero."""
    shows: bool
    """Whether the coefficient's part of the variance is more than three standard errors above zero."""


@dataclass(frozen=True)
class AllanFit:
    """Noise coefficients of one channel and the confidence in its Allan deviation; see `fit_allan`."""

    quantisation: Coefficient
    """Quantisation Q, rad."""
    angle_random_walk: Coefficient
    """Angle random walk N, rad/√s."""
    bias_instability: Coefficient
    """Bias instability B, rad/s; the minimum of the Allan deviation is 0.664 B."""
    rate_random_walk: Coefficient
    """Rate random walk K, rad/s/√s."""
    averaging_time_s: Times
    model_deviation: Times
    """Allan deviation of the fitted model."""
    degrees_of_freedom: Times
    """Equivalent degrees of freedom of the Allan variance V(τ) under the fitted model."""
    lower: Times
    upper: Times
    """Confidence limits (`lower`, `upper`) of the true deviation, from the measured deviation and χ² with these degrees
    of freedom."""
    confidence: float
    fitted_time_s: Float[np.ndarray, " fitted"]
    """Averaging times that the fit uses."""
    low_passed: bool
    """Whether a low-pass filter is visible at the shortest averaging times; the fit then does not use these times."""
    chi_squared: float
    """χ² of the Allan variances against the model, by their covariance, over all averaging times except those affected
    by a low-pass filter."""
    chi_squared_degrees: int
    chance: float
    """Probability that a record of this model deviates from its fit as much as this record does."""
    farthest_time_s: float
    """Averaging time at which the record deviates most from the model."""

    __repr__ = summary


def averaging_times(samples: int, sample_interval_s: float, *, per_decade: int = 10) -> Times:
    """Whole multiples of the sample interval, evenly spread on a logarithmic scale, up to a third of the record, s."""
    if samples < 3:
        raise ValueError(f"an Allan deviation needs at least 3 samples, and there are {samples}")
    longest = samples // 3
    count = max(2, round(per_decade * np.log10(longest)) + 1) if longest > 1 else 1
    return np.unique(np.rint(np.geomspace(1, longest, count))) * sample_interval_s


def overlapping_allan(
    rate: Float[np.ndarray, " samples"],
    sample_interval_s: float,
    averaging_times_s: Times | None = None,
    *,
    valid: Bool[np.ndarray, " samples"] | None = None,
) -> AllanDeviation:
    """Overlapping Allan deviation of evenly sampled rates.

    No difference spans a sample that is not `valid`. Gaps in time are invalid samples on the even grid.
    `averaging_times_s` are rounded to whole samples (without them, `averaging_times` of the longest stretch); those too
    long for every stretch are left out.

    **Raises:** `ValueError` where nothing is left, and where a usable rate is not finite.
    """
    usable = np.ones(len(rate), bool) if valid is None else valid
    if usable.shape != rate.shape:
        raise ValueError(
            f"the mask of usable samples has the shape {usable.shape}, and the rates have the shape {rate.shape}"
        )
    edges = formulas.runs(usable)
    lengths = tuple((edges[:, 1] - edges[:, 0]).tolist())
    longest = max(lengths, default=0)
    if longest < 2:
        raise ValueError("an Allan deviation needs two consecutive usable samples")
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
        angle = running_angle(rate[start:stop])
        for row, m in enumerate(steps.tolist()):
            if 2 * m <= stop - start:
                total[row] += _sum_of_squares(angle, m)
                count[row] += stop - start - 2 * m + 1
    return AllanDeviation(
        steps * sample_interval_s, np.sqrt(total / (2 * count)) / steps, count, sample_interval_s, lengths
    )


def fit_allan(allan: AllanDeviation, *, terms: Sequence[str] = TERMS, confidence: float = 0.683) -> AllanFit:
    """The coefficients whose model fits an Allan deviation best, with standard errors, and its confidence limits.

    Generalised least squares on the variances, none negative, over times an octave apart and no shorter than where a
    low-pass ends (see the module's head). `terms`: those of `TERMS` that the sensor may have; the others are zero.
    Deterministic drift (a temperature ramp) appears as rate random walk: remove it first.

    **Raises:** `ValueError` for unknown terms, fewer averaging times than terms, or a confidence outside (0, 1).
    """
    unknown = [term for term in terms if term not in TERMS]
    if unknown or not terms:
        raise ValueError(
            f"expected one or more of the terms {', '.join(TERMS)}, not {', '.join(unknown) or 'none at all'}"
        )
    if not 0 < confidence < 1:
        raise ValueError(f"a confidence must lie between 0 and 1, and this one is {confidence}")
    chosen = np.array([term in terms for term in TERMS])
    tau, variance, interval = allan.averaging_time_s, allan.deviation**2, allan.sample_interval_s
    if len(tau) < chosen.sum():
        longest = max(allan.stretch_lengths, default=0) * interval
        raise ValueError(
            f"the longest unbroken part of the record has only {longest:.4g} s, with {len(tau)} averaging times: too "
            f"few to determine {chosen.sum()} coefficients"
        )
    if not np.all(variance > 0):
        raise ValueError("the rate does not change: the record has no noise to fit")
    steps = np.rint(tau / interval).astype(np.int64)
    lengths, counts = np.unique(np.array(allan.stretch_lengths), return_counts=True)
    runs = tuple(zip(lengths.tolist(), counts.tolist(), strict=True))

    rows = octaves(steps, at_least=int(chosen.sum()) + 1)
    end = _end_of_low_pass(steps[rows], variance[rows], runs, interval)
    low_passed = end > 0
    if low_passed:
        rows = rows[steps[rows] >= end]
        chosen[0] = False  # the low-pass's own term has the form of quantisation's
        if len(rows) < chosen.sum() + 1:
            raise ValueError(
                f"a low-pass filter averages the samples over about {end / 2 * interval:.3g} s, and the record has "
                f"too few averaging times above this time to determine {chosen.sum()} coefficients"
            )
    fit = whole = _least_squares(steps[rows], variance[rows], runs, interval, chosen, low_passed)
    farthest = float(tau[rows[whole.farthest]])
    # Trends and effects of temperature appear at long times; the model may still hold at shorter ones.
    least = int(chosen.sum()) + 2
    shorter = [rows[:length] for length in range(len(rows) - 1, least - 1, -1)] if whole.chance < MISFIT else []
    for band in shorter:
        inside = _least_squares(steps[band], variance[band], runs, interval, chosen, low_passed)
        if inside.chance >= MISFIT:
            fit, rows = inside, band
            break
    expected = design_of_noise(tau) @ fit.squares
    pairs = tuple((m, m) for m in steps.tolist())
    freedom = 2 * expected**2 / covariances(pairs, runs, interval, fit.squares, fit.rounding)
    expected[rows] = fit.expected
    tail = (1 - confidence) / 2
    coefficients = [
        _coefficient(float(square), float(error), seen)
        for square, error, seen in zip(fit.squares, fit.errors, chosen.tolist(), strict=True)
    ]
    return AllanFit(
        *coefficients,
        averaging_time_s=tau,
        model_deviation=np.sqrt(expected),
        degrees_of_freedom=freedom,
        lower=allan.deviation * np.sqrt(freedom / special.chdtri(freedom, tail)),
        upper=allan.deviation * np.sqrt(freedom / special.chdtri(freedom, 1 - tail)),
        confidence=confidence,
        fitted_time_s=tau[rows],
        low_passed=low_passed,
        chi_squared=whole.chi_squared,
        chi_squared_degrees=whole.degrees,
        chance=whole.chance,
        farthest_time_s=farthest,
    )


def _coefficient(square: float, error: float, chosen: bool) -> Coefficient:
    if not chosen:
        return Coefficient(0.0, 0.0, False)
    value = float(np.sqrt(square))
    one_sigma = error / (2 * value) if value > 0 else float(np.sqrt(error))
    return Coefficient(value, one_sigma, bool(square > _SHOWS * error))


def design_of_noise(tau: Times) -> Float[np.ndarray, "times 4"]:
    return np.stack([3 / tau**2, 1 / tau, np.full_like(tau, _FLICKER), tau / 3], axis=1)


def octaves(steps: Steps, *, at_least: int) -> Int[np.ndarray, " rows"]:
    """Rows of averaging times about an octave apart; all, where those would be too few."""
    rows = [0]
    for row in range(1, len(steps)):
        if steps[row] > 1.9 * steps[rows[-1]]:
            rows.append(row)
    return np.array(rows) if len(rows) >= at_least else np.arange(len(steps))


def _end_of_low_pass(steps: Steps, variance: Times, runs: Runs, interval: float) -> int:
    """Number of samples from which on a low-pass has only its term in 1/τ²; 0 without a significant low-pass."""
    if len(steps) < 3:
        return 0
    x, y = np.log(steps), np.log(variance)
    white = np.array([0.0, 1.0, 0.0, 0.0])
    covariance = variance_covariance(steps, runs, 1.0, white) * np.outer(steps, steps)  # of ln V, if the noise is white
    bent, after_rounding = np.zeros(len(steps)), False
    for k in range(1, len(steps) - 1):
        weight = np.zeros(len(steps))
        weight[k - 1], weight[k + 1] = -1 / (x[k] - x[k - 1]), -1 / (x[k + 1] - x[k])
        weight[k] = -weight[k - 1] - weight[k + 1]
        deviations = float(weight @ y) / float(np.sqrt(weight @ covariance @ weight))
        falls = y[k] < y[k - 1]
        if deviations < -_BENT and falls:
            after_rounding = True
        # V that falls, rises and falls again: rounded output of a low-pass, if within a second; otherwise a drift.
        if after_rounding and steps[k] * interval > _SLOWEST_LOW_PASS_S:
            break
        bent[k] = float(weight @ y) if deviations > _BENT else 0.0
    return 2 * int(steps[np.argmax(bent)]) if bent.any() else 0


@dataclass(frozen=True)
class _Fit:
    squares: Squares
    errors: Squares
    expected: Times
    rounding: float
    chi_squared: float
    degrees: int
    chance: float
    farthest: int


def _least_squares(
    steps: Steps, variance: Times, runs: Runs, interval: float, chosen: Bool[np.ndarray, " 4"], low_passed: bool
) -> _Fit:
    """Generalised least squares on V; weights and coefficients in turn until convergence."""
    tau = steps * interval
    # The reduction by a low-pass beyond its end is c/τ²: a fifth column, present twice for both signs.
    design = np.column_stack([design_of_noise(tau), 1 / tau**2])
    signs = np.array([[1.0, 1, 1, 1, 1], [0, 0, 0, 0, -1]])
    used = np.append(chosen, low_passed)
    columns, signs = np.nonzero(signs * used)[::-1][0], signs[np.nonzero(signs * used)]
    counts = sum(np.maximum(n - 2 * steps + 1, 0) * times for n, times in runs)
    # Initial relative variance of every V: as if its differences were independent over τ.
    covariance = np.diag(variance**2 * 2 * steps / counts)
    solution, rounding = np.zeros(5), 0.0
    expected, left = variance, np.zeros(len(tau))
    for turn in range(20):
        previous = solution
        root = np.linalg.cholesky(covariance)
        weighed = np.linalg.solve(root, design)
        scale = np.linalg.norm(weighed, axis=0)
        strengths, _ = optimize.nnls((weighed / scale)[:, columns] * signs, np.linalg.solve(root, expected + left))
        solution = np.bincount(columns, strengths * signs, minlength=5) / scale
        if low_passed and solution[1] > 0 and turn < 4:
            rounding = max(-solution[4], 0.0) / (1.5 * solution[1] * interval)
        covariance = variance_covariance(steps, runs, interval, solution[:4], rounding)
        expected = np.maximum(design @ solution, 1e-3 * variance)
        left = _gaussian(variance, expected, np.diag(covariance))
        if np.allclose(solution, previous, rtol=1e-4, atol=0.0):
            break
    root = np.linalg.cholesky(covariance)
    weighed = np.linalg.solve(root, design)
    chi_squared = float(np.sum(np.linalg.solve(root, left) ** 2))
    degrees = len(steps) - int(np.count_nonzero(solution))
    chance = float(special.chdtrc(degrees, chi_squared)) if degrees > 0 else 1.0
    away = np.abs(left) / np.sqrt(np.diag(covariance))
    # Where the model does not hold, the standard deviation of each V is increased to its residual.
    wider = np.maximum(away, 1.0) if chance < MISFIT else np.ones(len(tau))
    errors = np.zeros(4)
    for index in np.flatnonzero(chosen):
        # The standard error of a term at zero is the one that it would have in a fit together with the others.
        present = np.append(solution[:4] > 0, low_passed) | (np.arange(5) == index)
        scale = np.linalg.norm(weighed[:, present], axis=0)
        gain = np.linalg.pinv(weighed[:, present] / scale) / scale[:, None]
        row = np.linalg.solve(root.T, gain[int(np.count_nonzero(present[:index]))]) * wider
        errors[index] = float(np.linalg.norm(row @ root))
    return _Fit(solution[:4], errors, expected, rounding, chi_squared, degrees, chance, int(np.argmax(away)))


def _gaussian(variance: Times, expected: Times, spread: Times) -> Times:
    """V - E V without the skewness of χ²: the deviation of its cube root from its mean, scaled to the same variance."""
    half = expected**2 / spread
    mean, square = (special.poch(half, power) / half**power for power in (1 / 3, 2 / 3))
    return np.sqrt(spread / (square - mean**2)) * (np.cbrt(variance / expected) - mean)


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


def _whole_samples(times_s: Times, sample_interval_s: float) -> Int[np.ndarray, " distinct"]:
    if not 0 < sample_interval_s < np.inf:
        raise ValueError(f"the sample interval must be positive, and this one is {sample_interval_s} s")
    if len(times_s) == 0 or not (np.all(times_s > 0) and np.all(np.isfinite(times_s))):
        raise ValueError("at least one averaging time is needed, and all must be positive")
    return np.unique(np.maximum(np.rint(times_s / sample_interval_s), 1)).astype(np.int64)
