"""Tests of a fit against the model, on whitened residuals, which are independent with variance one: is the noise as
large as in the spec?"""

from typing import NamedTuple

import numpy as np
from scipy import special

from gradcal_jax.estimation.imu_solve import ImuEstimate

_RARE = 0.01


class Test(NamedTuple):
    """A statistic that is χ² with `degrees` where the model is true; `probability` of one as large or larger."""

    __test__ = False  # not a class of tests for pytest

    statistic: float
    degrees: int
    probability: float

    @property
    def passed(self) -> bool:
        """Whether the statistic is plausible at the level of 1 %."""
        return self.probability > _RARE


class Consistency(NamedTuple):
    """The χ² test of a fit. `noise_scale`: √(χ²/degrees), the factor by which the noise differs from the spec;
    `beyond_three`: share of the residuals beyond three standard deviations; `largest`: the largest of them."""

    fit: Test
    noise_scale: float
    beyond_three: float
    largest: float

    @property
    def excess(self) -> float:
        """The factor by which residuals exceed the spec's noise where the χ² test fails; otherwise 1."""
        return max(1.0, self.noise_scale) if not self.fit.passed and self.fit.degrees > 0 else 1.0


def chi_squared_test(statistic: float, degrees: int) -> Test:
    """Test of a statistic against χ² with `degrees` degrees of freedom; passed without any."""
    if degrees <= 0:
        return Test(float(statistic), 0, 1.0)
    return Test(float(statistic), int(degrees), float(special.chdtrc(degrees, statistic)))


def consistency(solution: ImuEstimate) -> Consistency:
    """The χ² test of a fit, and its largest residuals."""
    residual, degrees, squares = solution.residuals, solution.degrees, solution.chi_squared
    return Consistency(
        chi_squared_test(squares, degrees),
        float(np.sqrt(squares / degrees)) if degrees > 0 else float("nan"),
        float(np.mean(np.abs(residual) > 3.0)) if len(residual) else 0.0,
        float(np.max(np.abs(residual), initial=0.0)),
    )
