"""celerite2: its semiseparable solver, fed with this very covariance.

Its kernels are sums of stationary exponentials and cannot say "random walk" or "integrated drift". Its solver can: with
decays (0, 1/τ) the factors U, V may be any functions of time, and for s < t

    Cov(θ_t, θ_s) = Var θ_s + τ Cov(θ_s, x_s)·(1 − e^(−(t−s)/τ))
                  = 1·(Var θ_s + τ Cov(θ_s, x_s)) + e^(−(t−s)/τ)·(−τ Cov(θ_s, x_s)).

So the low-level calls are used, not a kernel. Forward by the C++ driver, gradient by the package's JAX operations.
"""

import celerite2
import jax.numpy as jnp
import numpy as np
from celerite2 import driver
from celerite2.jax import ops

from peers.jax_tasks import jax_tasks
from peers.problem import Problem, covariance


def semiseparable(problem: Problem, durations, xp):
    """`t, c, a, U, V` of celerite2's solver."""
    angle, cross = covariance(problem, durations, xp)
    tau = problem.correlation_time
    lower = xp.stack([angle + tau * cross, -tau * cross], -1)
    return xp.cumsum(durations), xp.array([0.0, 1.0 / tau]), angle + problem.reading_std**2, xp.ones_like(lower), lower


def build(problem: Problem) -> dict:
    columns, durations, prior = problem.columns, problem.durations, np.diag(problem.prior)

    def forward():
        time, decay, diagonal, upper, lower = semiseparable(problem, durations, np)
        spread, weights = np.empty_like(diagonal), np.empty_like(lower)
        spread, weights = driver.factor(time, decay, diagonal, upper, lower, spread, weights)
        white = driver.solve_lower(time, decay, upper, weights, columns, np.empty_like(columns))
        white /= np.sqrt(spread)[:, None]
        return white.T @ white + prior

    def information(columns, durations):
        time, decay, diagonal, upper, lower = semiseparable(problem, durations, jnp)
        spread, weights = ops.factor(time, decay, diagonal, upper, lower)
        white = ops.solve_lower(time, decay, upper, weights, columns) / jnp.sqrt(spread)[:, None]
        return white.T @ white + jnp.asarray(prior)

    return jax_tasks(problem, information) | {"forward": forward, "version": f"celerite2 {celerite2.__version__}"}
