"""A lower limit on the residual of any plan, with its certificate.

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

Any I gives a valid limit; a better one gives a tighter limit. A prior I₀ adds
`tr(G·I₀)` to d. For fixed T the integrand is a polynomial in ω, whose largest value is found from its derivative's
roots. The root mean square is handled likewise, with the weights `w = s/(nΨ)` of its own gradient (Cauchy–Schwarz).

A **discrepancy** γ joins the parameters with its prior. A calibration that does not carry γ̂ leaves
`cᵀCc + (χᵀΓχ − αᵀCα)`, α being χ's part of c, of which the bracket is not negative: the proof leaves it out.

N² may be replaced by a larger density, and a variance that no plan removes may be added to every residual: see
`gradcal_jax.design.noise_floor`. Then Ψ_w is no longer homogeneous, and convexity alone gives
`Ψ_w(I') ≥ Ψ_w + tr(G I) − d`.
"""

from typing import NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import scipy.linalg
from jaxtyping import Array, Float
from numpy.polynomial import chebyshev

from gradcal_jax.design.criteria import Criterion
from gradcal_jax.design.noise_floor import root_of
from gradcal_jax.model import Polynomial, SensorModel

# Sharpness of the soft maximum by stage; between stages the most useful rates join the grid.
_SHARPNESS = (8.0, 30.0, 100.0, 400.0, 2000.0, 10000.0)
_RATES = 25
# Logarithm of the weight of an empty column: its rate is zero and carries no information.
_EMPTY = -30.0
# Temperatures on which a maximum over temperature is searched.
_TEMPERATURES = 26


class Limit(NamedTuple):
    """`certified`: no plan is better; `reached`: the best value computed for the relaxed problem; both in the
    criterion's SI unit. The optimum of the relaxed problem lies between the two.
    """

    certified: float
    reached: float


def limit(
    criterion: Criterion,
    model: SensorModel,
    *,
    motion_time: float,
    temperatures: np.ndarray,
    max_rate: float,
    noise_density: float,
    floor: Float[np.ndarray, " g"] | None = None,
    prior_share: float = 1.0,
    tolerance: float = 2e-3,
) -> Limit:
    """The limit for a scale-factor criterion, whether B(T) is known or not (knowing it only adds information).

    `motion_time` s: of the axis; `temperatures` °C: points over which the motion time is spread
    evenly. `noise_density` rad²/s: N², see `least_noise_density`.
    `floor`: a variance that no plan removes, of each of the criterion's rows. `prior_share`: the share of
    the prior's variance that counts here, where `floor` counts the rest. `tolerance`: largest relative difference of
    `certified` and `reached`.
    Errors: `ValueError` for a criterion or a map that the proof does not cover.
    """
    # A discrepancy adds a variance that is not negative, which the proof leaves out: see the module's head.
    added = np.zeros(len(criterion.rows)) if floor is None else floor
    criterion = Criterion(criterion.rows, None, added, criterion.shape, criterion.statistic)
    if model.scale is None or not isinstance(model.scale.rate, Polynomial):
        raise ValueError("this limit exists only for a scale factor that is a polynomial in rate")
    arguments = model, motion_time / noise_density, prior_share, np.asarray(temperatures)
    # A maximum over fewer temperatures is no larger, so its certificate is valid for all of them.
    problem, whole = _Problem(_thinned(criterion), *arguments), _Problem(criterion, *arguments)
    # Useful rates fill the empty columns, so that every stage has the same shape and is compiled once.
    grid = max_rate * np.cos(np.pi * np.arange(_RATES) / (_RATES - 1))
    # Of every stage: at each temperature the most useful rate, and the mirrored one.
    rates = np.tile(np.concatenate([grid, np.zeros(2 * len(_SHARPNESS))]), (len(temperatures), 1))
    logs = np.where(np.arange(rates.shape[1]) < _RATES, 0.0, _EMPTY) + np.zeros_like(rates)
    best = Limit(0.0, np.inf)
    for stage, sharpness in enumerate(_SHARPNESS):
        logs = problem.solve(rates, logs, sharpness)
        certified, peaks = problem.certify(rates, logs, sharpness, max_rate)
        best = Limit(max(best.certified, float(certified)), min(best.reached, whole.value(rates, logs)))
        if best.reached <= best.certified * (1.0 + tolerance):
            break
        # Most criteria are symmetric in rate, so that the mirrored rate would be next.
        columns = slice(_RATES + 2 * stage, _RATES + 2 * (stage + 1))
        rates[:, columns] = np.stack([peaks, -peaks], axis=1)
        logs[:, columns] = np.max(logs, axis=1, keepdims=True) + np.log(1e-3)
    return best


class _Problem:
    """The relaxed problem in columns of about unit size."""

    def __init__(self, criterion, model: SensorModel, gain: float, prior_share: float, temperatures):
        self.criterion, self.model = criterion, model
        self.temperatures = temperatures
        # Information of a unit rate in the whole time.
        self.gain = gain
        assert model.scale is not None
        of_map = [model.scale] if model.scale.beyond is None else [model.scale, model.scale.beyond]
        self.functions = of_map
        where = np.concatenate([np.arange(model.size)[model.where(term.name)] for term in of_map])
        # All other columns are taken as known, which only adds information.
        self.rows = np.asarray(criterion.rows)[:, where]
        prior = model.prior_rows()[:, where]
        self.prior = prior.T @ prior / prior_share
        self.beyond = np.asarray(criterion.beyond)

    def moments(self, k: np.ndarray, rate: np.ndarray) -> np.ndarray:
        """Rows whose squares are the information of all time at the temperature k and a rate."""
        values = np.concatenate([term.values(self.temperatures[k], rate) for term in self.functions], axis=1)
        return values * (rate * np.sqrt(self.gain))[:, None]

    def solve(self, rates: np.ndarray, logs: np.ndarray, sharpness: float) -> np.ndarray:
        """Logarithms of better weights `(n_T, m)` on the same rates, by L-BFGS."""
        from scipy.optimize import minimize

        arrays = [jnp.asarray(a) for a in (self._points(rates), self.prior, self.rows, self.beyond, sharpness)]

        def both(z):
            how = self.criterion.statistic, self.criterion.shape
            value, gradient = _value(jnp.asarray(z.reshape(logs.shape)), *arrays, *how)
            return float(value), np.asarray(gradient).ravel()

        options = {"maxiter": 500, "maxfun": 700, "maxcor": 30, "ftol": 1e-14, "gtol": 1e-11}
        return minimize(both, logs.ravel(), jac=True, method="L-BFGS-B", options=options).x.reshape(logs.shape)

    def _points(self, rates: np.ndarray) -> np.ndarray:
        return self.moments(np.repeat(np.arange(len(rates)), rates.shape[1]), rates.ravel())

    def _halves(self, rates, logs) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Columns' sizes, the triangular factor R of the scaled information, and R⁻ᵀ of the criterion's rows."""
        weights = np.asarray(_shares(jnp.asarray(logs)))
        # From the weighted rows themselves: their product would lose half the digits.
        weighted = np.concatenate([self._points(rates) * np.sqrt(weights).reshape(-1, 1), root_of(self.prior)])
        size = np.linalg.norm(weighted, axis=0)
        factor = np.asarray(np.linalg.qr(weighted / size, mode="r"))
        return size, factor, scipy.linalg.solve_triangular(factor, (self.rows / size).T, trans=1)

    def value(self, rates, logs) -> float:
        """The exact criterion at these weights."""
        half = self._halves(rates, logs)[2]
        return _dual(self._deviations(half), self.criterion.statistic, np.inf)[0]

    def _deviations(self, half: np.ndarray) -> np.ndarray:
        return np.sqrt(np.sum(half**2, axis=0) + self.beyond).reshape(self.criterion.shape)

    def certify(self, rates, logs, sharpness: float, max_rate: float) -> tuple[float, np.ndarray]:
        """The lower limit that these weights certify, and the most useful rate at each temperature."""
        size, factor, half = self._halves(rates, logs)
        values = self._deviations(half)
        near = _dual(values, self.criterion.statistic, sharpness)[1]
        useful = scipy.linalg.solve_triangular(factor, half).T / size[None, :]
        share, value = (near / (2.0 * values)).ravel(), float(np.sum(near * values))
        enough = float(share @ np.sum(half**2, axis=0))
        density, peaks = self._largest(useful, share, max_rate)
        most = float(np.mean(density))
        most += float(share @ np.einsum("gi,ij,gj->g", useful, self.prior, useful))
        if np.any(self.beyond):
            return max(value + enough - most, 0.0), peaks
        return value * np.sqrt(min(enough / most, 1.0)), peaks

    def _largest(self, useful: np.ndarray, weights: np.ndarray, max_rate: float) -> tuple[np.ndarray, np.ndarray]:
        """At each temperature the largest mean of `Σ weights·(useful·m)²` over the rates, and the rate of it."""
        scale = self.model.scale
        assert scale is not None
        assert scale.rate is not None
        beyond = None if scale.beyond is None else scale.beyond.rate
        degree = 2 * max(scale.rate.size, 0 if beyond is None else beyond.lowest + beyond.size)
        nodes = np.cos(np.pi * (np.arange(degree + 1) + 0.5) / (degree + 1))
        largest, where = [], []
        for k in range(len(self.temperatures)):
            rows = self.moments(np.full(degree + 1, k), max_rate * nodes)
            polynomial = chebyshev.chebfit(nodes, ((rows @ useful.T) ** 2) @ weights, degree)
            inner = np.asarray(chebyshev.chebroots(chebyshev.chebder(polynomial)), dtype=complex)
            real = np.real(inner[np.abs(np.imag(inner)) < 1e-6])
            candidates = np.concatenate([[-1.0, 1.0], real[np.abs(real) < 1.0]])
            value = chebyshev.chebval(candidates, polynomial)
            where.append(max_rate * candidates[np.argmax(value)])
            largest.append(float(np.max(value)))
        return np.array(largest), np.array(where)


def _thinned(criterion: Criterion) -> Criterion:
    """A criterion with a maximum over temperature on fewer temperatures, ends included; others unchanged."""
    if criterion.statistic not in ("max", "mean of max"):
        return criterion
    every, across = criterion.shape
    kept = np.unique(np.round(np.linspace(0, every - 1, min(every, _TEMPERATURES))).astype(int))
    some = lambda v: v.reshape(every, across, -1)[kept].reshape(len(kept) * across, -1)  # noqa: E731
    return Criterion(some(criterion.rows), None, some(criterion.beyond)[:, 0], (len(kept), across), criterion.statistic)


def _shares(logs: Float[Array, "n m"]) -> Float[Array, "n m"]:
    """The measure: for each temperature a distribution over rate."""
    return jax.nn.softmax(logs, axis=1) / logs.shape[0]


def _relaxed(logs, points, prior, rows, beyond, sharpness, statistic: str, shape) -> Array:
    """The logarithm of the smooth criterion at these weights."""
    weights = jnp.reshape(_shares(logs), (-1, 1))
    information = (points * weights).T @ points + prior
    size = jnp.sqrt(jnp.diag(information))
    factor = jnp.linalg.cholesky(information / size[:, None] / size[None, :])
    # The inverse of a small factor and one product: XLA solves for many right-hand sides one after another.
    half = jax.scipy.linalg.solve_triangular(factor, jnp.eye(len(size)), lower=True) @ (rows / size[None, :]).T
    values = jnp.reshape(jnp.sqrt(jnp.sum(half**2, axis=0) + beyond), shape)
    if statistic == "mean":
        return jnp.log(jnp.mean(values))
    if statistic == "rms":
        return 0.5 * jnp.log(jnp.mean(values**2))
    if statistic == "max":
        values = jnp.reshape(values, (-1, 1))
    top = jnp.max(values, axis=0)
    return jnp.log(jnp.mean(top * jnp.sum((values / top[None, :]) ** sharpness, axis=0) ** (1.0 / sharpness)))


_value = eqx.filter_jit(jax.value_and_grad(_relaxed))


def _dual(values: np.ndarray, statistic: str, sharpness: float) -> tuple[float, np.ndarray]:
    """The exact statistic Ψ, and weights with `Σ w·s ≤ Ψ(s)` for every s."""
    if statistic == "mean":
        return float(np.mean(values)), np.full(values.shape, 1.0 / values.size)
    if statistic == "rms":
        value = float(np.sqrt(np.mean(values**2)))
        return value, values / (values.size * value)
    if statistic == "max":
        near = (values / np.max(values)) ** (sharpness - 1.0)
        return float(np.max(values)), near / np.sum(near)
    top = np.max(values, axis=0)
    near = (values / top) ** (sharpness - 1.0)
    return float(np.mean(top)), near / np.sum(near, axis=0) / values.shape[1]
