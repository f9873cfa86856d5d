"""The objective of a search: one value of a plan, and the ratios by which it exceeds limits.

All numbers of an `Objective` are arrays, so that search, polish, prices and the exact value share one compiled program.
"""

from typing import Any, Literal

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Float

from gradcal_jax.arrays import AnyArray, namespace
from gradcal_jax.design.coordinates import Coordinates
from gradcal_jax.design.criteria import EXACT, Criterion, Optimality, largest
from gradcal_jax.design.other_plans import ProgrammeCoordinates, StandardCoordinates
from gradcal_jax.information import information
from gradcal_jax.model import SensorModel
from gradcal_jax.motion import Rule, Schedule, Trajectory

AnyCoordinates = Coordinates | ProgrammeCoordinates | StandardCoordinates


class Case(eqx.Module):
    """A sensor and rig that the plan must serve: its minimised and its limited criteria, and its weight."""

    model: SensorModel
    thermal_lag: Float[AnyArray, ""] | None
    minimised: tuple[Criterion | Optimality, ...]
    limited: tuple[Criterion, ...]
    weight: Float[AnyArray, ""]
    rule: Rule | None = eqx.field(static=True, default=None)

    def trajectory(self, schedule: Schedule) -> Trajectory:
        """The trajectory of the plan."""
        return schedule.trajectory(self.thermal_lag)

    def values(self, schedule: Schedule, sharpness):
        """Values of the minimised and of the limited criteria, SI."""
        info = information(self.trajectory(schedule), self.model, self.rule)
        minimised = [of(info, sharpness) for of in self.minimised]
        return minimised, [of(info, sharpness) for of in self.limited]


class Objective(eqx.Module):
    """`(z, sharpness)` to the positive value and the log ratios of the limited criteria to their `targets` (SI).

    `factors` scale the minimised criteria; the worst of several counts, and over the cases the "worst" one or the
    weighted "mean". Without `coordinates` it takes schedules only.
    """

    coordinates: AnyCoordinates | None
    cases: tuple[Case, ...]
    factors: Float[AnyArray, " m"]
    targets: Float[AnyArray, " k"]
    robust: Literal["worst", "mean"] = eqx.field(static=True, default="mean")

    @property
    def cost(self) -> int:
        """Approximate number of noise steps of all cases."""
        template = getattr(self.coordinates, "template", None)
        return len(self.cases) * (0 if template is None else template.piece_count)

    @property
    def limited(self) -> bool:
        """Whether there are limits."""
        return bool(self.targets.shape[0])

    def value(self, z: Float[AnyArray, " n"], sharpness):
        """Value and excess of a vector's plan."""
        assert self.coordinates is not None
        return self.of_schedule(self.coordinates.decode(z), sharpness)

    def of_schedule(self, schedule: Schedule, sharpness=EXACT):
        """Value and excess of a plan."""
        values, excess, xp = [], [], np
        for minimised, limited in _of_each(self.cases, schedule, sharpness):
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


def _of_each(cases: tuple[Case, ...], schedule: Schedule, sharpness) -> list[tuple[list[Any], list[Any]]]:
    """The criteria of every case. Cases of the same structure are traced once, in a loop of the program."""
    leaves, structures = zip(*(jax.tree.flatten(case) for case in cases), strict=True)
    shapes = {tuple(np.shape(leaf) for leaf in one) for one in leaves}
    if namespace(schedule) is np or len(cases) == 1 or len(set(structures)) > 1 or len(shapes) > 1:
        return [case.values(schedule, sharpness) for case in cases]
    stacked = [jnp.stack([jnp.asarray(leaf) for leaf in group]) for group in zip(*leaves, strict=True)]
    values = jax.lax.map(lambda one: jax.tree.unflatten(structures[0], one).values(schedule, sharpness), stacked)
    return [jax.tree.map(lambda v, k=k: v[k], values) for k in range(len(cases))]


def _worst(values, sharpness):
    """The largest value, or a norm just above it."""
    return values[0] if values.shape[0] == 1 else largest(values[:, None], sharpness)[0]
