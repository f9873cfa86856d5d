"""Tests of a fit against the model, on whitened residuals, which are independent with variance one.

* `χ²` of the whole fit against its degrees of freedom: is the noise as large as in the spec?
* whiteness (Ljung and Box, 1978): are residuals of successive readings correlated? The fit of the parameters correlates
  them, too; mean and covariance of the correlations include this effect (for 200 residuals and 16 parameters the plain
  statistic rejects 10 % of all cases instead of 1 %).
* share of residuals beyond three standard deviations: are there outliers?
* **split test**: whitened rows are independent, so any two subsets are two experiments. With the smallest χ² of each,
  `χ²_AB − χ²_A − χ²_B` is χ² with as many degrees of freedom as parameters that both observe: do heating and cooling
  (or the first and the second half) agree? `(β_A − β_B)_k/√(C_A + C_B)_kk` shows the coefficient that differs.
"""

from collections.abc import Mapping
from typing import NamedTuple

import numpy as np
from scipy import special

from gradcal_jax.estimation.solve import Estimate, Whitened, factored, solve

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


class Split(NamedTuple):
    """Two subsets of the readings against each other; see the module's head. `differences` `(p,)` in standard
    deviations (NaN where one of them does not observe the parameter), of the reported parameters."""

    name: str
    counts: tuple[int, int]
    agreement: Test
    differences: np.ndarray


class Consistency(NamedTuple):
    """Tests of a fit. `noise_scale`: √(χ²/degrees), the factor by which the noise differs from the spec."""

    fit: Test
    noise_scale: float
    whiteness: Test
    beyond_three: float
    largest: float
    splits: tuple[Split, ...]


def failed_tests(tests: Mapping[str, Test]) -> list[str]:
    """The names of the tests that fail, at a level at which by chance any of them does once in a hundred."""
    return [name for name, test in tests.items() if test.probability < _RARE / len(tests)]


def chi_squared_test(statistic: float, degrees: int) -> Test:
    """Test of a statistic against χ² with `degrees` degrees of freedom; passed without any."""
    if degrees <= 0:
        return Test(float(statistic), 0, 1.0)
    return Test(float(statistic), int(degrees), float(special.chdtrc(degrees, statistic)))


def consistency(
    estimate: Estimate,
    white: Whitened,
    subsets: dict[str, np.ndarray],
    to_reported: np.ndarray,
    taken: np.ndarray | None = None,
) -> Consistency:
    """All tests of a fit. `subsets`: by name, a truth value for each reading used; `to_reported` `(p, p)`; `taken`:
    result of `taken_up`, if known."""
    residual, degrees, squares = estimate.residuals, estimate.degrees, float(estimate.chi_squared)
    splits = [split(white, name, subset, to_reported) for name, subset in subsets.items()]
    return Consistency(
        chi_squared_test(squares, degrees),
        float(np.sqrt(squares / degrees)) if degrees > 0 else float("nan"),
        whiteness(residual, taken_up(white) if taken is None else taken),
        float(np.mean(np.abs(residual) > 3.0)) if len(residual) else 0.0,
        float(np.max(np.abs(residual), initial=0.0)),
        tuple(s for s in splits if s is not None),
    )


def whiteness(residual: np.ndarray, taken: np.ndarray | None = None) -> Test:
    """Ljung and Box's statistic of a series of whitened residuals `(n,)`.

    `taken` `(n, q)`: rows of an orthonormal basis of the fitted columns, from `taken_up`; the residuals' covariance is
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
    return chi_squared_test(float(apart @ np.linalg.solve(covariance, apart)), lags)


def taken_up(white: Whitened) -> np.ndarray:
    """`(n, q)`: the readings' rows of an orthonormal basis of the columns of all parameters."""
    return factored(np.concatenate([white.rows, white.prior])).basis[: len(white.rows)]


def split(white: Whitened, name: str, subset: np.ndarray, to_reported: np.ndarray) -> Split | None:
    """Readings in `subset` against the others; None where either side is empty."""
    if subset.all() or not subset.any():
        return None
    halves = white.only(subset).condensed(), white.only(~subset).condensed()
    three = (*halves, halves[0].joined(halves[1]))
    first, second = (solve(part) for part in halves)
    # Without the prior's rows, which both halves contain and which would count twice.
    without = [solve(part._replace(prior=part.prior[:0])) for part in three]
    squares = [float(s.chi_squared) for s in without]
    ranks = [len(part.data) - s.degrees for part, s in zip(three, without, strict=True)]
    agreement = chi_squared_test(max(squares[2] - squares[0] - squares[1], 0.0), ranks[0] + ranks[1] - ranks[2])
    apart = to_reported @ (first.parameters - second.parameters)
    variance = first.known.deviations(to_reported) ** 2 + second.known.deviations(to_reported) ** 2
    seen = np.isfinite(variance) & (variance > 0.0)
    differences = np.where(seen, apart / np.sqrt(np.where(seen, variance, 1.0)), np.nan)
    return Split(name, (int(subset.sum()), int((~subset).sum())), agreement, differences)
