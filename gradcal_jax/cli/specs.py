"""Where commands take a spec they take a recipe too: then its own spec, whose plan is the rounded one."""

from pathlib import Path
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from gradcal_jax.files import Spec


def read_spec(path: Path) -> "Spec":
    """The spec in a file, or the one inside a recipe. Raises `SpecError` that lists everything wrong with it."""
    from gradcal_jax.files import spec_of
    from gradcal_jax.files.document import read_text, read_toml
    from gradcal_jax.files.recipe import is_recipe, recipe_of

    document = read_toml(read_text(path), str(path))
    if is_recipe(document):
        return recipe_of(document, str(path)).spec
    return spec_of(document, str(path))
