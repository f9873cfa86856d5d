"""`gradcal recipe` and `gradcal show`: an executable recipe of a spec's plan, and a recipe as a table."""

from pathlib import Path

from gradcal_jax.cli.console import strong
from gradcal_jax.cli.output import Flag, Force, Json, OutputOrPrint, as_json, writable
from gradcal_jax.cli.precision import use_float64
from gradcal_jax.cli.status import DONE


def recipe(
    spec: Path,
    /,
    *,
    output: OutputOrPrint,
    keep_shapes: Flag = False,
    stable_within: str | None = None,
    stable_for: str | None = None,
    timeout: str | None = None,
    force: Force = False,
    json: Json = False,
) -> int:
    """Make a recipe of a spec's plan: rounded to the controllers' steps, with the prediction of the rounded plan.

    The steps of the controllers are those of [rig.resolution] in the spec; where it names none, 0.1 K, 0.1 s,
    0.01 deg/s and 0.001 deg, and always 0.01 K/min. `gradcal show` prints the recipe as a table.

    Parameters
    ----------
    spec
        The spec file; or a recipe, to make a new one of it.
    output
        The recipe file to write; - prints it.
    keep_shapes
        The table follows any shape of motion; without this, turns become trapezoids.
    stable_within
        A temperature counts as stable within this of its goal, such as "0.5 K".
    stable_for
        The time for which it must stay there, such as "5 min".
    timeout
        The run ends when the first temperature is not stable after so long, such as "4 h".
    json
        Print the name of the recipe, and its prediction after rounding, as JSON.
    """
    from gradcal_jax.files import Quantity, to_toml
    from gradcal_jax.files.recipe import spec_in
    from gradcal_jax.files.tracks import Stability

    specification = spec_in(spec)
    wishes = {
        "within": ("temperature difference", stable_within),
        "for_at_least": ("time", stable_for),
        "first_timeout": ("time", timeout),
    }
    limits = {name: Quantity.read(text, kind) for name, (kind, text) in wishes.items() if text is not None}
    stability = Stability.model_validate(limits)
    if str(output) != "-":
        writable(output, force)
    elif json:
        raise ValueError("-o - prints the recipe itself: leave --json out, or name a file")
    use_float64()
    from gradcal_jax import api

    result = api.recipe(specification, stability=stability, keep_shapes=keep_shapes)
    header = (
        "Made by gradcal; `gradcal show` prints it as a table. To change the plan, change the spec and make it anew."
    )
    text = to_toml(result, header=header)
    if str(output) == "-":
        print(text, end="")
        return DONE
    from gradcal_jax.files.writing import write_whole

    write_whole(output, text)
    if json:
        rows = [row.model_dump() for row in result.prediction.requirements]
        record = {"recipe": str(output), "fingerprint": result.fingerprint, "requirements": rows}
        print(as_json(record | {"rounded": list(result.rounded), "notes": list(result.notes)}))
        return DONE
    for note in result.notes:
        print(f"note: {note}")
    if result.rounded:
        print(f"rounded {len(result.rounded)} keys of the plan to the controllers' steps; the recipe lists them")
    print(f"wrote {output}; read it with: gradcal show {output}")
    return DONE


def show(recipe: Path, /, *, json: Json = False) -> int:
    """Print a recipe as a table: the steps of the chamber, those of the table, and the predicted residuals.

    Parameters
    ----------
    recipe
        The recipe file.
    json
        Print it as JSON instead.
    """
    from gradcal_jax.files.recipe import read_recipe
    from gradcal_jax.pages.bench_sheet import show as sheet

    contents = read_recipe(recipe)
    print(contents.model_dump_json(indent=2, exclude_none=True) if json else sheet(contents, heading=strong))
    return DONE
