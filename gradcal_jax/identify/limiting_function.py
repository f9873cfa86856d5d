"""The limiting function of the Direct Bound: how far an aligned gyro's angle may drift, per second of integration.

Source: Z. Berman, "Inertial Sensors - A New Approach for Low Cost Calibration and Testing", section 3.

The sensor at rest shows `x(s) + n(s)`: a stationary first-order Gauss-Markov drift `x` (standard deviation σ,
correlation time τ, autocovariance `σ² exp(-|s|/τ)`) and white rate noise `n` (angle random walk N). In the Δ seconds
before time zero the drift is estimated (the *alignment*) and subtracted; the rate is then integrated for t seconds.
`D_L(t)` is the standard deviation of the angle error divided by t: a rate.

There are two alignments; confusing them spoils an identification (5 deg/h for a true 1 deg/h):

* a **Kalman filter** that knows σ, τ and N and tends to its prior for short Δ: `limiting_function`, as in the paper's
  Figures 3-5;
* the **plain mean** over Δ, whose own random-walk error is N/√Δ however well the process is known:
  `limiting_function_of_mean`, the processing of the data in equations 6-7, hence the one for identification.

Symbols, with `u = t/τ`; everything below is a function of u that keeps full relative precision for u → 0:

    a(u) = (1 - e⁻ᵘ)/u                     mean over t of the decay of a drift that is 1 at time zero
    b(u) = 1 - a(u)
    r(u) = [2u - 3 + 4e⁻ᵘ - e⁻²ᵘ]/u²       variance of the mean over t *given* the drift at time zero, over σ²
    V(t)/t² = r(u) + a(u)²                 variance of the mean over t, over σ²

Given the drift at time zero, past and future are independent (the Markov property). So the
variances of the two windows add, and there is no difference of nearly equal terms.
"""

from math import factorial

import numpy as np
from jaxtyping import ArrayLike, Float

# NumPy reduces what has no dimension to scalars.
Values = Float[np.ndarray, "..."] | np.floating
# Below this the closed forms lose digits, and Taylor series are used with enough terms to be exact to rounding.
_SERIES_BELOW = 1.0
_DECAY_LOSS_SERIES = [0.0, *((-1.0) ** k / factorial(k + 2) for k in range(20))]
_CONDITIONAL_VARIANCE_SERIES = [0.0, *((-1.0) ** k * (4.0 - 2.0**k) / factorial(k) for k in range(3, 30))]


def limiting_function(
    integration_time_s: ArrayLike,
    drift_std: ArrayLike,
    correlation_time_s: ArrayLike,
    angle_random_walk: ArrayLike,
    alignment_time_s: ArrayLike = 0.0,
) -> Values:
    """Standard deviation of the angle error after a Kalman alignment, divided by the integration time.

    The filter starts from its prior σ² and observes the noisy rate for Δ seconds; the posterior variance P of the drift
    is that of `alignment_variance`. Afterwards the filter continues without measurements and subtracts the predicted
    drift, which decays as exp(-s/τ):  `D_L² = P a² + σ² r + N²/t`. This is the filter's own covariance and the minimum
    over all linear alignments; never above `D_L` without alignment, `σ² V(t)/t² + N²/t`.

    **Arguments:** `integration_time_s` t > 0 and `correlation_time_s` τ > 0, finite, s; `drift_std` σ ≥ 0, rad/s;
    `angle_random_walk` N ≥ 0, rad/√s; `alignment_time_s` Δ ≥ 0, s. Any coherent unit of angle is allowed.
    Shapes broadcast.

    **Returns:** D_L, rad/s; the angle error itself is `t * D_L`. Differentiable in every argument. Source: Berman,
    section 2, Figures 3–5. Errors: none.

    A drift of 1 deg/h over 120 s and 0.1 deg/√h (6 deg/h·√s), after half an hour without alignment, in deg/h:

    >>> round(float(limiting_function(1800.0, 1.0, 120.0, 6.0)), 2)
    0.38
    """
    t, sigma, tau, walk, delta = _floating(
        integration_time_s, drift_std, correlation_time_s, angle_random_walk, alignment_time_s
    )
    u = t / tau
    remaining = alignment_variance(delta, sigma, tau, walk)
    return np.sqrt(remaining * (1.0 - _decay_loss(u)) ** 2 + sigma**2 * _conditional_variance(u) + walk**2 / t)


def limiting_function_of_mean(
    integration_time_s: ArrayLike,
    drift_std: ArrayLike,
    correlation_time_s: ArrayLike,
    angle_random_walk: ArrayLike,
    averaging_time_s: ArrayLike,
) -> Values:
    """Standard deviation of [mean rate over the next t] - [mean rate over the last Δ]: the paper's eqs. 6-7.

    `D_L² = σ² g(t, Δ, τ) + N² (1/t + 1/Δ)`; g is `drift_shape_of_mean`. `integration_time_s`, `drift_std`,
    `correlation_time_s` and `angle_random_walk` as in `limiting_function`, `averaging_time_s` Δ > 0, s. Shapes
    broadcast. Returns D_L, rad/s. Errors: none.
    """
    t, sigma, tau, walk, delta = _floating(
        integration_time_s, drift_std, correlation_time_s, angle_random_walk, averaging_time_s
    )
    return np.sqrt(sigma**2 * drift_shape_of_mean(t, delta, tau) + random_walk_variance_of_mean(t, delta, walk))


def drift_shape_of_mean(
    integration_time_s: ArrayLike, averaging_time_s: ArrayLike, correlation_time_s: ArrayLike
) -> Values:
    """g(t, Δ, τ): variance of the difference of two adjacent means of a drift of unit variance; dimensionless, ≥ 0.

    With u = t/τ and v = Δ/τ

        g = V(t)/t² + V(Δ)/Δ² - 2 a(u) a(v) = r(u) + r(v) + [b(u) - b(v)]²

    The first form is that of textbooks and loses all digits where both windows are short compared with τ
    (g → ⅔(u + v)); the second one, conditional on the drift at their common instant, loses none.
    """
    t, delta, tau = _floating(integration_time_s, averaging_time_s, correlation_time_s)
    u, v = t / tau, delta / tau
    return _conditional_variance(u) + _conditional_variance(v) + (_decay_loss(u) - _decay_loss(v)) ** 2


def random_walk_variance_of_mean(
    integration_time_s: ArrayLike, averaging_time_s: ArrayLike, angle_random_walk: ArrayLike
) -> Values:
    """`N² (1/t + 1/Δ)`: variance of the difference of two adjacent means of white rate noise, (rad/s)²."""
    t, delta, walk = _floating(integration_time_s, averaging_time_s, angle_random_walk)
    return walk**2 * (1.0 / t + 1.0 / delta)


def alignment_variance(delta: Values, sigma: Values, tau: Values, walk: Values) -> Values:
    """Variance P of the drift's estimate at the end of a Kalman alignment of Δ seconds, (rad/s)².

    The Riccati equation `dP/ds = -2P/τ + 2σ²/τ - P²/N²`, `P(0) = σ²`, is solved by the matrix exponential of its
    Hamiltonian, whose square is a multiple of the identity. With `S = √(N² + 2σ²τ)` and `h = tanh(Δ S/(τ N))`

        P = σ² (N S + N² h) / (N S + (N² + σ²τ) h)

    a ratio of positive terms: nothing cancels, for a drift far below the random walk either. P falls from σ² at Δ = 0
    to the steady state of the filter; for τ → ∞ it tends to the constant bias's `σ²N²/(N² + σ²Δ)`.
    """
    root = np.sqrt(walk**2 + 2.0 * sigma**2 * tau)
    # Without random walk one instant of data determines the drift: tanh(∞) = 1, except for Δ = 0.
    noisy = walk > 0
    grown = np.where(noisy, np.tanh(delta * root / (tau * np.where(noisy, walk, 1.0))), np.sign(delta))
    denominator = walk * root + (walk**2 + sigma**2 * tau) * grown
    nothing_known = denominator == 0
    share = (walk * root + walk**2 * grown) / np.where(nothing_known, 1.0, denominator)
    return sigma**2 * np.where(nothing_known, 1.0, share)


def _decay_loss(u: Values) -> Values:
    """b(u) = (u - 1 + e⁻ᵘ)/u = 1 - a(u), b(u) → u/2."""
    large = np.maximum(u, _SERIES_BELOW)
    series = np.polynomial.polynomial.polyval(np.minimum(u, _SERIES_BELOW), _DECAY_LOSS_SERIES)
    return np.where(u < _SERIES_BELOW, series, (large + np.expm1(-large)) / large)


def _conditional_variance(u: Values) -> Values:
    """r(u) = [2u - 3 + 4e⁻ᵘ - e⁻²ᵘ]/u², r(u) → ⅔u."""
    large = np.maximum(u, _SERIES_BELOW)
    series = np.polynomial.polynomial.polyval(np.minimum(u, _SERIES_BELOW), _CONDITIONAL_VARIANCE_SERIES)
    decayed = np.exp(-large)
    closed = (2.0 * large - 3.0 + 4.0 * decayed - decayed**2) / large**2
    return np.where(u < _SERIES_BELOW, series, closed)


def _floating(*values: ArrayLike) -> tuple[Values, ...]:
    return tuple(np.asarray(value, np.float64) for value in values)
