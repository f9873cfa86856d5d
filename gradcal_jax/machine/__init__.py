"""Machine code: compiled from C++ at first use, called by JAX on a CPU and by NumPy."""

from gradcal_jax.machine.by_platform import by_platform, like, linear_with_transpose
from gradcal_jax.machine.compiled import (
    CompiledSource,
    NotCompiled,
    call,
    compiled,
    compiler,
    double_or_single,
    is_at_hand,
)
from gradcal_jax.machine.sums import begin_sums, legendre_sums, running_sum_of_rows
