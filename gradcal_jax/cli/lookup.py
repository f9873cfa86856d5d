"""`gradcal schema`: the keys of every file and contract, all commands, and the words that they use."""

import re
from typing import Annotated, Final

from cyclopts import Parameter

from gradcal_jax.cli.output import DONE, Flag, as_json

_COMMANDS_END: Final = """\
Exit statuses: 0 done; 1 done, but the result is unsatisfactory (for example, a target is missed); 2 wrong input; 3 a
device or a run failed; 130 interrupted; 141 the program that reads the output closed the pipe. An error message names
the key, its value and what was expected. Output has no colours if it does not go to a terminal, or if `NO_COLOR` is
set.
"""


def schema(
    name: str | None = None,
    /,
    listing: Annotated[bool, Parameter(name="--list", negative="")] = False,
    markdown: Flag = False,
) -> int:
    """Print the JSON Schema of a file or contract, or a page of reference.

    Parameters
    ----------
    name
        The name of the file format or contract (see --list).
    listing
        List the names.
    markdown
        Print a page in Markdown instead: every key with its value, default and meaning; or, for the name "commands",
        the help of every command.
    """
    from gradcal_jax.tables import schemas

    if listing:
        print("\n".join(schemas.schema_names()))
        return DONE
    if name is None:
        raise ValueError(f"name one of these: {', '.join(schemas.schema_names())}")
    if name == "commands" and markdown:
        print(commands_page(), end="")
        return DONE
    if markdown:
        from gradcal_jax.pages.reference import reference

        print(reference(name), end="")
        return DONE
    result = schemas.schema(name)
    if name.removeprefix("gradcal-").partition("/")[0] == "rig":
        from gradcal_jax.hardware.setup import with_options

        result = with_options(result)
    print(as_json(result))
    return DONE


def commands_page() -> str:
    """The reference page of all commands in Markdown, from their signatures and docstrings."""
    # Imported where it is used: the application imports this module.
    from gradcal_jax.cli.app import build

    head = "# Commands\n\nThis page lists all commands and options; `gradcal schema commands --markdown` makes it.\n\n"
    page = build().generate_docs(heading_level=2, flatten_commands=True, usage_name="gradcal")
    # (The usage names the module that is run, and a link to an option has all its hyphens.)
    page = re.sub(r"(?m)^(gradcal\b.*?) -m \w+ ", r"\1 ", page).replace("(#gradcal-install-", "(#gradcal---install-")
    return f"{head}{page}\n{_COMMANDS_END}"
