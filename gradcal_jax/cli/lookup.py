"""`gradcal schema`: the keys of every file and contract, all commands, and the words that they use."""

import re
from typing import Annotated, Final

from cyclopts import Parameter

from gradcal_jax.cli.output import DONE, Flag, as_json
from gradcal_jax.tables.display import columns

_COMMANDS_END: Final = """\
Exit statuses: 0 done; 1 done, but the result is unsatisfactory (for example, a target is missed); 2 wrong input; 3 a
device or a run failed; 130 interrupted; 141 the program that reads the output closed the pipe. An error message names
the key, its value and what was expected. Output has no colours if it does not go to a terminal, or if `NO_COLOR` is
set.
"""


def schema(
    name: str | None = None,
    /,
    *term: str,
    listing: Annotated[bool, Parameter(name="--list", negative="")] = False,
    markdown: Flag = False,
) -> int:
    """Print the JSON Schema of a file or contract, or explain the words that commands, files and pages use.

    Parameters
    ----------
    name
        The name of the file format or contract (see --list), or "words" for the glossary.
    term
        For the glossary: print only terms that contain these words.
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
    if name == "words":
        print(_words(" ".join(term)))
        return DONE
    if term:
        raise ValueError(f'"{" ".join(term)}": terms are only for the glossary: gradcal schema words {" ".join(term)}')
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


def _words(wanted: str) -> str:
    """The terms of the glossary with these words in them."""
    from gradcal_jax.pages.glossary import TERMS

    rows = [
        (name, meaning)
        for name, meaning in sorted(TERMS.items(), key=lambda entry: entry[0].lower())
        if wanted.lower() in name.lower()
    ]
    if not rows:
        raise ValueError(f'the glossary has no term that contains "{wanted}"; gradcal schema words lists all of them')
    return columns(rows, indent="")


def commands_page() -> str:
    """The reference page of all commands in Markdown, from their signatures and docstrings."""
    # Imported where it is used: the application imports this module.
    from gradcal_jax.cli.app import build

    head = "# Commands\n\nThis page lists all commands and options; `gradcal schema commands --markdown` makes it.\n\n"
    page = build().generate_docs(heading_level=2, flatten_commands=True, usage_name="gradcal")
    # (The usage names the module that is run, and a link to an option has all its hyphens.)
    page = re.sub(r"(?m)^(gradcal\b.*?) -m \w+ ", r"\1 ", page).replace("(#gradcal-install-", "(#gradcal---install-")
    return f"{head}{page}\n{_COMMANDS_END}"
