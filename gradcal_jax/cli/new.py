"""`gradcal new`: a commented spec to start from."""

import sys
from pathlib import Path
from typing import Annotated

from cyclopts import App, Parameter


def register(app: App) -> None:
    """Add the commands of this family."""
    app.command(new)


def new(
    preset: str | None = None,
    /,
    *,
    output: Annotated[str | None, Parameter(name=["--output", "-o"], allow_leading_hyphen=True)] = None,
    listing: Annotated[bool, Parameter(name="--list", negative="")] = False,
    force: Annotated[bool, Parameter(negative="")] = False,
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
    from gradcal_jax.cli.console import columns
    from gradcal_jax.files import presets

    if listing:
        print(columns([(name, presets.title(name)) for name in presets.names()], indent=""))
        return 0
    if preset is None:
        raise ValueError("which preset? List them with: gradcal new --list")
    text = presets.text(preset)
    if output is None or output == "-":
        if output is None:
            raise ValueError(f"where to? Write a file with: gradcal new {preset} -o my.toml (or -o - to print it)")
        sys.stdout.write(text)
        return 0
    _write(Path(output), text, force)
    print(f"wrote {output}; next: gradcal check {output}")
    return 0


def _write(path: Path, text: str, force: bool) -> None:
    if path.is_dir():
        raise ValueError(f"{path} is a directory; name a file in it")
    if path.exists() and not force:
        raise ValueError(f"{path} exists; choose another name, or overwrite it with --force")
    if not path.parent.is_dir():
        raise ValueError(f"there is no directory {path.parent}; make it first")
    from gradcal_jax.files.writing import write_whole

    write_whole(path, text)
