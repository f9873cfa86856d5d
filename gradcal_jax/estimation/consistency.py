"""Tests of a fit against the model, on whitened residuals, which are independent with variance one.

* `χ²` of the whole fit against its degrees of freedom: is the noise as large as in the spec?
* whiteness (Ljung and Box, 1978): are residuals of successive readings correlated? The fit of the parameters correlates
  them, too; mean and covariance of the correlations include this effect (for 200 residuals and 16 parameters the plain
  statistic rejects 10 % of all cases instead of 1 %).
"""

from typing import NamedTuple

import numpy as np
from scipy import special

from gradcal_jax.estimation.solve import Estimate

_LAGS = 20
# Least number of residuals for each lag for the statistic to be χ².
_PER_LAG = 20
_RARE = 0.01


class Test(NamedTuple):
    """A statistic that is χ² with `degrees` where the model is true; `probability` of one as large or larger."""

    __test__ = False  # not a class of tests for pytest

    statistic: float
    degrees: int
    probability: float

    @property
    def passed(self) -> bool:
        """Whether the statistic is plausible at the level of 1 %."""
        return self.probability > _RARE


class Consistency(NamedTuple):
    """The χ² test of a fit. `noise_scale`: √(χ²/degrees), the factor by which the noise differs from the spec;
    `beyond_three`: share of the residuals beyond three standard deviations; `largest`: the largest of them."""

    fit: Test
    noise_scale: float
    beyond_three: float
    largest: float

    @property
    def excess(self) -> float:
        """The factor by which residuals exceed the spec's noise where the χ² test fails; otherwise 1."""
        return max(1.0, self.noise_scale) if not self.fit.passed and self.fit.degrees > 0 else 1.0


def chi_squared_test(statistic: float, degrees: int) -> Test:
    """Test of a statistic against χ² with `degrees` degrees of freedom; passed without any."""
    if degrees <= 0:
        return Test(float(statistic), 0, 1.0)
    return Test(float(statistic), int(degrees), float(special.chdtrc(degrees, statistic)))


def consistency(estimate: Estimate) -> Consistency:
    """The χ² test of a fit, and its largest residuals."""
    residual, degrees, squares = estimate.residuals, estimate.degrees, float(estimate.chi_squared)
    return Consistency(
        chi_squared_test(squares, degrees),
        float(np.sqrt(squares / degrees)) if degrees > 0 else float("nan"),
        float(np.mean(np.abs(residual) > 3.0)) if len(residual) else 0.0,
        float(np.max(np.abs(residual), initial=0.0)),
    )


def whiteness(residual: np.ndarray, taken: np.ndarray | None = None) -> Test:
    """Ljung and Box's statistic of a series of whitened residuals `(n,)`, one-sided: of series that are anti-correlated
    the probability is near one. Their noise is smaller than the model's, and the stated uncertainty holds.

    `taken` `(n, q)`: rows of an orthonormal basis of the fitted columns; the residuals' covariance is
    I − taken takenᵀ. None: no fit.
    """
    count = len(residual)
    taken = np.zeros((count, 0)) if taken is None else taken
    free = count - float(np.sum(taken**2))
    lags = min(_LAGS, max(1, int(free) // _PER_LAG), int(free) // 4)
    power = float(residual @ residual)
    if lags < 1 or power <= 0.0:
        return Test(0.0, 0, 1.0)
    shifts = range(1, lags + 1)
    correlations = np.array([residual[k:] @ residual[:-k] for k in shifts]) / power
    # Moments of quadratic forms in normal variables, over their sum of squares.
    inner = np.stack([0.5 * (one + one.T) for k in shifts for one in [taken[k:].T @ taken[:-k]]])
    mean = -np.trace(inner, axis1=1, axis2=2) / free
    product = np.diag(0.5 * (count - np.array(shifts))) + np.einsum("kij,lij->kl", inner, inner)
    # Twice tr(takenᵀ A_k A_l taken), A_k the half sum of the shifts by ±k: sums of products of the basis, less the
    # terms beyond the ends of the series.
    dots = [np.einsum("ij,ij->i", taken[m:], taken[: count - m]) for m in range(2 * lags + 1)]
    sums = [float(np.sum(d)) for d in dots]
    for k in shifts:
        for m in range(1, k + 1):
            ends = float(np.sum(dots[k - m][count - k :]) + np.sum(dots[k - m][:m]))
            product[k - 1, m - 1] -= sums[k + m] + sums[k - m] - 0.5 * ends
            product[m - 1, k - 1] = product[k - 1, m - 1]
    covariance = 2.0 * (product / free - np.outer(mean, mean)) / (free + 2.0)
    apart = correlations - mean
    test = chi_squared_test(float(apart @ np.linalg.solve(covariance, apart)), lags)
    return test if np.sum(apart) > 0.0 else test._replace(probability=1.0 - test.probability)
