"""Writing models back as TOML: quantities with the texts of the file read, and without its omitted defaults."""

import json
import os
import re
from collections.abc import Generator, Iterator, Mapping
from contextlib import contextmanager, suppress
from pathlib import Path
from secrets import token_hex
from typing import Any, Final, cast

from gradcal_jax.tables.section import Section

# The kind of a move or an item stands before these keys.
_TRAILING: Final = frozenset({"axis", "read_every", "used"})
# Longest table that stands on one line.
_INLINE: Final = 90


def to_toml(model: Section, *, header: str = "") -> str:
    """The model as TOML text, `header` above it as comment lines."""
    comments = [f"# {line}".rstrip() for line in header.splitlines()]
    return "\n".join([*comments, *_lines(model.model_dump(mode="json", exclude_unset=True))]) + "\n"


def write_toml(model: Section, path: str | Path, *, header: str = "") -> None:
    """Write a spec, recipe, rig or calibration as TOML, quantities with the units that they were read with.

    `header` stands above as comments. The file is whole or not written at all. Errors: `OSError` where it cannot be.
    """
    write_whole(path, to_toml(model, header=header))


def write_whole(path: str | Path, text: str) -> None:
    """Write a text atomically: see `whole`. Errors: `OSError` that names the file."""
    with whole(path) as passing:
        passing.write_text(text, encoding="utf-8", newline="\n")


@contextmanager
def whole(path: str | Path) -> Generator[Path]:
    """Context with a temporary name beside `path` for a writer: the file is moved to `path` at the end, so that it is
    complete or absent after a kill, and removed on a full disk. Errors: `OSError` that names `path`."""
    path = Path(path)
    # The ending stays, because some writers depend on it.
    passing = path.parent / f".{path.stem}.{token_hex(8)}{path.suffix}"
    try:
        passing.touch(exist_ok=False)
        yield passing
        with passing.open("rb") as written:
            os.fsync(written.fileno())
        passing.replace(path)
    except OSError as error:
        if error.errno is None:
            raise
        raise type(error)(error.errno, error.strerror or str(error), str(path)) from None
    finally:
        with suppress(OSError):
            passing.unlink()


def _lines(table: Mapping[str, Any], path: str = "") -> Iterator[str]:
    """The lines of a table: TOML requires its own keys before its subtables."""
    below = {name: value for name, value in table.items() if _opens(value)}
    for name, value in table.items():
        if name not in below:
            yield f"{_key(name)} = {_text(value)}"
    for name, value in below.items():
        place = f"{path}{_key(name)}"
        listed = isinstance(value, list)
        for entry in cast("list[Any]", value) if listed else [value]:
            yield from ("", f"[[{place}]]" if listed else f"[{place}]", *_lines(entry, f"{place}."))


def _opens(value: Any) -> bool:
    """Whether a value is a table, or a list of tables, too long for a line each."""
    if isinstance(value, list):
        return any(isinstance(entry, Mapping) and _opens(entry) for entry in cast("list[Any]", value))
    return isinstance(value, Mapping) and len(_text(value)) > _INLINE


def _key(name: str) -> str:
    return name if re.fullmatch("[A-Za-z0-9_-]+", name) else _text(name)


def _text(value: Any) -> str:
    """A value in TOML, on one line but for a long list of tables."""
    if isinstance(value, Mapping):
        table = cast("Mapping[str, Any]", value)
        names = sorted(table, key=_TRAILING.__contains__)
        return "{ " + ", ".join(f"{_key(name)} = {_text(table[name])}" for name in names) + " }"
    if isinstance(value, list):
        entries = cast("list[Any]", value)
        rows = [_text(entry) for entry in entries]
        line = f"[{', '.join(rows)}]"
        if len(line) > _INLINE and any(isinstance(entry, Mapping) for entry in entries):
            line = "[\n  " + ",\n  ".join(rows) + ",\n]"
        return line
    if isinstance(value, float):
        return repr(value)
    return json.dumps(value, ensure_ascii=False).replace("\x7f", "\\u007f")
