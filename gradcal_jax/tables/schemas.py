"""JSON Schema of every file and contract, by name."""

from importlib import import_module
from typing import Any, Final, get_args

from pydantic.json_schema import GenerateJsonSchema

from gradcal_jax.tables.problems import hint
from gradcal_jax.tables.quantity import Quantity
from gradcal_jax.tables.section import Section

# By module and class, so that a program that reads specs does not load the importers of logs.
_MODELS: Final = {
    "spec": "spec.spec_sections.Spec",
    "rig": "spec.rig.RigFile",
    "lines": "hardware.line_protocol.LineProtocol",
    "registers": "hardware.register_protocol.RegisterProtocol",
    "text": "hardware.text_unit.TextSensor",
    "prediction": "spec.contracts.Prediction",
    "columns": "records.column_map.ColumnMap",
    "calibration": "calibration.file.Calibration",
    "recipe": "recipe.recipe.Recipe",
    "sweep": "sweeps.sweep_file.SweepFile",
}
_DIALECT: Final = "https://json-schema.org/draft/2020-12/schema"


class _WithTexts(GenerateJsonSchema):
    """Writes defaults that are quantities as the text of a file."""

    def encode_default(self, dft: Any) -> Any:
        return dft.text if isinstance(dft, Quantity) else super().encode_default(dft)


def schema_names() -> tuple[str, ...]:
    """The names that `schema` knows."""
    return tuple(_MODELS)


def schema(name: str) -> dict[str, Any]:
    """The JSON Schema of a file or contract, such as "spec"; quantities are text with units in files, SI in contracts.

    Errors: `ValueError` for other names.
    """
    if name not in _MODELS:
        ending = hint(name, _MODELS, f"; known: {', '.join(_MODELS)}")
        raise ValueError(f'there is no file or contract named "{name}"{ending}')
    module, _, model = _MODELS[name].rpartition(".")
    section: type[Section] = getattr(import_module(f"gradcal_jax.{module}"), model)
    body = section.model_json_schema(mode="validation", schema_generator=_WithTexts)
    (version,) = get_args(section.model_fields["format"].annotation)
    return {"$schema": _DIALECT, "$id": version, **body}
