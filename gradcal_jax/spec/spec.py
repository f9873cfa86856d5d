"""Reads a spec (gradcal-spec/1) from a file, a text or tables; its model is in `spec_sections`."""

from collections.abc import Mapping
from pathlib import Path
from typing import Any

from gradcal_jax.spec.spec_sections import FORMAT, Spec
from gradcal_jax.tables.document import model_of, read_text, read_toml


def expect_spec(value: object) -> Spec:
    """The value, if it is a spec. Errors: `TypeError` that says how to read one."""
    if isinstance(value, Spec):
        return value
    if isinstance(value, str | Path):
        raise TypeError(f"expected a spec, not the name of its file: read it with gj.read_spec({str(value)!r})")
    raise TypeError(f"expected a spec from gj.read_spec or gj.parse_spec, not {type(value).__name__}")


def read_spec(path: str | Path) -> Spec:
    """Read a spec file: TOML, quantities as text with units ("0.1 deg/sqrt(h)"), SI (°C) inside.

    Errors: `SpecError` that lists everything wrong with it, each with its key and what was expected.
    """
    return parse_spec(read_text(path), str(path))


def parse_spec(text: str, source: str = "") -> Spec:
    """A spec from the text of a TOML file (quantities with units, SI inside); `source` names it in messages.

    Errors: `SpecError`, as `read_spec`.
    """
    return spec_of(read_toml(text, source), source)


def spec_of(document: Mapping[str, Any], source: str = "") -> Spec:
    """A spec from tables as TOML gives them. Raises `SpecError` that lists everything wrong."""
    return model_of(Spec, document, FORMAT, source)
