"""Lower limit for the misalignments of three gyros on two perpendicular axes that turn at given times.

White noise N² and the encoder of the inner axis count; all else is known. The inner axis stands along the body axis n,
and p, q complete the triad. Integrated over a turn about the direction u of the body, at most |ω|²dt/N² is learned of

* m_np and m_nq together in turns of the outer axis, where u ⊥ n;
* m_pn, and as much of m_qn, in turns of the inner axis, where u = n;
* s = (m_pq + m_qp)/2 and ρ = (m_qp − m_pq)/2 each, in turns of the outer axis.

ρ is a rotation of the gyros about n. No turn tells it from the error ε of the inner axis's angle, of which every
standstill k draws another one, with variance σ_k². Besides the encoder, the accelerometers see ε, by g² for each second
at most, and the gyro n sees its changes. So the observations of ρ have the noise ε of these three and the gyros' own,
and the variance of a linear estimate under a sum of noises is at least the sum of the variances under each alone.

With ψ(T) constant, ψ_k, in every standstill, the first of these informations is `E = Σψ_kψ_kᵀ(1/σ_k² + g²d_k/N_a²) +
Σ(ψ_{k+1} − ψ_k)(ψ_{k+1} − ψ_k)ᵀ/(N²τ_k)`, d the time of a standstill with half its neighbouring turns, τ that of a
turn. The second, W, is that of the outer axis's turns. The differences ψ − ψ_k in a standstill are free of ε, and from
`(a + b)(a + b)ᵀ ≼ (1 + η)aaᵀ + (1 + 1/η)bbᵀ` for all η > 0 follows

    J_ρ ≼ (1 + η)(E⁻¹ + W⁻¹)⁻¹ + (1 + 1/η)D,      D = ∫(ψ − ψ_k)(ψ − ψ_k)ᵀω²dt/N².

The sum of the standard deviations of m_pq and m_qp is convex in the information of (ρ, s) and does not change if ρ
changes its sign; so it is least without a covariance of the two: their mean is at least `√(ψᵀ(J_ρ⁻¹ + W⁻¹)ψ)`. A prior
is a reading; that of ρ is halved in its variance for each of the two noises.
"""

from typing import NamedTuple

import numpy as np

from gradcal_jax.information import statistic
from gradcal_jax.information.residual import Statistic

# η: any is valid, and the best of these is taken.
_ETA = (0.002, 0.005, 0.01, 0.02, 0.05, 0.1, 0.3)


class TurnNodes(NamedTuple):
    """Nodes in time of the turns of an axis: ψ `(n, p)`, the largest possible |ω|²dt (rad²/s) `(n,)`, and the
    standstill of the inner axis, by number, `(n,)`."""

    functions: np.ndarray
    squares: np.ndarray
    standstill: np.ndarray

    def information(self, noise: float) -> np.ndarray:
        """`(p, p)`: of a rate that is observed with the noise density N² = `noise` (rad²/s)."""
        return (self.functions * self.squares[:, None]).T @ self.functions / noise


class Standstills(NamedTuple):
    """The `K` standstills of an axis, in order: ψ `(K, p)`; information of the encoder and accelerometers on the angle,
    1/rad² `(K,)`; time of the turn after each but the last, s `(K − 1,)`."""

    functions: np.ndarray
    information: np.ndarray
    turns: np.ndarray


def misalignment_limit(
    outer: TurnNodes,
    inner: TurnNodes,
    standstills: Standstills,
    *,
    noise: float,
    prior: np.ndarray,
    at: np.ndarray,
    name: Statistic,
    worst: bool,
) -> float:
    """The least root mean square, or the least `worst`, of the statistic `name` over temperature of the standard
    deviations (rad) of the six misalignments.

    `noise` N², rad²/s; `prior` `(q, p)`: rows of the prior of one misalignment; `at` `(n, p)`: ψ at the temperatures of
    the statistic.
    """
    known, of_outer, of_inner = prior.T @ prior, outer.information(noise), inner.information(noise)

    def least(*information: np.ndarray) -> np.ndarray:
        """Standard deviations `(n, 1)` of the sum of independent parts."""
        return np.sqrt(sum(np.einsum("ip,pq,iq->i", at, np.linalg.pinv(part), at) for part in information))[:, None]

    steps = np.diff(standstills.functions, axis=0)
    of_angle = (standstills.functions * standstills.information[:, None]).T @ standstills.functions
    of_angle = of_angle + (steps / standstills.turns[:, None]).T @ steps / noise + 4.0 * known
    of_gyros = of_outer + 4.0 * known
    within = outer._replace(functions=outer.functions - standstills.functions[outer.standstill]).information(noise)
    both = np.linalg.pinv(np.linalg.pinv(of_angle) + np.linalg.pinv(of_gyros))
    of_sum = of_outer + 2.0 * known
    pair = max(statistic(name, least((1.0 + e) * both + (1.0 + 1.0 / e) * within, of_sum)) for e in _ETA)
    others = [statistic(name, least(part + known)) for part in (0.5 * of_outer, of_inner)]
    every = np.array([pair, *others])
    return float(np.max(every) if worst else np.sqrt(np.mean(every**2)))
