"""What all methods in JAX have in common: compile `information(columns, durations)` and its gradient, wait for them."""

from collections.abc import Callable

import jax
import jax.numpy as jnp
import numpy as np

from peers.problem import Problem

jax.config.update("jax_enable_x64", True)


def log_det(information):
    return 2.0 * jnp.sum(jnp.log(jnp.diagonal(jnp.linalg.cholesky(information))))


def jax_tasks(problem: Problem, information: Callable, *, differentiate: Callable | None = None) -> dict:
    """Timed functions; `differentiate` is used for the gradient where a package has another entry point for it."""
    columns, durations = jnp.asarray(problem.columns), jnp.asarray(problem.durations)
    inner = differentiate or information
    forward = jax.jit(information)
    gradient = jax.jit(jax.value_and_grad(lambda c, d: log_det(inner(c, d)), argnums=(0, 1)))
    return {
        "forward": lambda: np.asarray(jax.block_until_ready(forward(columns, durations))),
        "gradient": lambda: jax.block_until_ready(gradient(columns, durations)),
    }
