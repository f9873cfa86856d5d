"""Which plans share a compiled program, and how much room it has; plain numbers, without JAX."""

from typing import Final, NamedTuple

OWN_SHAPE: Final = "own shape"
"""The group of plans that have no layout."""


class Kind(NamedTuple):
    """What plans must share to share a layout: parts of the own moves and of what completes the cycle, as (move, kind),
    the stretches as (first, last) of the programme's, its size, the channel, and whether the sensor lags.
    """

    channel: str
    own: tuple[tuple[int, str], ...]
    after: tuple[tuple[int, str], ...]
    stretches: tuple[tuple[int, int], ...]
    programme: int
    lagged: bool


class Counts(NamedTuple):
    """How many pieces and repetitions: of each own part, of each part after, whole cycles and pieces of the tail for
    each stretch.
    """

    own: tuple[int, ...]
    after: tuple[int, ...]
    whole: tuple[int, ...]
    tail: tuple[int, ...]


class Layout(NamedTuple):
    """Room for every plan of a group."""

    kind: Kind
    room: Counts


class Surveyed(NamedTuple):
    """What decides which points are computed together. `group` is equal for those that may be; `counts` a channel's.

    `failure`: why the point cannot be computed at all; then the rest is empty.
    """

    group: str
    kinds: tuple[Kind, ...]
    counts: tuple[Counts, ...]
    failure: str = ""


def rounded_up(count: int) -> int:
    """The next of 0, 1, 2, 3, 4, 6, 8, 12, 16, 24, …: few sizes, none more than half too large."""
    if count <= 2:
        return count
    power = 1 << (count - 1).bit_length()
    return power * 3 // 4 if count <= power * 3 // 4 else power


def sizes(counts: Counts) -> tuple[int, ...]:
    """Plans of one kind share a layout where these agree: rounded numbers of cycles and of pieces a cycle."""
    return (*map(rounded_up, counts.whole), rounded_up(sum(counts.own) + sum(counts.after)))


def room_for(counts: list[Counts]) -> Counts:
    """As much as any of the plans needs."""
    most = lambda field: tuple(max(column) for column in zip(*(getattr(c, field) for c in counts), strict=True))  # noqa: E731
    return Counts(*(most(field) for field in Counts._fields))
