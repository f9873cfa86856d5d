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

from gradcal_jax.arrays import AnyArray, namespace

# NumPy reduces what has no dimension to scalars.
Values = Float[AnyArray, "..."] | np.floating
# Below this the closed forms lose digits, and Taylor series are used with enough terms to be exact to rounding.
_SERIES_BELOW = 1.0
_DECAY_LOSS_SERIES = tuple((-1.0) ** k / factorial(k + 2) for k in range(20))
_CONDITIONAL_VARIANCE_SERIES = tuple((-1.0) ** k * (4.0 - 2.0**k) / factorial(k) for k in range(3, 30))


def limiting_function(
    integration_time_s: ArrayLike,
    drift_std: ArrayLike,
    correlation_time_s: ArrayLike,
    angle_random_walk: ArrayLike,
    alignment_time_s: ArrayLike = 0.0,
    *,
    correction: str = "carried",
) -> Values:
    """Standard deviation of the angle error after a Kalman alignment, divided by the integration time.

    The filter starts from its prior σ² and observes the noisy rate for Δ seconds; the posterior variance P of the drift
    is that of `alignment_variances`. Afterwards

    * `"carried"`: the filter continues without measurements and subtracts the predicted drift, which decays as
      exp(-s/τ):  `D_L² = P a² + σ² r + N²/t`. This is the filter's own covariance and the minimum over all linear
      alignments; never above `D_L` without alignment.
    * `"held"`: the estimate at the alignment's end is subtracted as a constant, like a bias:
      `D_L² = P a² + (σ² - P) b² + σ² r + N²/t`; for t » τ the estimate is obsolete and adds √(σ² - P).

    With Δ = 0 both are the drift without alignment, `σ² V(t)/t² + N²/t`.

    **Arguments:** `integration_time_s` t > 0 and `correlation_time_s` τ > 0, finite, s; `drift_std` σ ≥ 0, rad/s;
    `angle_random_walk` N ≥ 0, rad/√s; `alignment_time_s` Δ ≥ 0, s. Any coherent unit of angle is allowed.
    Shapes broadcast.

    **Returns:** D_L, rad/s; the angle error itself is `t * D_L`. Differentiable in every argument. Source: Berman,
    section 2, Figures 3–5. Errors: `ValueError` for another `correction`.

    A drift of 1 deg/h over 120 s and 0.1 deg/√h (6 deg/h·√s), after half an hour without alignment, in deg/h:

    >>> round(float(limiting_function(1800.0, 1.0, 120.0, 6.0)), 2)
    0.38
    """
    if correction not in ("carried", "held"):
        raise ValueError(f'correction must be "carried" or "held", not {correction!r}')
    t, sigma, tau, walk, delta = _floating(
        integration_time_s, drift_std, correlation_time_s, angle_random_walk, alignment_time_s
    )
    u = t / tau
    remaining, learnt = alignment_variances(delta, sigma, tau, walk)
    variance = remaining * (1.0 - _decay_loss(u)) ** 2 + sigma**2 * _conditional_variance(u) + walk**2 / t
    if correction == "held":
        variance = variance + learnt * _decay_loss(u) ** 2
    return _safe_sqrt(variance)


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
    broadcast. Returns D_L, rad/s, differentiable in every argument. Errors: none.
    """
    t, sigma, tau, walk, delta = _floating(
        integration_time_s, drift_std, correlation_time_s, angle_random_walk, averaging_time_s
    )
    return _safe_sqrt(sigma**2 * drift_shape_of_mean(t, delta, tau) + random_walk_variance_of_mean(t, delta, walk))


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


def alignment_variances(delta: Values, sigma: Values, tau: Values, walk: Values) -> tuple[Values, Values]:
    """Variance P of the drift's estimate at the end of a Kalman alignment of Δ seconds, and σ² - P, (rad/s)².

    The Riccati equation `dP/ds = -2P/τ + 2σ²/τ - P²/N²`, `P(0) = σ²`, is solved by the matrix exponential of its
    Hamiltonian, whose square is a multiple of the identity. With `S = √(N² + 2σ²τ)` and `h = tanh(Δ S/(τ N))`

        P = σ² (N S + N² h) / (N S + (N² + σ²τ) h)

    a ratio of positive terms: nothing cancels, for a drift far below the random walk either. P falls from σ² at Δ = 0
    to the steady state of the filter; for τ → ∞ it tends to the constant bias's `σ²N²/(N² + σ²Δ)`.
    """
    xp = namespace(delta, sigma, tau, walk)
    root = xp.sqrt(xp.where((walk > 0) | (sigma > 0), walk**2 + 2.0 * sigma**2 * tau, 1.0))
    noisy = walk > 0
    # Without random walk one instant of data determines the drift: tanh(∞) = 1, except for Δ = 0.
    grown = xp.where(noisy, xp.tanh(delta * root / (tau * xp.where(noisy, walk, 1.0))), xp.sign(delta))
    denominator = walk * root + (walk**2 + sigma**2 * tau) * grown
    nothing_known = denominator == 0
    denominator = xp.where(nothing_known, 1.0, denominator)
    remaining = xp.where(nothing_known, sigma**2, sigma**2 * (walk * root + walk**2 * grown) / denominator)
    learnt = sigma**4 * tau * grown / denominator
    return remaining, learnt


def _decay_loss(u: Values) -> Values:
    """b(u) = (u - 1 + e⁻ᵘ)/u = 1 - a(u), b(u) → u/2."""
    xp, (small, large) = namespace(u), _split(u)
    return xp.where(u < _SERIES_BELOW, small * _horner(_DECAY_LOSS_SERIES, small), (large + xp.expm1(-large)) / large)


def _conditional_variance(u: Values) -> Values:
    """r(u) = [2u - 3 + 4e⁻ᵘ - e⁻²ᵘ]/u², r(u) → ⅔u."""
    xp, (small, large) = namespace(u), _split(u)
    decayed = xp.exp(-large)
    closed = (2.0 * large - 3.0 + 4.0 * decayed - decayed**2) / large**2
    return xp.where(u < _SERIES_BELOW, small * _horner(_CONDITIONAL_VARIANCE_SERIES, small), closed)


def _split(u: Values) -> tuple[Values, Values]:
    """The argument for both branches of a `where`, harmless in the unused branch so that gradients stay finite."""
    xp, short = namespace(u), u < _SERIES_BELOW
    # Not minimum and maximum: at a tie those pass half of the gradient each.
    return xp.where(short, u, _SERIES_BELOW), xp.where(short, _SERIES_BELOW, u)


def _horner(coefficients: tuple[float, ...], u: Values) -> Values:
    total = namespace(u).full_like(u, coefficients[-1])
    for coefficient in reversed(coefficients[:-1]):
        total = total * u + coefficient
    return total


def _safe_sqrt(variance: Values) -> Values:
    """√, with a derivative of zero instead of infinity for a sensor without any error at all."""
    xp, positive = namespace(variance), variance > 0
    return xp.where(positive, xp.sqrt(xp.where(positive, variance, 1.0)), 0.0)


def _floating(*values: ArrayLike) -> tuple[Values, ...]:
    """Arrays of one floating type, JAX's if any is; integers are converted."""
    xp = namespace(values)
    arrays = [xp.asarray(value) for value in values]
    dtype = xp.result_type(float, *(a for a in arrays if xp.issubdtype(a.dtype, xp.floating)))
    return tuple(array.astype(dtype) for array in arrays)
