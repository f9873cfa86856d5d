"""Commented specs to start from, and the texts of other files.

Sensor figures are typical of a class of devices, of no vendor's.
"""

import tomllib
from importlib import resources
from importlib.resources.abc import Traversable

from gradcal_jax.files.problems import hint


def names() -> tuple[str, ...]:
    """The presets of one gyro axis, in alphabetical order."""
    return _in(resources.files(__name__))


def unit_names() -> tuple[str, ...]:
    """The presets of a whole unit, gyros and accelerometers, in alphabetical order."""
    return _in(resources.files(__name__) / "units")


def _in(folder: Traversable) -> tuple[str, ...]:
    return tuple(sorted(entry.name.removesuffix(".toml") for entry in folder.iterdir() if entry.name.endswith(".toml")))


def text(name: str) -> str:
    """The TOML text of a preset. Raises `ValueError` with the nearest right spelling."""
    of_axis, every = names(), (*names(), *unit_names())
    if name not in every:
        ending = hint(name, every, f"; known: {', '.join(every)}")
        raise ValueError(f'there is no preset named "{name}"{ending}')
    folder = resources.files(__name__)
    return ((folder if name in of_axis else folder / "units") / f"{name}.toml").read_text(encoding="utf-8")


def template(name: str) -> str:
    """A text that the program fills in, or hands out to be edited: a file of `files/templates`."""
    return (resources.files("gradcal_jax.files") / "templates" / name).read_text(encoding="utf-8")


def title(name: str) -> str:
    """The title of a preset."""
    return str(tomllib.loads(text(name)).get("title", ""))
