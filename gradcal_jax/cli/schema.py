"""`gradcal schema`: JSON Schema of every file and contract."""

from typing import Annotated

from cyclopts import App, Parameter

from gradcal_jax.cli.output import as_json
from gradcal_jax.cli.status import DONE


def register(app: App) -> None:
    """Add the commands of this family."""
    app.command(schema)


def schema(
    name: str | None = None, /, *, listing: Annotated[bool, Parameter(name="--list", negative="")] = False
) -> int:
    """Print the JSON Schema of a file or contract.

    Parameters
    ----------
    name
        Its name; see --list.
    listing
        List the names.
    """
    from gradcal_jax.files import schemas

    if listing:
        print("\n".join(schemas.names()))
        return DONE
    if name is None:
        raise ValueError(f"which one? Known: {', '.join(schemas.names())}")
    found = schemas.schema(name)
    if name.removeprefix("gradcal-").partition("/")[0] == "rig":
        from gradcal_jax.hardware.setup import with_options

        found = with_options(found)
    print(as_json(found))
    return DONE
