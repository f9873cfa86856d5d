"""Criteria of a design: residual statistics, smooth while searching, exact when reported.

With `s_ij` the residual at temperature i and rate j, and a sharpness k, the maximum over temperature is replaced by a
norm

    max_i s_ij  ≤  (Σ_i s_ij^k)^(1/k)  ≤  n_T^(1/k) · max_i s_ij

which tends to it as k grows; an infinite sharpness is the exact statistic.
"""

import equinox as eqx
import numpy as np
from jaxtyping import Float

from gradcal_jax.arrays import AnyArray, namespace
from gradcal_jax.information import SquareRootInformation
from gradcal_jax.information.imu_residual import box, heading_contrasts
from gradcal_jax.information.residual import EXACT, Statistic, contrasts, statistic
from gradcal_jax.information.verdicts import mission_weights
from gradcal_jax.model import BIAS, SCALE_FACTOR, SensorModel
from gradcal_jax.spec.requirement import MissionHeadingRequirement, Requirement


class Criterion(eqx.Module):
    """A named statistic of a residual map on a box; the value is in SI (1 for the scale factor, rad/s for the bias).

    `rows`, `alone`, `beyond`: see `information.contrasts`; `alone` is None without a discrepancy.
    """

    rows: Float[AnyArray, "g p"]
    alone: Float[AnyArray, "g p"] | None
    beyond: Float[AnyArray, " g"]
    shape: tuple[int, int] = eqx.field(static=True)
    statistic: Statistic = eqx.field(static=True)

    def map(self, info: SquareRootInformation) -> Float[AnyArray, "n_T n_w"]:
        """The residual on the box; differentiable, for a plan that observes everything."""
        xp = namespace(info.factor, self.rows)
        if self.alone is None:
            variance = info.deviations(self.rows) ** 2 + self.beyond
        else:
            # cᵀCc − αᵀCα = (c − α)ᵀC(c + α): one product instead of two triangular solves for many rows.
            half = (self.rows - self.alone) @ info.covariance()
            variance = xp.sum(half * (self.rows + self.alone), axis=1) + self.beyond
        return xp.reshape(xp.sqrt(variance), self.shape)

    def __call__(self, info: SquareRootInformation, sharpness: Float[AnyArray, ""] | float = EXACT):
        """The statistic: exact for an infinite sharpness, from above otherwise."""
        return statistic(self.statistic, self.map(info), sharpness)


def criterion_of(model: SensorModel, requirement: Requirement) -> Criterion:
    """A gyro's requirement, by its own statistic, as a criterion of its model's parameters (SI)."""
    at = box(requirement)
    quantity = SCALE_FACTOR if requirement.quantity.endswith("scale_factor") else BIAS
    if isinstance(requirement, MissionHeadingRequirement):
        of = heading_contrasts(model, requirement)
    else:
        of = contrasts(model, quantity, *(g.ravel() for g in np.meshgrid(*at, indexing="ij")))
    # Such that the unweighted statistic of missions is the weighted one.
    rows, alone, beyond = of.times(mission_weights(requirement, requirement.statistic)[:, 0])
    return Criterion(rows, alone if np.any(alone) else None, beyond, (len(at[0]), len(at[1])), requirement.statistic)
