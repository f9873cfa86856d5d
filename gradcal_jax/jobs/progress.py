"""How far a sweep or a catalogue is, for whoever watches."""

from collections.abc import Callable
from typing import NamedTuple


class Progress(NamedTuple):
    """`done` of `total` points or cases in a `stage`: "reading", "predict", "optimise".

    `kept` of them are from an earlier run; `newest` says of the last one what came out, where that is known.
    """

    stage: str
    done: int
    total: int
    kept: int = 0
    newest: str = ""


Report = Callable[[Progress], None]


def unwatched(_: Progress) -> None:
    """Nobody watches."""
