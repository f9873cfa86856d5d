"""Options, exit statuses, printing, JSON and checks of output files for all commands."""

import os
import sys
from json import dumps
from pathlib import Path
from typing import Annotated, Any, Final

from cyclopts import Parameter

from gradcal_jax.tables.display import printable

Switch = Annotated[bool, Parameter(negative="")]
Force = Annotated[bool, Parameter(negative="", help="Overwrite an existing file.")]
ForceOutput = Annotated[bool, Parameter(negative="", help="Overwrite an existing output file.")]
Json = Annotated[bool, Parameter(name="--json", negative="")]
JsonNumbers = Annotated[bool, Parameter(name="--json", negative="", help="Print all numbers as JSON.")]
RunPath = Annotated[Path, Parameter(help="The folder of the run.")]
Output = Annotated[Path, Parameter(name=["--output", "-o"])]
OptionalOutput = Annotated[Path | None, Parameter(name=["--output", "-o"])]
Plot = Annotated[Path | None, Parameter(name="--plot")]

_FIGURES: Final = (".png", ".svg", ".pdf")


def show(text: str, record: Any, *, json: bool, wished: bool = True) -> int:
    """Print the text or, for other programs, the record: all its numbers are finite, unknown values are null. Returns
    the exit status."""
    print(dumps(record, indent=2, ensure_ascii=False, allow_nan=False) if json else text)
    return DONE if wished else NOT_AS_WISHED


def writable(path: Path, force: bool) -> None:
    """Raise `ValueError` for a file that cannot be written or would be overwritten."""
    if path.is_dir():
        raise ValueError(f"{path} is a directory; name a file in it")
    if path.exists() and not force:
        raise ValueError(f"{path} exists; choose another name, or overwrite it with --force")
    if not path.absolute().parent.is_dir():
        raise ValueError(f"there is no directory {path.parent}; make it first")


def drawable(plot: Path | None) -> None:
    """Raise `ValueError` for a figure that cannot be written; called before the computation."""
    if plot is None:
        return
    if plot.suffix.lower() not in _FIGURES:
        raise ValueError(f"{plot}: the name of a figure must end in .png, .svg or .pdf")
    writable(plot, force=True)


DONE: Final = 0
NOT_AS_WISHED: Final = 1
"""Done, but a target is missed, a search has not converged, or the data contradict the model."""
WRONG_INPUT: Final = 2
FAILED: Final = 3
"""A device or a run failed."""
INTERRUPTED: Final = 130
BROKEN_PIPE: Final = 141
"""The reader closed the pipe before the end of the output (as a shell counts a SIGPIPE)."""


def is_plain(stream: Any) -> bool:
    """Whether a stream gets text without escape sequences."""
    if os.environ.get("NO_COLOR") or os.environ.get("TERM") == "dumb":
        return True
    return not stream.isatty()


def strong(text: str) -> str:
    """Bold on a terminal."""
    return text if is_plain(sys.stdout) else f"\x1b[1m{text}\x1b[0m"


def complain(text: str) -> None:
    """Print an error on stderr."""
    mark = "gradcal: " if is_plain(sys.stderr) else "\x1b[1;31mgradcal:\x1b[0m "
    print(mark + printable(text), file=sys.stderr, flush=True)
