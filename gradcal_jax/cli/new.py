"""`gradcal new`: a commented spec to start from."""

import sys
from pathlib import Path
from typing import Annotated

from cyclopts import App, Parameter

from gradcal_jax.cli.output import Flag, writable
from gradcal_jax.cli.status import DONE
from gradcal_jax.pages.plain_text import columns


def register(app: App) -> None:
    """Add the commands of this family."""
    app.command(new)


def new(
    preset: str | None = None,
    /,
    *,
    output: Annotated[str | None, Parameter(name=["--output", "-o"], allow_leading_hyphen=True)] = None,
    listing: Annotated[bool, Parameter(name="--list", negative="")] = False,
    force: Flag = False,
) -> int:
    """Write a commented spec to start from.

    Parameters
    ----------
    preset
        Its name; see --list.
    output
        The file to write; - prints it.
    listing
        List the presets.
    force
        Overwrite an existing file.
    """
    from gradcal_jax.files import presets

    if listing:
        print(columns([(name, presets.title(name)) for name in presets.names()], indent=""))
        return DONE
    if preset is None:
        raise ValueError("which preset? List them with: gradcal new --list")
    text = presets.text(preset)
    if output is None or output == "-":
        if output is None:
            raise ValueError(f"where to? Write a file with: gradcal new {preset} -o my.toml (or -o - to print it)")
        sys.stdout.write(text)
        return DONE
    from gradcal_jax.files.writing import write_whole

    writable(Path(output), force)
    write_whole(output, text)
    print(f"wrote {output}; next: gradcal check {output}")
    return DONE
