"""Power of a plan to detect that a map has more structure than the model: the χ² test of the next polynomials.

A hidden map has coefficients `γ ~ N(0, σ²)` on the functions of a `Discrepancy`. After projection of the whitened rows
onto the complement of all other parameters the data are `z = S γ + e`, `e ~ N(0, 1)`; in the singular vectors of S the
components are independent, `y_i ~ N(0, 1 + σ² m_i)`, with the *gains* `m_i` its squared singular values. The
test is

    t = Σ y_i²  >  q,    t ~ χ²_k  without a hidden map, so that P(t > q) is the level of false alarms.

With one, t is a sum of χ²_1 with weights `w_i = 1 + σ² m_i`. For weights of at least one its distribution is a mixture
of χ² of k + 2j degrees (Ruben, Annals of Mathematical Statistics 33, 1962), all of whose terms are positive:

    P(t ≤ q) = Σ_j a_j F_{k+2j}(q),   a_0 = Π w_i^(−1/2),   2j a_j = Σ_{r<j} b_{j−r} a_r,   b_r = Σ_i (1 − 1/w_i)^r

and `1/w_i` is the ratio of posterior to prior variance of that component: `kept`, the eigenvalues of the posterior
covariance of γ over σ². Directions with less than `SEEN` of the largest gain would only add noise to the test and are
left out; they depend on the plan alone.
"""

from functools import lru_cache

import numpy as np
from jaxtyping import Float

from gradcal_jax.arrays import AnyArray, fixed, namespace, put
from gradcal_jax.information.posterior import SquareRootInformation
from gradcal_jax.linalg import solve_transposed
from gradcal_jax.model import DISCREPANCY, Discrepancy, SensorModel

SEEN = 1e-4
"""Components whose gain is below this share of the largest gain are left out of the test."""
# The mixture ends where its remainder is smaller than this.
_NEGLIGIBLE = 1e-14
_BEYOND_PPM_OF_ALL = 1e12


def kept(info: SquareRootInformation, where: slice, std) -> Float[AnyArray, " k"]:
    """Ratio of posterior to prior variance of a discrepancy's coefficients, by component, in (0, 1].

    `where`: indices of the coefficients; `std`: their prior standard deviation, part of the information.
    Differentiable: the derivative of an eigenvalue needs no derivative of its vector.
    """
    xp, count = namespace(info.factor), where.stop - where.start
    rows = put(xp.zeros((count, info.scale.shape[0])), (np.arange(count), np.arange(where.start, where.stop)), 1.0)
    half = solve_transposed(info.factor, (rows / info.scale[None, :]).T) / std
    return kept_of(half.T @ half)


def kept_of(covariance: Float[AnyArray, "k k"]) -> Float[AnyArray, " k"]:
    """The same from the coefficients' posterior covariance over their prior variance."""
    xp = namespace(covariance)
    vectors = fixed(xp.linalg.eigh(fixed(covariance))[1])
    return xp.clip(xp.sum(vectors * (covariance @ vectors), axis=0), 0.0, 1.0)


def gains_of_shares(share: Float[np.ndarray, " k"], std: float) -> Float[np.ndarray, " s"]:
    """Gains `m_i` of the components in the test, per squared unit of a coefficient, from the shares `kept`."""
    every = (1.0 / np.asarray(share) - 1.0) / std**2
    return every[not_negligible(every)]


def not_negligible(gain: Float[np.ndarray, " k"]) -> np.ndarray:
    """The components in the test: those with a gain that is not negligible beside the largest."""
    largest = np.max(gain, initial=0.0)
    return gain > max(SEEN * largest, np.finfo(float).tiny)


@lru_cache(maxsize=64)
def quantiles(count: int, false_alarm: float) -> np.ndarray:
    """`F_{k+2j}(q)` for j = 0, 1, … with q the critical value of k components at the level of false alarms.

    Errors: `ValueError` for a level outside (0, 1).
    """
    from scipy.special import chdtr, chdtri

    if not 0.0 < false_alarm < 1.0:
        raise ValueError(f"a false-alarm probability must be between 0 and 1, not {false_alarm:g}")
    critical = chdtri(count, false_alarm)
    terms = 16
    while chdtr(count + 2 * terms, critical) > _NEGLIGIBLE:
        terms += 16
    return chdtr(count + 2 * np.arange(terms), critical)


def missed(share: Float[AnyArray, " k"], below: Float[AnyArray, " j"]):
    """Probability of a missed detection, `P(Σ y²/share ≤ q)`; `below` are `quantiles`. Differentiable."""
    xp, count = namespace(share), len(below)
    # No powers: their derivative would divide by a share that may be zero.
    steps = xp.concatenate([xp.ones((1, len(share))), xp.tile((1.0 - share)[None, :], (count - 1, 1))])
    sums = xp.sum(xp.cumprod(steps, axis=0), axis=1)
    place = np.arange(count)[:, None] - np.arange(count)[None, :]
    # 2j a_j − Σ b_(j−r) a_r = 0 is a triangular system; its first row is a_0.
    lower = xp.where(place > 0, -sums[np.maximum(place, 0)], 0.0) + np.diag(np.append(1.0, 2.0 * np.arange(1, count)))
    first = put(xp.zeros((count, 1)), (0, 0), xp.exp(0.5 * xp.sum(xp.log(share))))
    weights = solve_transposed(lower.T, first)[:, 0]
    return xp.sum(weights * below)


def power(gain: Float[np.ndarray, " s"], std: float, false_alarm: float) -> float:
    """Probability that a hidden map with coefficients of this standard deviation is detected; 0 without components."""
    if not len(gain):
        return 0.0
    return 1.0 - float(missed(1.0 / (1.0 + std**2 * gain), quantiles(len(gain), false_alarm)))


def noticed_from(gain: Float[np.ndarray, " s"], probability: float, false_alarm: float) -> float | None:
    """The smallest standard deviation that is detected with this probability; None where no plausible one is."""
    if not len(gain) or probability <= false_alarm:
        return None
    scale = 1.0 / float(np.sqrt(np.max(gain)))

    def short(log: float) -> float:
        return power(gain, scale * float(np.exp(log)), false_alarm) - probability

    low, high = -3.0, 3.0
    while short(high) < 0.0:
        high += 2.0
        if np.exp(high) > _BEYOND_PPM_OF_ALL:
            return None
    while short(low) > 0.0:
        low -= 2.0
    # Bisection: the import of a root finder takes longer than many predictions.
    while high - low > 1e-8:
        middle = 0.5 * (low + high)
        low, high = (low, middle) if short(middle) > 0.0 else (middle, high)
    return scale * float(np.exp(high))


def where_hidden(model: SensorModel, name: str) -> tuple[Discrepancy, slice] | None:
    """A model's discrepancy of a map ("bias", "scale_factor") and the indices of its coefficients, if it has one."""
    term = model.term(DISCREPANCY.format(name))
    return (term, model.where(term.name)) if isinstance(term, Discrepancy) else None
