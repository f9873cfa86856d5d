"""Tests of a fit against the model, on whitened residuals, which are independent with variance one: is the noise as
large as in the spec?"""

from typing import NamedTuple

from scipy import special

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


def chi_squared_test(statistic: float, degrees: int) -> Test:
    """Test of a statistic against χ² with `degrees` degrees of freedom; passed without any."""
    if degrees <= 0:
        return Test(float(statistic), 0, 1.0)
    return Test(float(statistic), int(degrees), float(special.chdtrc(degrees, statistic)))
