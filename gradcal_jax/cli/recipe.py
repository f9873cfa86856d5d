"""The recipe of a plan: its stable temperatures, and the file that `gradcal optimise` writes."""

from collections.abc import Mapping
from pathlib import Path
from typing import TYPE_CHECKING, Final

from gradcal_jax.cli.output import as_json

_HEADER: Final = (
    "Made by gradcal; `gradcal check` prints it as a table. To change the plan, change the spec and make the "
    "recipe again."
)

if TYPE_CHECKING:
    from gradcal_jax.files.recipe import Recipe
    from gradcal_jax.files.spec_sections import Spec
    from gradcal_jax.files.tracks import Stability


def stability_of(wishes: Mapping[str, tuple[str, str | None]]) -> "Stability":
    """When a temperature counts as stable: for each key the kind of quantity, and its text or None."""
    from gradcal_jax.files import Quantity
    from gradcal_jax.files.tracks import Stability

    given = {name: Quantity.read(text, kind) for name, (kind, text) in wishes.items() if text is not None}
    return Stability.model_validate(given)


def write_recipe(spec: "Spec", output: Path, stability: "Stability", *, keep_shapes: bool, json: bool) -> None:
    """Write the recipe of a spec's own plan, or print it for the name "-"."""
    from gradcal_jax import api
    from gradcal_jax.files import to_toml

    result = api.recipe(spec, stability=stability, keep_shapes=keep_shapes)
    text = to_toml(result, header=_HEADER)
    if str(output) == "-":
        print(text, end="")
        return
    from gradcal_jax.files.writing import write_whole

    write_whole(output, text)
    if json:
        rows = [row.model_dump() for row in result.prediction.requirements]
        record = {"recipe": str(output), "fingerprint": result.fingerprint, "requirements": rows}
        print(as_json(record | {"rounded": list(result.rounded), "notes": list(result.notes)}))
        return
    print_notes(result, output)


def print_notes(result: "Recipe", output: Path) -> None:
    """What a recipe notes, and where it was written."""
    for note in result.notes:
        print(f"note: {note}")
    if result.rounded:
        print(f"rounded {len(result.rounded)} keys of the plan to the controllers' steps; the recipe lists them")
    print(f"wrote {output}; read it with: gradcal check {output}")
