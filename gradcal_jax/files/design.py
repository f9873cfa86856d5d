"""`[design]`: the free variables and the objective of `optimise`, for one axis and for a whole unit."""

from collections.abc import Mapping
from typing import Annotated, Any, Literal, cast

from pydantic import Field, model_validator

from gradcal_jax.files.bases import Degree
from gradcal_jax.files.problems import Problem
from gradcal_jax.files.quantity import (
    Count,
    Flag,
    Number,
    PositiveAngle,
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
    """A variant of sensor or rig for which the plan must be good too: changes of single keys, and a weight."""

    name: Text | None = None
    """A name for people."""
    weight: Annotated[Number, Field(gt=0.0)] = 1.0
    """Its weight in the mean over scenarios."""
    sensor: dict[str, Any] = Field(default_factory=dict)
    """Changed keys below [sensor]."""
    rig: dict[str, Any] = Field(default_factory=dict)
    """Changed keys below [rig]."""


class Notice(Section):
    """What a design must notice: a scale factor's polynomials beyond the structure, up to these degrees."""

    standard_deviation: PositiveScaleFactor
    """Standard deviation of each hidden coefficient, a ratio."""
    temperature_degree: Degree | None = None
    """Highest hidden degree in temperature; absent: the discrepancy's, or two more than the structure's."""
    rate_degree: Degree | None = None
    """Highest hidden degree in rate; absent: likewise."""
    power: Probability = Quantity(0.9, "90 %", "scale factor")
    """Probability with which it must be noticed."""
    false_alarm: Probability = Quantity(0.01, "1 %", "scale factor")
    """Level of the test that `estimate` makes of the log."""


class Design(Section):
    """What `optimise` may change, and what for."""

    minimise: Text
    """A requirement's name, "motion time", "total time", "A-optimality", "D-optimality" or "E-optimality"."""
    free: Annotated[tuple[Free, ...], Field(min_length=1)]
    """Which parts of the plan may change."""
    max_motion: Time | None = None
    """Longest ramp."""
    max_total: Time | None = None
    """Longest plan, soaks included."""
    cycles: Literal["own", "alike"] = "own"
    """Whether every turn at the table has moves of its own, or all the same; absent: the same where turns are many."""
    moves: Annotated[Count, Field(le=40)] | None = None
    """Turns in each turn at the table; absent: as many as are likely to help."""
    starts: Count = 16
    """Number of searches from different plans."""
    seed: Whole = 0
    """Seed of their draws."""
    notice: Notice | None = None
    """What the design must notice."""
    whole_turns: Flag = False
    """Whether every turn must be a whole number of revolutions, where encoder errors repeat."""
    robust: Literal["mean", "worst"] = "mean"
    """Whether the mean over the scenarios or the worst of them counts."""
    scenario: Annotated[tuple[Scenario, ...], Field(max_length=1000)] = ()
    """Variants of sensor or rig that the plan must serve too."""

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


ALL = "all requirements"
WORST = "worst ratio"


class UnitDesign(Section):
    """What `optimise` changes in the plan of a whole unit, and what for."""

    minimise: Text = ALL
    """"all requirements" (geometric mean of residual over target), "worst ratio", or a requirement's name."""
    angle_step: PositiveAngle | None = None
    """Turns are whole numbers of it; absent: any angle."""
    shortest_rest: Time = Quantity(2.0, "2 s", "time")
    """Shortest rest."""
    longest_rest: Time = Quantity(120.0, "2 min", "time")
    """Longest rest."""
    moves: Annotated[Count, Field(ge=2, le=400)] = 80
    """Most turns in a cycle."""
    robust: Literal["mean", "worst"] = "mean"
    """Whether the mean or the worst over the ranges of `uncertain` noise figures counts."""
    seed: Whole = 0
    """Seed of the search."""
