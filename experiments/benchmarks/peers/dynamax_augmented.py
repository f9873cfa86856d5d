"""dynamax: the textbook filter with the parameters in the state, x = [θ, drift, β]; β's posterior covariance is G⁻¹."""

import importlib.metadata

import jax.numpy as jnp
from dynamax.linear_gaussian_ssm import lgssm_filter
from dynamax.linear_gaussian_ssm.inference import make_lgssm_params

from peers.jax_tasks import jax_tasks
from peers.problem import Problem, state_space


def build(problem: Problem) -> dict:
    count, p = problem.columns.shape
    size = p + 2

    def information(columns, durations):
        to_angle, kept, q_angle, q_cross, q_drift = state_space(problem, durations, jnp)
        transition = jnp.tile(jnp.eye(size), (count, 1, 1)).at[:, 0, 1].set(to_angle).at[:, 1, 1].set(kept)
        noise = jnp.zeros((count, size, size)).at[:, 0, 0].set(q_angle).at[:, 1, 1].set(q_drift)
        noise = noise.at[:, 0, 1].set(q_cross).at[:, 1, 0].set(q_cross)
        before = jnp.diag(
            jnp.concatenate([jnp.array([problem.reading_std**2, problem.drift_std**2]), 1.0 / problem.prior])
        )
        observed = jnp.concatenate([jnp.ones((count, 1)), jnp.zeros((count, 1)), columns], axis=1)[:, None, :]
        params = make_lgssm_params(
            jnp.zeros(size),
            # The package's initial state is the one at the first reading.
            transition[0] @ before @ transition[0].T + noise[0],
            transition,
            noise,
            observed,
            jnp.full((count, 1, 1), problem.reading_std**2),
        )
        found = lgssm_filter(params, jnp.zeros((count, 1))).filtered_covariances[-1][2:, 2:]
        return jnp.linalg.inv(found)

    return jax_tasks(problem, information) | {"version": f"dynamax {importlib.metadata.version('dynamax')}"}
