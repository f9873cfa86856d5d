"""Printing: plain text away from a terminal; results on stdout, errors on stderr."""

import os
import sys
from typing import Any


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
    print(mark + text, file=sys.stderr, flush=True)
