"""A hook of mkdocs: the page api.md, in which mkdocstrings fills in the docstrings of every public name."""

from collections.abc import Iterator
from typing import Any

from mkdocs.structure.files import File, Files

import gradcal_jax as gj


def on_files(files: Files, config: Any) -> Files:
    """Add the page."""
    files.append(File.generated(config, "api.md", content="\n".join(_lines())))
    return files


def _lines() -> Iterator[str]:
    yield f"# API\n\n{gj.__doc__}\n"
    for name in sorted(gj.__all__):
        value = getattr(gj, name)
        home = value.__name__ if name == "presets" else f"{value.__module__}.{value.__qualname__}"
        yield f"::: {home}\n    options:\n      heading_level: 2\n      members: {str(name[0].isupper()).lower()}\n"
