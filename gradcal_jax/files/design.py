"""`[design]`: what `optimise` may change, and what for. Other commands do not read it."""

from typing import Annotated, Any, Literal

from pydantic import Field

from gradcal_jax.files.quantity import Count, Flag, Number, Text, Time, Whole
from gradcal_jax.files.section import Section

TIMES = ("motion time", "total time")
"""What can be minimised besides a requirement's residual; the targets then are limits."""
OPTIMALITIES = ("A-optimality", "D-optimality", "E-optimality")
"""Classical criteria of the parameters' covariance, as a standard deviation: see `gradcal_jax.design.criteria`."""

Free = Literal[
    "gradient", "rest", "peak_rate", "duration", "turn", "ramp", "cycle", "temperatures", "rates", "integration",
    "programme",
]  # fmt: skip
"""What may change. Gradient plans with motion: `duration` (of turns and rests: `rest` and `turn` say the same),
`peak_rate`, `ramp` (its time), `gradient` (one slope a turn at the table), `cycle` (its length). Without motion:
`programme`. Standard plans: `temperatures`, `rates`, `integration` (and with it the time of a point)."""


class Scenario(Section):
    """A variant of sensor or rig that the plan must serve too: overrides of single keys, and a weight."""

    name: Text | None = None
    weight: Annotated[Number, Field(gt=0.0)] = 1.0
    sensor: dict[str, Any] = Field(default_factory=dict)
    rig: dict[str, Any] = Field(default_factory=dict)


class Design(Section):
    """`minimise`: a requirement's name, "motion time", "total time", or "A-", "D-" or "E-optimality".

    `cycles`: whether every turn at the table has moves of its own, or all have the same. `moves`: how many turns each
    may have; absent: as many as are likely to help.
    """

    minimise: Text
    free: Annotated[tuple[Free, ...], Field(min_length=1)]
    max_motion: Time | None = None
    max_total: Time | None = None
    cycles: Literal["own", "alike"] = "own"
    moves: Annotated[Count, Field(le=40)] | None = None
    starts: Count = 16
    seed: Whole = 0
    min_distinct_rates: Count | None = None
    whole_turns: Flag = False
    robust: Literal["mean", "worst"] = "mean"
    scenario: Annotated[tuple[Scenario, ...], Field(max_length=1000)] = ()
