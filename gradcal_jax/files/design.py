"""`[design]`: what `optimise` may change, and what for. Other commands do not read it."""

from collections.abc import Mapping
from typing import Annotated, Any, Literal, cast

from pydantic import Field, model_validator

from gradcal_jax.files.bases import Degree
from gradcal_jax.files.problems import Problem
from gradcal_jax.files.quantity import (
    Count,
    Flag,
    Number,
    PositiveScaleFactor,
    Probability,
    Quantity,
    Text,
    Time,
    Whole,
)
from gradcal_jax.files.section import Section, refuse

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


class Notice(Section):
    """What a design must notice: with the probability `power`, a hidden map of the scale factor whose polynomials
    beyond the structure, up to these degrees, have this standard deviation each.

    `false_alarm`: the level of the test, which `estimate` makes of the log. Degrees that are absent are those of the
    sensor's discrepancy, or two more than the structure's.
    """

    standard_deviation: PositiveScaleFactor
    temperature_degree: Degree | None = None
    rate_degree: Degree | None = None
    power: Probability = Quantity(0.9, "90 %", "scale factor")
    false_alarm: Probability = Quantity(0.01, "1 %", "scale factor")


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
    notice: Notice | None = None
    whole_turns: Flag = False
    robust: Literal["mean", "worst"] = "mean"
    scenario: Annotated[tuple[Scenario, ...], Field(max_length=1000)] = ()

    @model_validator(mode="before")
    @classmethod
    def _gone(cls, value: object) -> object:
        table = dict(cast("Mapping[str, object]", value)) if isinstance(value, Mapping) else dict[str, object]()
        if "min_distinct_rates" in table:
            message = (
                "is gone: distinct rates do not make a plan notice a wrong model; say what it must notice, such as "
                'notice = { standard_deviation = "10 ppm", power = "90 %" }'
            )
            refuse(Problem(("min_distinct_rates",), message, table["min_distinct_rates"]))
        return cast("object", value)
