"""Plain data that people write and read: specs, contracts, logs. Nothing here imports JAX or the core."""

from gradcal_jax.files.problems import Problem, SpecError
from gradcal_jax.files.quantity import Quantity
from gradcal_jax.files.spec import Spec, parse_spec, read_spec, spec_of

__all__ = ["Problem", "Quantity", "Spec", "SpecError", "parse_spec", "read_spec", "spec_of"]
