"""Test of a log for structure that the model of a map lacks: the χ² test, the degrees that the data require, and the
size of the discrepancy.

An orthogonal projection removes all other estimated parameters, with their priors, from the whitened columns G of the
polynomials beyond the map and from the data d. Then with `G = U S Vᵀ`, `y = Uᵀd` is `N(0, 1 + σ²m)` component by
component, `m = S²` being the gains, where the coefficients are `N(0, σ²)`; without a
hidden map `Σ y²` is χ². Of σ²:

* the estimate is where the marginal likelihood `−½ Σ [ln(1 + σ²m) + y²/(1 + σ²m)]` of all units together is largest
  (restricted maximum likelihood, Patterson and Thompson, 1971: the other parameters have been projected out);
* `Q(σ²) = Σ y²/(1 + σ²m)` decreases with σ² and is χ²_k at the true one, so the σ² at which Q equals the 97.5 and 2.5 %
  points are the ends of an interval with exactly 95 % coverage for any k and σ.
"""

from typing import Any, NamedTuple

import numpy as np
from scipy import optimize, special

from gradcal_jax.estimation.consistency import Test, chi_squared_test
from gradcal_jax.estimation.solve import Whitened
from gradcal_jax.information.posterior import OBSERVABLE
from gradcal_jax.model import Discrepancy

_TAILS = (0.975, 0.025)
# The largest σ²·m of the search; no log distinguishes larger ones.
_LARGEST = 1e12


# Components whose gain is below this share of the largest gain would only add noise to the test.
_SEEN = 1e-4


def not_negligible(gain: np.ndarray) -> np.ndarray:
    """The components in the test: those with a gain that is not negligible beside the largest."""
    largest = np.max(gain, initial=0.0)
    return gain > max(_SEEN * largest, np.finfo(float).tiny)


class Components(NamedTuple):
    """`y` `(k, U)` of U units with the same gains `(k,)` (per squared unit of a coefficient)."""

    y: np.ndarray
    gains: np.ndarray


class Size(NamedTuple):
    """Standard deviation of a discrepancy's coefficients (1 or rad/s), and 95 % interval; `high` None: no end."""

    std: float
    low: float
    high: float | None


class StructureTest(NamedTuple):
    """Test of one map and unit. `beyond`: the same against a map that has the discrepancy of its model. `asked`: the
    degrees (in temperature, in rate) that the data require; None where the model suffices. `components`: input of
    `size_of`, which combines several units.
    """

    quantity: str
    test: Test
    beyond: Test
    false_alarm: float
    asked: tuple[int, int] | None
    size: Size
    components: Components

    @property
    def noticed(self) -> bool:
        return self.test.degrees > 0 and self.test.probability < self.false_alarm


def components(white: Whitened, extra: np.ndarray, keep: np.ndarray | None = None) -> Components:
    """Components of the units in `white`, which share rows, on the whitened columns `extra` `(n, k)` of hidden
    functions.

    `keep` `(k,)`: the tested functions; the others are estimated, too, without a prior.
    """
    n, rows = len(extra), white.rows
    keep = np.ones(extra.shape[1], bool) if keep is None else keep
    white_prior = np.pad(white.prior, ((0, 0), (0, int((~keep).sum()))))
    beside = np.concatenate([np.concatenate([rows, extra[:, ~keep]], axis=1), white_prior])
    both = np.column_stack([extra[:, keep], white.data])
    both = np.concatenate([both, np.zeros((len(beside) - n, both.shape[1]))])
    length = np.linalg.norm(beside, axis=0)
    left, singular, _ = np.linalg.svd(beside / np.where(length > 0.0, length, 1.0), full_matrices=False)
    known = left[:, singular > OBSERVABLE * np.max(singular, initial=0.0)]
    both = both - known @ (known.T @ both)
    # Projected twice, since the remainder is small beside the removed part.
    both = both - known @ (known.T @ both)
    hidden, data = both[:, : int(keep.sum())], both[:, int(keep.sum()) :]
    directions, sizes, _ = np.linalg.svd(hidden, full_matrices=False)
    used = not_negligible(sizes**2)
    return Components(directions[:, used].T @ data, sizes[used] ** 2)


def chi_squared(of: Components, unit: int = 0) -> Test:
    """The test of one unit."""
    return chi_squared_test(float(np.sum(of.y[:, unit] ** 2)), len(of.gains))


def size_of(every: list[Components]) -> Size | None:
    """Size of the discrepancy from all units together; None where none of them has a component."""
    squares = np.concatenate([c.y.T.ravel() ** 2 for c in every])
    gains = np.concatenate([np.tile(c.gains, c.y.shape[1]) for c in every])
    if not len(gains):
        return None
    scale = float(np.max(gains))
    m = gains / scale

    def short(log: float) -> float:
        v = 1.0 + np.exp(log) * m
        return float(np.sum(np.log(v) + squares / v))

    grid = np.linspace(-12.0, np.log(_LARGEST), 400)
    values = [short(x) for x in grid]
    best = int(np.argmin(values))
    around = (grid[max(best - 1, 0)], grid[min(best + 1, 399)])
    optimum: Any = optimize.minimize_scalar(short, bounds=around, method="bounded")
    at = float(optimum.x)
    none = float(np.sum(squares))
    estimate = 0.0 if none <= short(at) else float(np.exp(at))

    def pivot(variance: float) -> float:
        return float(np.sum(squares / (1.0 + variance * m)))

    ends: list[float | None] = []
    for tail in _TAILS:
        quantile = float(special.chdtri(len(m), 1.0 - tail))
        if none <= quantile:
            ends.append(0.0)
        elif pivot(_LARGEST) > quantile:
            ends.append(None)
        else:
            end: Any = optimize.brentq(lambda v, q=quantile: pivot(v) - q, 0.0, _LARGEST, xtol=1e-12)
            ends.append(float(end))
    low, high = ends
    root = lambda v: float(np.sqrt(v / scale))  # noqa: E731
    return Size(root(estimate), root(0.0 if low is None else low), None if high is None else root(high))


def structure_test(
    white: Whitened, extra: np.ndarray, hidden: Discrepancy, false_alarm: float, stated: float = 0.0
) -> StructureTest | None:
    """Test of one unit on the whitened columns `extra` `(n, k)` of the hidden functions, and of more of them than the
    standard deviation `stated` of each says; None without components."""
    of = components(white, extra)
    size = size_of([of])
    if size is None:
        return None
    test = chi_squared(of)
    beyond = chi_squared_test(float(np.sum(of.y[:, 0] ** 2 / (1.0 + stated**2 * of.gains))), len(of.gains))
    asked = _asked(white, extra, hidden, false_alarm) if test.probability < false_alarm else None
    return StructureTest(hidden.name.removesuffix("_discrepancy"), test, beyond, false_alarm, asked, size, of)


def _asked(white: Whitened, extra: np.ndarray, hidden: Discrepancy, false_alarm: float) -> tuple[int, int]:
    """The structure with the fewest coefficients beyond which the same test detects nothing."""
    degrees = np.array(hidden.degrees())
    lowest = hidden.temperature.lowest - 1, 0 if hidden.rate is None else hidden.rate.lowest - 1
    most = np.max(degrees, axis=0)
    every = [(i, j) for i in range(lowest[0], max(most[0], lowest[0]) + 1) for j in range(lowest[1], most[1] + 1)]
    for i, j in sorted(every, key=lambda d: ((d[0] + 1) * (d[1] + 1), d)):
        beyond = np.any(degrees > [i, j], axis=1)
        if not beyond.any():
            break
        rest = components(white, extra, beyond)
        if chi_squared(rest).probability >= false_alarm:
            return i, j
    return int(most[0]), int(most[1])
