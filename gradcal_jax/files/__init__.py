"""Files as plain data: specs, contracts, presets. Nothing here imports JAX or the core.

`read_spec` gives a `Spec` whose quantities are SI and keep their text; `spec.schedule` is its plan resolved for the
rig. All problems of a file are in one `SpecError` that names every key.
"""

from gradcal_jax.files import presets
from gradcal_jax.files.changes import changed, tables_of
from gradcal_jax.files.contracts import Prediction
from gradcal_jax.files.problems import Problem, SpecError
from gradcal_jax.files.quantity import Quantity
from gradcal_jax.files.schemas import schema
from gradcal_jax.files.spec import Spec, parse_spec, read_spec, spec_of
from gradcal_jax.files.timeline import Timeline
from gradcal_jax.files.writing import to_toml, write_toml

__all__ = [
    "Prediction",
    "Problem",
    "Quantity",
    "Spec",
    "SpecError",
    "Timeline",
    "changed",
    "parse_spec",
    "presets",
    "read_spec",
    "schema",
    "spec_of",
    "tables_of",
    "to_toml",
    "write_toml",
]
