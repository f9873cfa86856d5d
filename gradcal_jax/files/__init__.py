"""Files as plain data: specs, contracts, presets. Nothing here imports JAX or the core.

`read_spec` gives a `Spec` whose quantities are SI and keep their text; `spec.schedule` is its plan resolved for the
rig. All problems of a file are in one `SpecError` that names every key.
"""

from gradcal_jax.files import presets
from gradcal_jax.files.base.contracts import Prediction
from gradcal_jax.files.base.problems import Problem, SpecError
from gradcal_jax.files.base.quantity import Quantity
from gradcal_jax.files.base.schemas import schema
from gradcal_jax.files.base.timeline import Timeline
from gradcal_jax.files.base.writing import to_toml, write_toml
from gradcal_jax.files.spec.changes import changed, tables_of
from gradcal_jax.files.spec.spec import Spec, parse_spec, read_spec, spec_of

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
