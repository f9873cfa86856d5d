"""The objective of a spec's [design], as `predict` evaluates a plan: what it leaves of the requirements, over their
targets, at every place."""

import math
from typing import Any, Final, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Float

from gradcal_jax.arrays import AnyArray, namespace
from gradcal_jax.information.residual import Residual, residual_map, residual_of
from gradcal_jax.information.unseen import own_of_imu, posterior_and_answers, unseen_columns
from gradcal_jax.information.verdicts import finite, limit_of
from gradcal_jax.model.build import build_imu
from gradcal_jax.spec.design import ALL, WORST, Design
from gradcal_jax.spec.places import hung_alike
from gradcal_jax.spec.requirement import QUANTITIES
from gradcal_jax.spec.spec_sections import Spec

EXCESS: Final = 10.0
"""What a limit that is exceeded costs, in multiples of the logarithm of what it leaves over its target: more than any
limit's price, so that the optimum keeps all."""
KEPT: Final = 1e-3
"""Largest log excess at which a limit counts as satisfied."""
MARGIN: Final = 0.1
"""A target is met with margin if the residual is below the target by this fraction or more."""
MET: Final = f"every target is met with a margin of {MARGIN:.0%}"
NO_TARGET: Final = "to stop when every target is met, give a requirement a target"

# The statistic of every requirement at each place, by the terms that the spec names (in the unit of output; infinite:
# not observable).
Left = Float[np.ndarray, "s m"]


class RequirementChange(NamedTuple):
    """A requirement's statistic (`unit`, 1σ, by the terms that the spec names) before and after a search; None: not
    observable."""

    name: str
    unit: str
    before: float | None
    now: float | None


class ExactObjective:
    """What the [design] of a spec minimises: the logarithms of the statistics of its `m` requirements over their
    `limits`, at each of the `s` places that hang differently (`builts`).

    `limits`: by the targets, 1 of what has none or is minimised alone. Those that are `counted` make the objective, of
    several the mean or the `worst`; `limiting` ones limit the search. Over the places the mean: of ratios to targets
    the geometric one.
    """

    def __init__(self, spec: Spec) -> None:
        if not spec.requirement:
            raise ValueError("the spec has no [[requirement]] to minimise: add one")
        self.spec, self.design = spec, spec.design or Design()
        places = hung_alike(spec)
        self.builts = [build_imu(at) for at, _ in places]
        weights = np.array([len(names) for _, names in places], dtype=float)
        self.weights = weights / np.sum(weights)
        name, aims = self.design.minimise, [limit_of(r) for r in spec.requirement]
        self.worst, self.of_logs = name == WORST, name in (ALL, WORST)
        alone = np.array([r.name == name for r in spec.requirement])
        self.targets = np.array([np.nan if aim is None else aim[1] for aim in aims])
        self.limits = np.where(alone | np.isnan(self.targets), 1.0, self.targets)
        self.counted = alone | self.of_logs
        self.limiting = ~self.counted & ~np.isnan(self.targets)
        self.units = [QUANTITIES[r.quantity] for r in spec.requirement]

    def statistics(self) -> list[Residual]:
        """The statistic of each requirement as a function of a covariance, SI."""
        built = self.builts[0]
        unseen = unseen_columns(built, posterior_and_answers(built)[1])
        return [residual_of(built, r, tuple(unseen.values())) for r in self.spec.requirement]

    def left(self, spec: Spec) -> Left:
        """What a spec's plan leaves."""
        rows = []
        for at, _ in hung_alike(spec):
            built = build_imu(at)
            known = own_of_imu(built)
            rows.append([residual_map(built, known, r).statistic() for r in self.spec.requirement])
        return np.array(rows)

    def soft(self, logs: Float[AnyArray, "s m"], sharpness: Any) -> Any:
        """What a search minimises, by the logarithms of all statistics over their limits: the objective, and the cost
        of what exceeds a limit; exact for an infinite sharpness, from above otherwise."""
        total, beyond = self._together(logs[:, self.counted], sharpness), logs[:, self.limiting]
        xp = namespace(beyond)
        # A limit is kept with a little room.
        return total + EXCESS * xp.sum(largest_log(xp.stack([beyond, xp.zeros_like(beyond)]), sharpness, axis=0))

    def _together(self, logs: Float[AnyArray, "s c"], sharpness: Any) -> Any:
        each = largest_log(logs, sharpness, axis=1) if self.worst else namespace(logs).mean(logs, axis=1)
        if self.of_logs or len(each) == 1:
            return self.weights @ each
        return namespace(each).log(self.weights @ namespace(each).exp(each))

    def value_of(self, left: Left) -> float:
        """The same of a plan."""
        return float(self.soft(np.log(left / self.limits), math.inf))

    def shown(self, left: Left) -> float:
        """The objective of a plan without limits, in the unit of `name_and_unit`."""
        logs = np.log(left / self.limits)[:, self.counted]
        return self.name_and_unit()[2] * math.exp(float(self._together(logs, math.inf)))

    def missed(self, left: Left) -> dict[str, float]:
        """By how much (natural logarithm) a plan exceeds targets that are limits, summed over the places, by name: by
        more than what counts as rounding."""
        excess = np.sum(np.maximum(np.log(left / self.limits), 0.0), axis=0)
        rows = zip(self.spec.requirement, excess, self.limiting, strict=True)
        return {r.name: float(by) for r, by, limits in rows if limits and by > KEPT}

    def name_and_unit(self) -> tuple[str, str, float]:
        """Name and unit of the objective for people, and how many of the unit are one of `value_of`, exponentiated."""
        counted = np.flatnonzero(self.counted)
        if self.worst or len(counted) > 1:
            name = "largest residual" if self.worst else "geometric mean of all residuals"
            return name, "" if np.any(np.isnan(self.targets[counted])) else "of the target", 1.0
        (k,) = counted
        row = self.spec.requirement[k]
        return f"{row.name} ({row.statistic})", self.units[k].unit, float(self.limits[k])

    def changes(self, before: Left, now: Left) -> tuple[RequirementChange, ...]:
        """What two plans leave of the requirements, at the worst place."""
        rows = zip(self.spec.requirement, self.units, np.max(before, axis=0), np.max(now, axis=0), strict=True)
        return tuple(RequirementChange(r.name, of.unit, finite(a), finite(b)) for r, of, a, b in rows)

    def met(self, left: Left) -> bool:
        """Whether every target is met by its rule with `MARGIN` at every place. Errors: `ValueError` where there is no
        target."""
        aimed = ~np.isnan(self.targets)
        if not np.any(aimed):
            raise ValueError(NO_TARGET)
        return bool(np.all(left[:, aimed] <= (1.0 - MARGIN) * self.targets[aimed]))


def largest_log(logs: AnyArray, sharpness: Any, axis: int) -> AnyArray:
    """The largest of logarithms, from above; infinite sharpness: exact."""
    if namespace(logs) is np:
        return np.max(logs, axis=axis)
    k = jnp.where(jnp.isfinite(sharpness), sharpness, 1.0)
    soft = jax.scipy.special.logsumexp(k * logs, axis=axis) / k
    return jnp.where(jnp.isfinite(sharpness), soft, jnp.max(logs, axis=axis))
