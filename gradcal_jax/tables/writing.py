"""Writing models back as TOML: quantities with the texts of the file read, and without its omitted defaults."""

import os
import tempfile
from collections.abc import Generator, Mapping
from contextlib import contextmanager
from pathlib import Path
from typing import Any, Final, cast

import tomlkit
from tomlkit.items import AoT, InlineTable, Table

from gradcal_jax.tables.section import Section

# Tables short enough for one line, and lists whose tables are best read one a line.
_INLINE: Final = frozenset({"temperature", "rate", "other_axes", "discrepancy"})
_TRAILING: Final = frozenset({"axis", "read_every", "used"})
_LISTED: Final = frozenset({"moves", "programme", "harmonics"})


def to_toml(model: Section, *, header: str = "") -> str:
    """The model as TOML text, `header` above it as comment lines."""
    tables = model.model_dump(mode="json", exclude_unset=True)
    document = tomlkit.document()
    for line in header.splitlines():
        document.add(tomlkit.comment(line))
    for name, value in _scalars_first(tables):
        document.add(name, _item(name, value))
    return tomlkit.dumps(document)  # pyright: ignore[reportUnknownMemberType]


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
    passing: Path | None = None
    try:
        # The ending stays, because some writers depend on it.
        handle, name = tempfile.mkstemp(dir=path.parent, prefix=f".{path.stem}.", suffix=path.suffix)
        os.close(handle)
        passing = Path(name)
        yield passing
        with passing.open("rb") as written:
            os.fsync(written.fileno())
        umask = os.umask(0)
        os.umask(umask)
        passing.chmod(0o666 & ~umask)
        passing.replace(path)
    except OSError as error:
        if error.errno is None:
            raise
        raise type(error)(error.errno, error.strerror or str(error), str(path)) from None
    finally:
        if passing is not None:
            passing.unlink(missing_ok=True)


def _scalars_first(table: Mapping[str, Any]) -> list[tuple[str, Any]]:
    """TOML requires a table's own keys before its subtables."""

    def opens_table(entry: tuple[str, object]) -> bool:
        name, value = entry
        return name not in _INLINE if isinstance(value, Mapping) else _is_tables(value) and name not in _LISTED

    return sorted(table.items(), key=opens_table)


def _is_tables(value: object) -> bool:
    entries = cast("list[object]", value) if isinstance(value, list) else []
    return bool(entries) and all(isinstance(entry, Mapping) for entry in entries)


def _item(name: str, value: Any) -> Any:
    if isinstance(value, Mapping):
        table = cast("Mapping[str, Any]", value)
        return _inline(table) if name in _INLINE else _table(table)
    if _is_tables(value):
        if name not in _LISTED:
            return AoT([_table(entry) for entry in value])
        array = tomlkit.array()
        for entry in value:
            array.append(_inline(entry))  # pyright: ignore[reportUnknownMemberType]
        return array.multiline(True)
    if isinstance(value, str) and "\n" in value:
        return tomlkit.string(value, multiline=True)
    return cast("Any", tomlkit.item(value))  # pyright: ignore[reportUnknownMemberType]


def _table(value: Mapping[str, Any]) -> Table:
    table = tomlkit.table()
    for name, entry in _scalars_first(value):
        table.add(name, _item(name, entry))
    return table


def _inline(value: Mapping[str, Any]) -> InlineTable:
    table = tomlkit.inline_table()
    # The kind of an entry comes before its readings and its axis.
    for name, entry in sorted(value.items(), key=lambda item: item[0] in _TRAILING):
        table.append(name, _inline(cast("Mapping[str, Any]", entry)) if isinstance(entry, Mapping) else _short(entry))
    return table


def _short(value: object) -> object:
    """5 for 5.0: numbers without unit count things (turns)."""
    return int(value) if isinstance(value, float) and value.is_integer() and abs(value) < 1e9 else value
