"""Code for the very machine: made from C++ at first use, called by JAX on a CPU and by NumPy."""

from gradcal_jax.machine.by_platform import by_platform, like, linear_with_transpose
from gradcal_jax.machine.compiled import Compiled, call, compiled, compiler, double_or_single
from gradcal_jax.machine.sums import legendre_sums, running_sum
