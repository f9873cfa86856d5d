"""`[design]`: the free variables and the objective of `optimise`.

Of a gyro that turns about the only axis of a table that is read the moves of its visits to the table are searched; of
every other IMU a cycle of turns and poses. Keys of the other kind are refused.
"""

from collections.abc import Iterator, Sequence
from typing import Annotated, Final, Literal

from pydantic import Field

from gradcal_jax.tables import quantity as q
from gradcal_jax.tables.problems import Problem, hint, one_of
from gradcal_jax.tables.section import Section

Free = Literal["cycle", "programme"]
"""What may change: `cycle` (all moves; of one axis always its moves, and with this word its length) and `programme`
(the chamber's legs, turning points and slopes)."""


ALL = "all requirements"
WORST = "worst ratio"


class Design(Section):
    """What `optimise` minimises, and what it may change."""

    minimise: q.Text = ALL
    """A requirement's name, "all requirements" (geometric mean of the residuals, each divided by its target) or "worst
    ratio" (largest of these ratios). If one requirement is minimised, the targets of the others are limits."""
    free: Annotated[tuple[Free, ...], Field(min_length=1)] = ()
    """Which parts of the plan may change: "cycle" and "programme". Absent: the cycle and, with a `hysteresis` in the
    spec or a table at rest, the programme. Of one axis: its moves; with "cycle" also the length of its cycle."""
    max_motion: q.Time | None = None
    """Longest ramp."""
    max_total: q.Time | None = None
    """Longest allowed duration of the plan, soaks included."""
    moves: Annotated[q.Count, Field(le=400)] | None = None
    """For a single axis: the number of turns in each visit (the part of a cycle in which this axis may turn), 40 at
    most; absent: as many as are likely to help. For other IMUs: the largest number of turns in a cycle; absent: 80."""
    starts: q.Count = 16
    """Number of searches from different plans."""
    seed: q.Whole = 0
    """Seed of the search."""
    shortest_rest: q.Time = q.Quantity(2.0, "2 s", "time")
    """Shortest rest. Of one axis, absent: 2 s, or the time between two readings of its angle, if this is shorter."""
    longest_rest: q.Time = q.Quantity(120.0, "2 min", "time")
    """Longest rest."""


# Keys that one of the two kinds of search alone reads.
_OF_AXIS: Final = ("starts",)
_OF_POSES: Final = ("longest_rest",)
_MOVES_OF_AXIS: Final = 40


def design_problems(design: Design, names: Sequence[str], *, of_axis: bool) -> Iterator[Problem]:
    """An objective that does not exist, and keys that have no effect; keys relative to [design].

    `names`: of the requirements. `of_axis`: whether the turns of one axis are searched, or poses.
    """
    others, useless = (ALL, WORST), _OF_POSES if of_axis else _OF_AXIS
    if design.minimise not in (*names, *others):
        ending = hint(design.minimise, [*names, *others])
        of = f"the name of a requirement ({one_of(names)}) or " if names else "a requirement's name or "
        yield Problem(("minimise",), f"expected {of}{one_of(others)}{ending}", design.minimise)
    for name in useless:
        if name in design.model_fields_set:
            kind = "the turns of one axis" if of_axis else "a cycle of turns and poses"
            yield Problem((name,), f"has no effect if the search varies {kind}; leave this key out")
    if design.moves is not None:
        if of_axis and design.moves > _MOVES_OF_AXIS:
            yield Problem(("moves",), f"must be at most {_MOVES_OF_AXIS} turns in each visit", design.moves)
        elif not of_axis and design.moves < 2:
            yield Problem(("moves",), "must be at least 2", design.moves)
