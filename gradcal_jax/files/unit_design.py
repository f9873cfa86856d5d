"""`[design]` of a whole unit: what `optimise` minimises over poses and moves."""

from typing import Annotated, Literal

from pydantic import Field

from gradcal_jax.files.quantity import Count, PositiveAngle, Quantity, Text, Time, Whole
from gradcal_jax.files.section import Section

ALL = "all requirements"
WORST = "worst ratio"


class UnitDesign(Section):
    """What `optimise` changes in the plan of a whole unit, and what for."""

    minimise: Text = ALL
    """"all requirements" (geometric mean of residual over target), "worst ratio", or a requirement's name."""
    angle_step: PositiveAngle = Quantity.read("45 deg", "angle")
    """Turns are whole numbers of it."""
    shortest_rest: Time = Quantity(2.0, "2 s", "time")
    """Shortest rest."""
    longest_rest: Time = Quantity(120.0, "2 min", "time")
    """Longest rest."""
    moves: Annotated[Count, Field(ge=2, le=400)] = 80
    """Most turns in a cycle."""
    robust: Literal["mean", "worst"] = "mean"
    """Whether the mean over what `uncertain` noise figures may be, or the worst of it, counts."""
    seed: Whole = 0
    """Seed of the annealing."""
