"""Commented specs to start from, and the texts of other files.

Sensor figures are typical of a class of devices, not of one vendor's.
"""

import tomllib
from importlib import resources

from gradcal_jax.tables.problems import hint


def names() -> tuple[str, ...]:
    """The presets, in alphabetical order."""
    entries = resources.files(__name__).iterdir()
    return tuple(sorted(entry.name.removesuffix(".toml") for entry in entries if entry.name.endswith(".toml")))


def text(name: str) -> str:
    """The TOML text of a preset. Raises `ValueError` with the nearest right spelling."""
    if name not in (known := names()):
        ending = hint(name, known, f"; known: {', '.join(known)}")
        raise ValueError(f'there is no preset named "{name}"{ending}')
    return (resources.files(__name__) / f"{name}.toml").read_text(encoding="utf-8")


def template(name: str) -> str:
    """A text that the program fills in, or hands out to be edited: a file of `spec/templates`."""
    return (resources.files("gradcal_jax.spec") / "templates" / name).read_text(encoding="utf-8")


def title(name: str) -> str:
    """The title of a preset."""
    return str(tomllib.loads(text(name)).get("title", ""))
