"""tinygp: its quasiseparable matrices, built from the same state-space model.

Element (i, j), i > j, is `p_i a_{i−1} … a_{j+1} q_j` with `p_i = H F_i`, `a_i = F_i`, `q_j = P_j Hᵀ` (P_j the state's
covariance at reading j). `cholesky()` and `solve()` do the rest.
"""

import jax.numpy as jnp
import tinygp
from tinygp.solvers.quasisep.core import DiagQSM, StrictLowerTriQSM, SymmQSM

from peers.jax_tasks import jax_tasks
from peers.problem import Problem, covariance, state_space


def build(problem: Problem) -> dict:
    def information(columns, durations):
        to_angle, kept, *_ = state_space(problem, durations, jnp)
        angle, cross = covariance(problem, durations, jnp)
        zero, one = jnp.zeros_like(durations), jnp.ones_like(durations)
        transition = jnp.stack([jnp.stack([one, to_angle], -1), jnp.stack([zero, kept], -1)], -2)
        lower = StrictLowerTriQSM(p=jnp.stack([one, to_angle], -1), q=jnp.stack([angle, cross], -1), a=transition)
        factor = SymmQSM(diag=DiagQSM(angle + problem.reading_std**2), lower=lower).cholesky()
        white = factor.solve(columns)
        return white.T @ white + jnp.diag(jnp.asarray(problem.prior))

    return jax_tasks(problem, information) | {"version": f"tinygp {tinygp.__version__}"}
