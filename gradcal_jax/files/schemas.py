"""JSON Schema of every file and contract, by name."""

from collections.abc import Mapping
from typing import Any, Final

from pydantic.json_schema import GenerateJsonSchema

from gradcal_jax.files.calibration import Calibration
from gradcal_jax.files.catalogue import CatalogueFile
from gradcal_jax.files.contracts import Prediction, Timeline
from gradcal_jax.files.importers import ColumnMap
from gradcal_jax.files.log_contents import LogContents
from gradcal_jax.files.problems import nearest
from gradcal_jax.files.quantity import Quantity
from gradcal_jax.files.recipe import Recipe
from gradcal_jax.files.rig import RigFile
from gradcal_jax.files.section import Section
from gradcal_jax.files.spec import Spec
from gradcal_jax.files.sweep import SweepFile

_MODELS: Final[Mapping[str, type[Section]]] = {
    "spec": Spec,
    "rig": RigFile,
    "timeline": Timeline,
    "prediction": Prediction,
    "columns": ColumnMap,
    "log": LogContents,
    "calibration": Calibration,
    "recipe": Recipe,
    "sweep": SweepFile,
    "catalogue": CatalogueFile,
}
_DIALECT: Final = "https://json-schema.org/draft/2020-12/schema"


class _WithTexts(GenerateJsonSchema):
    """Defaults that are quantities appear as the text that a file would hold."""

    def encode_default(self, dft: Any) -> Any:
        return dft.text if isinstance(dft, Quantity) else super().encode_default(dft)


def names() -> tuple[str, ...]:
    """The names that `schema` knows."""
    return tuple(_MODELS)


def schema(name: str) -> dict[str, Any]:
    """The JSON Schema of a file or contract, such as "spec"; quantities are text with units in files, SI in contracts.

    Errors: `ValueError` for other names.
    """
    plain = name.removeprefix("gradcal-").removesuffix("/1")
    if plain in _MODELS:
        body = _MODELS[plain].model_json_schema(mode="validation", schema_generator=_WithTexts)
        return {"$schema": _DIALECT, "$id": f"gradcal-{plain}/1", **body}
    close = nearest(plain, _MODELS)
    ending = f'; nearest: "{close}"' if close else f"; known: {', '.join(_MODELS)}"
    raise ValueError(f'there is no file or contract named "{name}"{ending}')
