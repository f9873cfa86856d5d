"""How the programs of a search are compiled."""

import os

import jax


def compiler_options() -> dict[str, bool | int]:
    """On a CPU XLA's optimisations take a fifth of the compile time and its fusion emitters, which speed small kernels
    up a little, a third; a search gains from neither. (JAX 0.11 refuses the second option.) A level in XLA_FLAGS is the
    user's."""
    if jax.default_backend() != "cpu":
        return {}
    emitters = {"xla_cpu_use_fusion_emitters": False} if jax.__version_info__ < (0, 11) else {}
    level = {} if "xla_backend_optimization_level" in os.environ.get("XLA_FLAGS", "") else {
        "xla_backend_optimization_level": 1
    }  # fmt: skip
    return level | emitters
