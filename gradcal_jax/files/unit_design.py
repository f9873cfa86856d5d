"""`[design]` of a whole unit: what `optimise` minimises over poses and moves."""

from typing import Annotated

from pydantic import Field

from gradcal_jax.files.quantity import Count, PositiveAngle, Quantity, Text, Time, Whole
from gradcal_jax.files.section import Section

ALL = "all requirements"
WORST = "worst ratio"


class UnitDesign(Section):
    """`minimise`: "all requirements" (the geometric mean of residual over target; without a target, of the residual),
    "worst ratio" (the largest residual over target), or a requirement's name.

    `angle_step`: turns are whole numbers of it. `moves`: at most so many turns in a cycle.
    """

    minimise: Text = ALL
    angle_step: PositiveAngle = Quantity.read("45 deg", "angle")
    shortest_rest: Time = Quantity(2.0, "2 s", "time")
    longest_rest: Time = Quantity(120.0, "2 min", "time")
    moves: Annotated[Count, Field(ge=2, le=400)] = 80
    seed: Whole = 0
