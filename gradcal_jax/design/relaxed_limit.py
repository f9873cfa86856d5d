"""A lower limit on the residual of a scale factor after any plan, with its certificate.

**The relaxed problem.** A plan spends its motion time on rates and temperatures: a measure m on (T, ω). If the random
walk were the only error and every motion possible, the information would be `I(m) = ∫ ω²ψψᵀ dm / N²`; readings, drifts,
acceleration and travel only reduce it. So no plan is better than the minimum of `Ψ(I(m))` over all measures
whose total is the motion time and whose temperature marginal is the programme's.

**Convexity.** `√(φᵀI⁻¹φ) = sup_x φᵀx (xᵀIx)^(−1/2)` is convex in I, and so are means and maxima of it. For any weights
`w` that replace each maximum over temperature by a mean (`w ≥ 0`, summing to one for each rate), `Ψ_w = mean_j Σ_i w_ij
s_ij ≤ Ψ`.

**Certificate.** `Ψ_w` is convex and homogeneous of degree −½. With its gradient `−G`, `tr(G I) = Ψ_w/2`, and `d` the
largest `tr(G·I(m))` over the measures, every feasible I' and every c > 0 satisfy

    Ψ_w(I') = c^½ Ψ_w(cI') ≥ c^½ (Ψ_w + Ψ_w/2 − c·d),      best for c = Ψ_w/(2d):      Ψ_w(I') ≥ Ψ_w·√(Ψ_w/(2d)).

Any I gives a valid limit; a better one gives a tighter limit. A prior I₀ adds `tr(G·I₀)` to d. For fixed T the
integrand is a polynomial in ω, whose largest value is found from its derivative's roots. The root mean square is
handled likewise, with the weights `w = s/(nΨ)` of its own gradient (Cauchy–Schwarz).

A **discrepancy** γ joins the parameters with its prior. A calibration that does not carry γ̂ leaves
`cᵀCc + (χᵀΓχ − αᵀCα)`, α being χ's part of c, of which the bracket is not negative: the proof leaves it out.

N² may be replaced by a larger density, and a variance that no plan removes may be added to every residual (`floor`):
see `gradcal_jax.design.noise_floor`. Then Ψ_w is no longer homogeneous, and convexity alone gives
`Ψ_w(I') ≥ Ψ_w + tr(G I) − d`.
"""

from typing import NamedTuple

import numpy as np
import scipy.linalg
from numpy.polynomial import Chebyshev

from gradcal_jax.information.residual import Statistic, statistic
from gradcal_jax.model.terms import Discrepancy, Map

# Sharpness of the soft maximum by stage; between stages the most useful rates join the grid, with this weight.
_SHARPNESS = (8.0, 30.0, 100.0, 400.0, 2000.0, 10000.0)
_RATES = 25
_JOINS = 1e-3


class RelaxedProblem(NamedTuple):
    """Errors `rows` `(t, r, p)`, on a grid of `t` temperatures and `r` rates, of the parameters of `functions`, which
    are polynomials in rate.

    `floor` `(t,)`: a variance that no plan removes; `prior` `(q, p)`: whitened rows. The time is spread evenly over
    `temperatures` (°C), and rates are at most `max_rate` (rad/s). `gain`: motion time over noise density, s²/rad².
    """

    functions: tuple[Map | Discrepancy, ...]
    rows: np.ndarray
    floor: np.ndarray
    statistic: Statistic
    prior: np.ndarray
    temperatures: np.ndarray
    max_rate: float
    gain: float

    def moments(self, rates: np.ndarray) -> np.ndarray:
        """`(n, m, p)`, whose squares are the information of all time at a temperature and each of its `rates`
        `(n, m)`."""
        at = np.broadcast_to(self.temperatures[:, None], rates.shape)
        values = [np.asarray(function.values(at, rates)) for function in self.functions]
        return np.concatenate(values, axis=-1) * (rates * np.sqrt(self.gain))[..., None]

    def degree(self) -> int:
        """The degree in rate of squares of moments."""
        return 2 * max(function.rate.size for function in self.functions)


def relaxed_limit(problem: RelaxedProblem, *, tolerance: float = 2e-3) -> float:
    """The limit of a problem, SI: certified, and at most by the share `tolerance` below the problem's optimum."""
    grid = problem.max_rate * np.cos(np.pi * np.arange(_RATES) / (_RATES - 1))
    rates = np.tile(grid, (len(problem.temperatures), 1))
    logs, certified, reached = np.zeros_like(rates), 0.0, np.inf
    for sharpness in _SHARPNESS:
        logs = _descended(problem, rates, logs, sharpness)
        solution = _Solution(problem, problem.moments(rates), logs)
        limit, peaks = _certificate(problem, solution, sharpness)
        certified = max(certified, limit)
        reached = min(reached, float(np.asarray(statistic(problem.statistic, solution.values))))
        if reached <= certified * (1.0 + tolerance):
            break
        # Most statistics are symmetric in rate, so that the mirrored rate would be next.
        rates = np.concatenate([rates, peaks[:, None], -peaks[:, None]], axis=1)
        joined = np.max(logs, axis=1, keepdims=True) + np.log(_JOINS)
        logs = np.concatenate([logs, joined, joined], axis=1)
    return certified


class _Solution:
    """Residuals `values` `(t, r)` of a measure: at each temperature the shares of the rates with these `moments` are
    `softmax(logs)`, `(n, m)`."""

    def __init__(self, problem: RelaxedProblem, moments: np.ndarray, logs: np.ndarray):
        powers = np.exp(logs - np.max(logs, axis=1, keepdims=True))
        self.shares = powers / np.sum(powers, axis=1, keepdims=True)
        # From the weighted rows themselves: their product would lose half the digits.
        weighted = moments * np.sqrt(self.shares / len(logs))[..., None]
        rows = np.concatenate([weighted.reshape(-1, weighted.shape[-1]), problem.prior])
        self.size = np.linalg.norm(rows, axis=0)
        self.factor = np.linalg.qr(rows / self.size, mode="r")
        wanted = problem.rows.reshape(-1, len(self.size)) / self.size
        self.half = scipy.linalg.solve_triangular(self.factor, wanted.T, trans=1)
        variance = np.sum(self.half**2, axis=0).reshape(problem.rows.shape[:2])
        self.values = np.sqrt(variance + problem.floor[:, None])

    def useful(self, weights: np.ndarray) -> np.ndarray:
        """G, of which the mean of the residuals with these weights has the derivative `−tr(G dI)`."""
        inverse = scipy.linalg.solve_triangular(self.factor, self.half) / self.size[:, None]
        return (inverse * (weights / (2.0 * self.values)).ravel()) @ inverse.T


def _descended(problem: RelaxedProblem, rates: np.ndarray, logs: np.ndarray, sharpness: float) -> np.ndarray:
    """Logarithms of better shares `(n, m)` of the same rates."""
    from scipy.optimize import minimize

    moments = problem.moments(rates)

    def both(z: np.ndarray) -> tuple[float, np.ndarray]:
        solution = _Solution(problem, moments, z.reshape(logs.shape))
        value, slope = _soft(problem.statistic, solution.values, sharpness)
        density, shares = _squares(moments, solution.useful(slope)), solution.shares
        change = shares * (density - np.sum(shares * density, axis=1, keepdims=True)) / len(logs)
        return float(np.log(value)), -change.ravel() / value

    options = {"maxiter": 500, "maxfun": 700, "maxcor": 30, "ftol": 1e-14, "gtol": 1e-11}
    return minimize(both, logs.ravel(), jac=True, method="L-BFGS-B", options=options).x.reshape(logs.shape)


def _certificate(problem: RelaxedProblem, solution: _Solution, sharpness: float) -> tuple[float, np.ndarray]:
    """The lower limit that a measure certifies, and the most useful rate at each temperature."""
    values = solution.values
    weights = _soft(problem.statistic, values, sharpness)[1]
    if problem.statistic == "max":
        weights = weights / np.sum(weights)
    elif problem.statistic == "mean of max":
        weights = weights / (np.sum(weights, axis=0) * weights.shape[1])
    useful = solution.useful(weights)
    density, peaks = _largest(problem, useful)
    most = float(np.mean(density) + np.sum(_squares(problem.prior, useful)))
    value = float(np.sum(weights * values))
    enough = float(np.sum(weights / (2.0 * values) * (values**2 - problem.floor[:, None])))
    if np.any(problem.floor):
        return max(value + enough - most, 0.0), peaks
    return value * np.sqrt(min(enough / most, 1.0)), peaks


def _largest(problem: RelaxedProblem, useful: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """At each temperature the largest `mᵀGm` of the moments m at any rate, and the rate of it."""
    degree = problem.degree()
    nodes = np.cos(np.pi * (np.arange(degree + 1) + 0.5) / (degree + 1))
    rates = np.tile(problem.max_rate * nodes, (len(problem.temperatures), 1))
    largest, peaks = [], []
    for values in _squares(problem.moments(rates), useful):
        density = Chebyshev.fit(nodes, values, degree, domain=[-1.0, 1.0])
        roots = np.asarray(density.deriv().roots(), dtype=complex)
        real = np.real(roots[(np.abs(np.imag(roots)) < 1e-6) & (np.abs(np.real(roots)) < 1.0)])
        candidates = np.concatenate([[-1.0, 1.0], real])
        k = np.argmax(at := density(candidates))
        largest.append(at[k])
        peaks.append(problem.max_rate * candidates[k])
    return np.array(largest), np.array(peaks)


def _squares(rows: np.ndarray, matrix: np.ndarray) -> np.ndarray:
    """`mᵀ matrix m` of the last axis of `rows`."""
    return np.sum((rows @ matrix) * rows, axis=-1)


def _soft(name: Statistic, values: np.ndarray, sharpness: float) -> tuple[float, np.ndarray]:
    """A statistic with `(Σ s^k)^(1/k)` for a maximum, and its slope in each value."""
    if name == "mean":
        return float(np.mean(values)), np.full(values.shape, 1.0 / values.size)
    if name == "rms":
        value = float(np.sqrt(np.mean(values**2)))
        return value, values / (values.size * value)
    columns = values.reshape(-1, 1) if name == "max" else values
    top = np.max(columns, axis=0)
    total = np.sum((columns / top) ** sharpness, axis=0) ** (1.0 / sharpness)
    slope = (columns / (top * total)) ** (sharpness - 1.0) / columns.shape[1]
    return float(np.mean(top * total)), slope.reshape(values.shape)
