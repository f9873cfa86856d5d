"""What commands that print numbers or write files share: their options, JSON, and names that can be written."""

import json
from pathlib import Path
from typing import Annotated, Any

from cyclopts import Parameter

Json = Annotated[bool, Parameter(name="--json", negative="")]
Plot = Annotated[Path | None, Parameter(name="--plot")]
Force = Annotated[bool, Parameter(negative="")]


def as_json(value: Any) -> str:
    """JSON for other programs: numbers are finite, and what is not known is null."""
    return json.dumps(value, indent=2, ensure_ascii=False, allow_nan=False)


def writable(path: Path, force: bool) -> None:
    """Refuse a file that cannot be written or would be overwritten. Raises `ValueError`."""
    if path.is_dir():
        raise ValueError(f"{path} is a directory; name a file in it")
    if path.exists() and not force:
        raise ValueError(f"{path} exists; choose another name, or overwrite it with --force")
    if not path.absolute().parent.is_dir():
        raise ValueError(f"there is no directory {path.parent}; make it first")
