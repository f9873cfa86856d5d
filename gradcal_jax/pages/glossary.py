"""The words that commands, files and pages use, each in a sentence: `glossary.toml`."""

import tomllib
from importlib import resources
from typing import Final

_TEXT = (resources.files(__name__.rsplit(".", 1)[0]) / "glossary.toml").read_text(encoding="utf-8")
OF_THE_FIELD: Final[dict[str, str]] = tomllib.loads(_TEXT)["of_the_field"]
OF_THE_PROGRAM: Final[dict[str, str]] = tomllib.loads(_TEXT)["of_the_program"]
TERMS: Final[dict[str, str]] = OF_THE_FIELD | OF_THE_PROGRAM
