"""The templates of the pages, in the language of Jinja, and the other files of this folder."""

from importlib import resources
from typing import Any


def page_file(name: str) -> str:
    """The text of a file of this room."""
    return (resources.files(__name__.rsplit(".", 1)[0]) / name).read_text(encoding="utf-8")


def page_templates(**filters: Any) -> Any:
    """The environment of the templates, with `filters` by name."""
    # Imported where it is used: few commands write a page.
    from jinja2 import Environment, FunctionLoader, StrictUndefined

    loader = FunctionLoader(page_file)
    room = Environment(autoescape=True, undefined=StrictUndefined, trim_blocks=True, lstrip_blocks=True, loader=loader)
    room.filters.update(filters)
    return room
