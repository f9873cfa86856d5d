"""A lower limit on the residual of any plan, with its certificate.

**The relaxed problem.** A plan spends its motion time on rates and temperatures: a measure m on (T, ω). Were the
random walk the only error and every motion possible, the information would be `I(m) = ∫ ω²ψψᵀ dm / N²`; readings,
drifts, acceleration and travel only take from it. So no plan does better than the least `Ψ(I(m))` over all measures
whose total is the motion time and whose temperature marginal is the programme's (or any, where the programme is free).

**Convexity.** `√(φᵀI⁻¹φ) = sup_x φᵀx (xᵀIx)^(−1/2)` is convex in I; means and maxima keep that. For any weights `w`
that give each maximum over temperature a mean instead (`w ≥ 0`, summing to one for each rate), `Ψ_w = mean_j Σ_i w_ij
s_ij ≤ Ψ`.

**Certificate.** `Ψ_w` is convex and homogeneous of degree −½. With its gradient `−G`, `tr(G I) = Ψ_w/2`, and `d` the
largest `tr(G·I(m))` over the measures, every feasible I' and every c > 0 satisfy

    Ψ_w(I') = c^½ Ψ_w(cI') ≥ c^½ (Ψ_w + Ψ_w/2 − c·d),      best for c = Ψ_w/(2d):      Ψ_w(I') ≥ Ψ_w·√(Ψ_w/(2d)).

Any I certifies; a good one certifies much. A prior I₀ adds `tr(G·I₀)` to d. The largest integrand over ω is a
polynomial's, of degree n, sampled at m Chebyshev points: its true maximum is at most the sampled one over
`cos(nπ/2m)` (Ehlich and Zeller, 1964), and d is enlarged by that.

**Drift and readings.** With readings at least Δ apart, of variance R each, N² may be replaced by the least over λ of

    S(λ) = N² + Σ 2σ²τ/(1 + λ²τ²) + R λ²/(1/Δ + ε/2 + λ²/(2ε))        for any ε > 0:

the integrated error is seen through a window of frequencies in which drift and readings cost the more the slower, and
the faster, the motion is. A design that stays below every frequency cannot be (large-sieve inequality); the best ε is
taken.
"""

from typing import NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array
from scipy.optimize import minimize

from gradcal_jax.design.criteria import Criterion
from gradcal_jax.errormodel import GyroModel, Polynomial
from gradcal_jax.information import square_root

_SHARPNESS = (20.0, 100.0, 500.0, 2000.0)
_RATES = 161


class Limit(NamedTuple):
    """`certified`: no plan does better; `reached`: the relaxed problem's best value; both in the criterion's SI unit.

    `noise_density`: the rad²/s that stood for N². The truth of the relaxed problem lies between the two.
    """

    certified: float
    reached: float
    noise_density: float


def limit(
    criterion: Criterion,
    model: GyroModel,
    *,
    motion_time: float,
    temperatures: np.ndarray,
    fixed_programme: bool,
    max_rate: float,
    noise_density: float,
) -> Limit:
    """The limit for a scale-factor criterion, B(T) known or not (knowing it only helps, so the limit holds).

    `motion_time` s: of the axis; `temperatures` °C: a grid on which the motion time is spread evenly
    (`fixed_programme`) or as it likes. `noise_density` rad²/s: N², or `least_noise_density`.
    """
    if model.scale is None or not isinstance(model.scale.rate, Polynomial):
        raise ValueError("the limit is for a scale factor that is polynomial in rate: give the model such a map")
    rates = max_rate * np.cos(np.pi * (np.arange(_RATES) + 0.5) / _RATES)
    grid_t, grid_w = np.meshgrid(temperatures, rates, indexing="ij")
    columns = model.columns
    moments = np.zeros((grid_t.size, columns.count))
    values = np.asarray(model.scale.values(jnp.asarray(grid_t.ravel()), jnp.asarray(grid_w.ravel())))
    moments[:, columns.scale] = values * grid_w.reshape(-1, 1) * np.sqrt(motion_time / noise_density)
    prior = np.asarray(model.prior_rows())
    # Columns other than M's are taken as known: that is information added, never taken away.
    other = np.setdiff1d(np.arange(columns.count), np.arange(columns.scale.start, columns.scale.stop))
    known = np.zeros((len(other), columns.count))
    known[np.arange(len(other)), other] = 1.0
    fixed = jnp.asarray(np.concatenate([prior, known]))
    shape = grid_t.shape
    points = jnp.asarray(moments)

    def weights(z: Array) -> Array:
        """The measure: for each temperature a distribution over rate, or one distribution over both."""
        z = jnp.reshape(z, shape)
        if fixed_programme:
            return jnp.reshape(jax.nn.softmax(z, axis=1) / shape[0], (-1,))
        return jax.nn.softmax(jnp.reshape(z, (-1,)))

    def root(z: Array):
        return square_root(jnp.concatenate([points * jnp.sqrt(weights(z))[:, None], fixed]))

    smooth = eqx.filter_jit(jax.value_and_grad(lambda z, k: jnp.log(criterion(root(z), k))))
    z = np.zeros(grid_t.size)
    best = Limit(0.0, np.inf, noise_density)
    for sharpness in _SHARPNESS:
        k = jnp.asarray(sharpness)

        def both(z, k=k):
            value, gradient = smooth(jnp.asarray(z), k)
            return float(value), np.asarray(gradient)

        z = minimize(both, z, jac=True, method="L-BFGS-B", options={"maxiter": 300, "maxfun": 400}).x
        certified, reached = _certificate(
            criterion, root(jnp.asarray(z)), moments, shape, fixed, k, 2 * model.scale.rate.size, fixed_programme
        )
        best = Limit(max(best.certified, certified), min(best.reached, reached), noise_density)
    return best


def _certificate(criterion, info, moments, shape, fixed, sharpness, degree: int, fixed_programme: bool):
    """`Ψ_w·√(Ψ_w/(2d))` and the exact Ψ at an information matrix; see the module's head."""
    values = criterion.map(info)
    peak = jnp.max(values, axis=0)
    if criterion.statistic in ("mean of max", "max"):
        near = jax.nn.softmax(sharpness * (values - peak[None]) / peak[None], axis=0) / values.shape[1]
        if criterion.statistic == "max":
            top = jnp.max(values)
            near = jax.nn.softmax(jnp.ravel(sharpness * (values - top) / top)).reshape(values.shape)
        exact = float(jnp.mean(peak)) if criterion.statistic == "mean of max" else float(jnp.max(values))
    elif criterion.statistic == "mean":
        near, exact = jnp.full(values.shape, 1.0 / values.size), float(jnp.mean(values))
    else:
        raise ValueError(
            f"there is no limit for the statistic {criterion.statistic!r}: ask for mean of max, max or mean"
        )
    weighted = float(jnp.sum(near * values))
    # G = Σ w/(2s)·(I⁻¹φ)(I⁻¹φ)ᵀ, by two triangular solves.
    scaled = (criterion.rows / info.scale[None, :]).T
    half = jax.scipy.linalg.solve_triangular(info.factor, scaled, trans=1, lower=False)
    solved = jax.scipy.linalg.solve_triangular(info.factor, half, lower=False) / info.scale[:, None]
    share = jnp.ravel(near / (2.0 * values))
    rows = jnp.asarray(moments)
    density = jnp.reshape(jnp.sum((rows @ solved) ** 2 * share[None, :], axis=1), shape)
    largest = jnp.max(density, axis=1) / np.cos(degree * np.pi / (2 * shape[1]))
    attained = jnp.mean(largest) if fixed_programme else jnp.max(largest)
    given = jnp.sum(jnp.sum((fixed @ solved) ** 2, axis=0) * share)
    most = float(attained + given)
    return weighted * np.sqrt(min(weighted / (2.0 * most), 1.0)), exact


def least_noise_density(model: GyroModel, spacing: float) -> float:
    """`max_ε min_λ S(λ)` in rad²/s, for readings at least `spacing` s apart; never below N².

    Only processes that drive the angle at any rate (bias_gain) count, and only the white noise of a reading.
    """
    walk = float(model.angle_random_walk) ** 2
    p = model.processes
    decay, diffusion = np.asarray(p.decay), np.asarray(p.diffusion)
    gain = np.where(np.asarray(p.rate_gain) == 0.0, np.asarray(p.bias_gain), 0.0)
    variance = float(model.reference.reading_noise) ** 2
    frequency = np.concatenate([[0.0], np.geomspace(1e-7, 1e3, 4001)])[:, None]
    # q²/(λ² + 1/τ²): for a Gauss-Markov process 2σ²τ/(1 + λ²τ²).
    below = np.maximum(frequency**2 + decay[None] ** 2, 1e-300)
    drift = np.sum((gain * diffusion)[None] ** 2 / below, axis=1)

    def worst(log_epsilon: float) -> float:
        epsilon = np.exp(log_epsilon)
        square = frequency[:, 0] ** 2
        window = 1.0 / spacing + epsilon / 2.0 + square / (2.0 * epsilon)
        return float(np.min(walk + drift + variance * square / window))

    # Any ε gives a valid limit, so a grid is enough.
    return max(walk, *(worst(x) for x in np.linspace(-15.0, 10.0, 251)))
