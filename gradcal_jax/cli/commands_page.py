"""The reference page of all commands in Markdown, from their signatures and docstrings."""

import inspect
import re
from collections.abc import Iterator
from pathlib import Path
from types import NoneType, UnionType
from typing import Any, Final, Literal, Union, get_args, get_origin

from cyclopts import App, Argument

from gradcal_jax.cli.app import GROUPS, build

_VALUES: Final = {Path: "path", str: "text", int: "whole number", float: "number"}
_END: Final = """\
Exit statuses: 0 done; 1 done, with an unsatisfactory result (a target is missed); 2 wrong input; 3 a device or a
run failed; 130 interrupted; 141 the program that reads the output closed the pipe. An error message names the key,
its value and what was expected. Output has no colours if it does not go to a terminal, or if `NO_COLOR` is set.
"""


def commands_page() -> str:
    """The page: a table of the commands, then every command with its arguments and options."""
    commands = dict(all_commands(build()))
    lines = ["# Commands", "", "Made by `gradcal schema commands --markdown`; all commands and options.", ""]
    lines += ["| command | what it does |", "|---|---|"]
    lines += [
        f"| [`gradcal {name}`](#gradcal-{name.replace(' ', '-')}) | {_first(it)} |" for name, it in commands.items()
    ]
    lines += ["", _END]
    for name, command in commands.items():
        lines += _section(name, command)
    return "\n".join(lines)


def all_commands(app: App) -> Iterator[tuple[str, App]]:
    """Every command that runs something, "rig check" too, in the order of work."""
    for _, commands in GROUPS:
        for command in commands:
            name = command.name[0] if isinstance(command, App) else command.__name__
            yield from _with_subcommands(name, app[name])


def _with_subcommands(name: str, app: App) -> Iterator[tuple[str, App]]:
    if app.default_command is not None:
        yield name, app
    for inner in app:
        if not inner.startswith("-"):
            yield from _with_subcommands(f"{name} {inner}", app[inner])


def options(command: App) -> list[Argument]:
    """The arguments and options of a command, as its help lists them."""
    arguments = command.assemble_argument_collection(parse_docstring=True)
    # (An option whose value is a group of options is no option itself.)
    return [argument for argument in arguments if argument.names != ("*",)]


def _link(name: str) -> str:
    return f"[`gradcal {name}`](#gradcal-{name.replace(' ', '-')})"


def _paragraphs(command: App) -> list[str]:
    """The docstring, without its table of parameters: each paragraph as one line."""
    text = inspect.getdoc(command.default_command) or ""
    text = re.split(r"\n+Parameters\n-+", text)[0]
    return [" ".join(paragraph.split()) for paragraph in text.split("\n\n")]


def _first(command: App) -> str:
    return _cell(_paragraphs(command)[0])


def _section(name: str, command: App) -> list[str]:
    arguments = options(command)
    usage = " ".join(["gradcal", name, *(_in_usage(argument) for argument in arguments if _in_usage(argument))])
    lines = [f"## gradcal {name}", "", f"`{usage}`", ""]
    for paragraph in _paragraphs(command):
        lines += [paragraph, ""]
    if arguments:
        lines += ["| option | value | default | meaning |", "|---|---|---|---|", *map(_row, arguments), ""]
    return lines


def _in_usage(argument: Argument) -> str:
    """Its part of the usage line: positional arguments, and options that are required."""
    if argument.index is not None:
        name = argument.names[0] + ("…" if get_origin(argument.hint) is tuple else "")
        return name if argument.required else f"[{name}]"
    return f"{argument.names[0]} {_value(argument).split(',')[0].upper()}" if argument.required else ""


def _row(argument: Argument) -> str:
    default = argument.field_info.default
    if argument.required:
        shown = "required"
    elif default in (None, False, (), "", argument.field_info.empty):
        shown = "–"
    else:
        shown = f"`{default}`"
    meaning = _cell(argument.parameter.help or "")
    return f"| {', '.join(f'`{name}`' for name in argument.names)} | {_value(argument)} | {shown} | {meaning} |"


def _value(argument: Argument) -> str:
    """The values that it takes, in words; a flag takes none."""
    return "–" if argument.hint is bool else _kind(argument.hint)


def _kind(hint: Any) -> str:
    if get_origin(hint) in (UnionType, Union):
        return " or ".join(_kind(part) for part in get_args(hint) if part is not NoneType)
    if get_origin(hint) is Literal:
        return ", ".join(f"`{choice}`" for choice in get_args(hint))
    if get_origin(hint) is tuple:
        parts = get_args(hint)
        return f"{_kind(parts[0])}, any number" if parts[-1] is ... else ", ".join(map(_kind, parts))
    return _VALUES[hint]


def _cell(text: str) -> str:
    return " ".join(text.split()).replace("|", "\\|")
