"""A section of a page: sentences, tables, lines of code and pictures."""

import re
from dataclasses import dataclass, field
from typing import Any, NamedTuple

from gradcal_jax.pages.figures import Picture
from gradcal_jax.tables.table import Table


@dataclass(frozen=True)
class PageSection:
    """What stands under one heading."""

    title: str
    text: list[str] = field(default_factory=list[str])
    tables: list[Table] = field(default_factory=list[Table])
    lines: list[str] = field(default_factory=list[str])
    pictures: list[Picture] = field(default_factory=list[Picture])

    @property
    def key(self) -> str:
        """The id of the section."""
        return re.sub(r"[^a-z0-9]+", "-", self.title.lower()).strip("-")

    @property
    def is_empty(self) -> bool:
        """Whether nothing would stand under the heading."""
        return not (self.text or self.lines or self.pictures or any(table.rows for table in self.tables))

    def json(self) -> dict[str, Any]:
        """For other programs: sentences and rows of tables."""
        return {"text": self.text, "tables": [table.json() for table in self.tables]}


class PagePart(NamedTuple):
    """A part of a document that is printed on sheets of its own."""

    heading: str
    sections: list[PageSection]
