"""A hook of mkdocs: reference pages in Markdown. Every key of a file or contract comes from its JSON Schema; each table
is on one page only, and pages of other files with that table link there. All commands come from their signatures."""

import json
import re
from collections.abc import Iterator, Mapping
from functools import cache
from typing import Any, Final

from gradcal_jax.cli.app import build
from gradcal_jax.records.log import FORMAT, AngleReadings, Log, variables_of
from gradcal_jax.tables import schemas

_PLAIN: Final = {"string": "text", "integer": "whole number", "number": "number", "boolean": "`true` or `false`"}
_COMMANDS_END: Final = """\
Exit statuses: 0 done; 1 done, but the result is unsatisfactory (for example, a target is missed); 2 wrong input; 3 a
device or a run failed; 130 interrupted; 141 the program that reads the output closed the pipe. An error message names
the key, its value and what was expected. Output has no colours if it does not go to a terminal, or if `NO_COLOR` is
set.
"""
Body = Mapping[str, Any]


def on_files(files: Any, config: Any) -> Any:
    """Add the pages."""
    from mkdocs.structure.files import File

    for path, text in pages().items():
        files.append(File.generated(config, path, content=text))
    return files


def pages() -> dict[str, str]:
    """The text of every reference page, by its path."""
    made = {f"reference/{name}.md": reference(name) for name in schemas.schema_names()}
    made["reference/commands.md"] = commands_page()
    made["reference/log.md"] = log_page()
    return made


def log_page() -> str:
    """The variables of a log, which is a netCDF-4 file."""
    head = (
        f"# {FORMAT}\n\nThis page lists all variables of a log, a netCDF-4 file; `time`, `rate`, `stretch_start` are "
        "required. Its attributes have the number of rows of the source (`rows_read`), those removed by reason, the "
        "findings and the provenance (JSON).\n\n| variable | dimensions | unit | meaning |\n|---|---|---|---|\n"
    )
    rows = [
        f"| `{v.name}` | {', '.join(v.dimensions)} | {v.unit} | {v.words[:1].upper()}{v.words[1:]}. |"
        for v in (*variables_of(Log).values(), *variables_of(AngleReadings).values())
    ]
    return head + "\n".join(rows) + "\n"


def commands_page() -> str:
    """All commands and options."""
    page = build().generate_docs(heading_level=2, flatten_commands=True, usage_name="gradcal")
    # (The usage names the module that is run, and a link to an option has all its hyphens.)
    page = re.sub(r"(?m)^(gradcal\b.*?) -m \w+ ", r"\1 ", page).replace("(#gradcal-install-", "(#gradcal---install-")
    return f"# Commands\n\nThis page lists all commands and options.\n\n{page}\n{_COMMANDS_END}"


def reference(name: str) -> str:
    """The page of a file or contract, as `schema` names it. Errors: `ValueError` for other names."""
    page = name.removeprefix("gradcal-").partition("/")[0]
    own, pages = _schema(name), _pages()
    head = "This page lists all keys of this format."
    lines = [f"# {own['$id']}", "", head, ""]
    for title, body in _tables(own):
        if pages[title][0] == page and "properties" in body:
            lines += _section(title, body, _places(own, title), pages, page)
    return "\n".join(lines)


@cache
def _schema(name: str) -> Body:
    return schemas.schema(name)


@cache
def _pages() -> dict[str, tuple[str, Body]]:
    """The page of each table (the first schema that has it), and the table."""
    pages: dict[str, tuple[str, Body]] = {}
    for page in schemas.schema_names():
        for title, body in _tables(_schema(page)):
            if pages.setdefault(title, (page, body))[1] != body:
                raise AssertionError(f"two different tables are called {title}")
    return pages


def _tables(whole: Body) -> Iterator[tuple[str, Body]]:
    """The file itself and the tables in it, by name, in the order of their keys."""
    named = {"": {k: v for k, v in whole.items() if not k.startswith("$")}, **whole.get("$defs", {})}
    names = [""]
    for name in names:
        names += [inner for inner in _refs(named[name]) if inner not in names]
    for name in names:
        yield _words(name or str(whole["title"])), named[name]


def _refs(value: Any) -> list[str]:
    if isinstance(value, dict):
        own = [value["$ref"].rsplit("/", 1)[1]] if "$ref" in value else []
        # A recipe refers to its spec by format; the reference of the spec has its keys.
        inner = (v for k, v in value.items() if k not in ("default", "examples"))
        return list(dict.fromkeys([*own, *(r for v in inner for r in _refs(v))]))
    return list(dict.fromkeys(r for v in value for r in _refs(v))) if isinstance(value, list) else []


def _words(title: str) -> str:
    """``AngleReference`` -> ``Angle reference``."""
    return re.sub(r"(?<=[a-z0-9])([A-Z])", lambda m: " " + m.group(1).lower(), title)


def _places(whole: Body, title: str) -> list[str]:
    """The places of a table, as paths of keys; a list's entries are marked []."""
    places: list[str] = []

    def walk(value: Any, path: str, above: tuple[str, ...]) -> None:
        if "$ref" in value:
            name = value["$ref"].rsplit("/", 1)[1]
            if _words(name) == title and path not in places:
                places.append(path)
            if name not in above:
                walk(whole["$defs"][name], path, (*above, name))
        for part in value.get("anyOf", ()):
            walk(part, path, above)
        for part in (value.get("items"), *value.get("prefixItems", ())):
            if isinstance(part, dict):
                walk(part, path + "[]", above)
        if isinstance(value.get("additionalProperties"), dict):
            walk(value["additionalProperties"], path + ".NAME", above)
        for key, part in value.get("properties", {}).items():
            walk(part, f"{path}.{key}".lstrip("."), above)

    walk({k: v for k, v in whole.items() if k != "$defs"}, "", ())
    return places


def _section(title: str, body: Body, places: list[str], pages: Mapping[str, tuple[str, Body]], page: str) -> list[str]:
    lines = [f"## {title}", ""]
    if places:
        lines += [f"In {', '.join(f'`{place}`' for place in places[:6])}{', …' if len(places) > 6 else ''}.", ""]
    description = body.get("description", "").strip()
    if description:  # for a whole file only its first paragraph: the others are for readers of the Python code
        lines += [re.sub(r"(?<!\n)\n(?!\n)", " ", description if places else description.split("\n\n")[0]), ""]
    lines += ["| key | value | default | meaning |", "|---|---|---|---|"]
    required = body.get("required", ())
    for key, entry in body["properties"].items():
        value = _value(entry, pages, page).replace("|", "\\|")
        default = "required" if key in required else _default(entry)
        meaning = entry.get("description", "").replace("|", "\\|")
        lines.append(f"| `{key}` | {value} | {default} | {meaning} |")
    return [*lines, ""]


def _default(entry: Body) -> str:
    value = entry.get("default")
    if value in (None, [], {}):
        return "–"
    return "its own defaults" if isinstance(value, dict) else f"`{json.dumps(value, ensure_ascii=False)}`"


def _value(entry: Body, pages: Mapping[str, tuple[str, Body]], page: str) -> str:
    """The allowed values of a key, in words."""
    if "$ref" in entry:
        title = _words(entry["$ref"].rsplit("/", 1)[1])
        where, table = pages[title]
        if "properties" not in table:
            return _value(table, pages, page)
        link = "" if where == page else f"{where}.md"
        return f"[{title}]({link}#{title.lower().replace(' ', '-')})"
    if "anyOf" in entry:
        kinds = (_value(kind, pages, page) for kind in entry["anyOf"] if kind.get("type") != "null")
        return " or ".join(dict.fromkeys(kinds))
    if "const" in entry or "enum" in entry:
        return ", ".join(f"`{json.dumps(v)}`" for v in entry.get("enum", (entry.get("const"),)))
    kind = entry.get("type")
    if kind == "array":
        if "prefixItems" in entry:
            return f"[{', '.join(_value(part, pages, page) for part in entry['prefixItems'])}]"
        return f"list of {_value(entry.get('items', {}), pages, page)}"
    if kind == "object":
        each = entry.get("additionalProperties")
        return f"by name: {_value(each, pages, page)}" if isinstance(each, dict) else "table"
    if kind == "string" and entry.get("examples"):
        return f'such as `"{entry["examples"][0]}"`'
    return _PLAIN.get(str(kind), "any value")
