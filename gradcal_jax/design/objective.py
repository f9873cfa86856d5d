"""What a search minimises: one number of a plan, and by how much it exceeds limits.

Everything in an `Objective` but structure is an array, so that search, polish, prices and the exact value share one
program, whatever the numbers.
"""

from typing import Literal

import equinox as eqx
import numpy as np
from jaxtyping import Float

from gradcal_jax.arrays import AnyArray, namespace
from gradcal_jax.design.coordinates import EASED, Coordinates
from gradcal_jax.design.criteria import EXACT, Criterion, Optimality, largest
from gradcal_jax.design.other_plans import ProgrammeCoordinates, ProgrammeKnots, StandardCoordinates
from gradcal_jax.information import information
from gradcal_jax.model import SensorModel
from gradcal_jax.trajectory import Rule, Schedule

AnyCoordinates = Coordinates | ProgrammeCoordinates | ProgrammeKnots | StandardCoordinates


class Case(eqx.Module):
    """A sensor and rig that the plan must serve: what is minimised there, and what has a limit; its weight."""

    model: SensorModel
    thermal_lag: Float[AnyArray, ""] | None
    minimised: tuple[Criterion | Optimality, ...]
    limited: tuple[Criterion, ...]
    weight: Float[AnyArray, ""]
    rule: Rule | None = eqx.field(static=True, default=None)

    def values(self, schedule: Schedule, sharpness):
        """Of all criteria, in SI."""
        info = information(schedule.trajectory(self.thermal_lag), self.model, self.rule)
        return [c(info, sharpness) for c in self.minimised], [c(info, sharpness) for c in self.limited]


class Objective(eqx.Module):
    """`(z, sharpness)` to the value, positive, and the logarithms by which `targets` (SI) are exceeded.

    `factors` bring what is minimised to its unit; of several the worst counts, and over the cases the "worst" or their
    weighted "mean". Without `coordinates` it is one of schedules alone.
    """

    coordinates: AnyCoordinates | None
    cases: tuple[Case, ...]
    factors: Float[AnyArray, " m"]
    targets: Float[AnyArray, " k"]
    robust: Literal["worst", "mean"] = eqx.field(static=True, default="mean")

    @property
    def eased(self) -> int:
        """How many figures of rig and time may be eased."""
        return EASED if isinstance(self.coordinates, Coordinates) else 0

    @property
    def cost(self) -> int:
        """Noise steps of all cases, about."""
        template = getattr(self.coordinates, "template", None)
        return len(self.cases) * (0 if template is None else template.piece_count)

    def value(self, z: Float[AnyArray, " n"], by: Float[AnyArray, " m"], sharpness):
        """The value and the excess of a vector's plan, with figures eased by so much (`Coordinates.eased`)."""
        coordinates = self.coordinates
        assert coordinates is not None
        if isinstance(coordinates, Coordinates):
            coordinates = coordinates.eased(by)
        return self.of_schedule(coordinates.decode(z), sharpness)

    def of_schedule(self, schedule: Schedule, sharpness=EXACT):
        """The value and the excess of a plan."""
        values, excess, xp = [], [], np
        for case in self.cases:
            minimised, limited = case.values(schedule, sharpness)
            xp = namespace(minimised)
            values.append(_worst(xp.stack(minimised) * self.factors, sharpness))
            excess += [c / t for c, t in zip(limited, self.targets, strict=True)]
        together = xp.stack(values)
        if self.robust == "worst":
            value = _worst(together, sharpness)
        else:
            weights = xp.stack([xp.asarray(case.weight) for case in self.cases])
            value = xp.sum(together * weights) / xp.sum(weights)
        return value, xp.log(xp.stack(excess)) if excess else xp.zeros(0)


def _worst(values, sharpness):
    """The largest, or a norm just above it."""
    return values[0] if values.shape[0] == 1 else largest(values[:, None], sharpness)[0]
