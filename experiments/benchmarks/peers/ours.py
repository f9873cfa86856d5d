"""gradcal_jax: the noise alone is filtered, the parameters stay outside; block-parallel."""

import jax
import jax.numpy as jnp

from gradcal_jax.information import NoiseSteps, gram
from peers.jax_tasks import jax_tasks
from peers.problem import Problem, state_space


def noise_steps(problem: Problem, durations) -> NoiseSteps:
    """The noise of a plain list of durations (s), as `gradcal_jax.information.noise_steps` makes it of a timeline."""
    to_angle, kept, q_angle, q_cross, q_drift = state_space(problem, durations, jnp)
    zero, one = jnp.zeros_like(durations), jnp.ones_like(durations)

    def square(a, b, c, d):
        return jnp.stack([jnp.stack([a, b], -1), jnp.stack([c, d], -1)], -2)

    return NoiseSteps(
        square(one, to_angle, zero, kept),
        square(q_angle, q_cross, q_cross, q_drift),
        jnp.stack([one, zero], -1),
        problem.reading_std**2 * one,
        jnp.ones(durations.shape, bool),
        jnp.diag(jnp.array([problem.reading_std**2, problem.drift_std**2])),
    )


def build(problem: Problem) -> dict:
    def information(columns, durations):
        return gram(noise_steps(problem, durations), columns) + jnp.diag(jnp.asarray(problem.prior))

    return jax_tasks(problem, information) | {"version": f"jax {jax.__version__}"}
