"""Errors that depend on the path of temperature and not on its present value alone, and error classes of one's own."""

from collections.abc import Iterator
from typing import Annotated

from pydantic import Field

from gradcal_jax.tables import quantity as q
from gradcal_jax.tables.problems import Problem
from gradcal_jax.tables.section import Section


class PlayOfBias(Section):
    """An error that depends on past temperatures: a play follows the temperature with a backlash of ± `width`,
    and the error is proportional to the difference between play and temperature. If the temperature changes by more
    than twice the width, heating and cooling differ by 2 × coefficient × width."""

    width: q.PositiveTemperatureDifference
    """Half-width of the play."""
    prior: q.PositiveBiasSlope
    """Standard deviation of the coefficient (error for each K between play and temperature) before the calibration."""


class PlayOfForce(PlayOfBias):
    """Hysteresis of an accelerometer's bias, modelled like that of a gyro's bias."""

    prior: q.PositiveAccelerationSlope


class PlayOfScaleFactor(PlayOfBias):
    """Hysteresis of the scale factor, modelled like that of the bias."""

    prior: q.PositiveScaleFactorSlope  # pyright: ignore[reportIncompatibleVariableOverride]


class ScaleFactorTemperatureGradient(Section):
    """Estimated sensitivity of the scale factor to dT/dt."""

    prior: q.PositiveScaleFactorGradient
    """Standard deviation of the coefficient before the calibration."""


class DifferenceOfBias(Section):
    """Bias proportional to the reading of the second thermometer minus that of the first."""

    prior: q.PositiveBiasSlope
    """Standard deviation of the coefficient before the calibration."""


class DifferenceOfForce(DifferenceOfBias):
    """Bias of an accelerometer, proportional to the reading of the second thermometer minus that of the first."""

    prior: q.PositiveAccelerationSlope


class SecondThermometer(Section):
    """A second thermometer, for example on the case, in addition to the first one (at the dies)."""

    lag: q.Time
    """First-order lag of the second thermometer's temperature behind that of the first; used in predictions only,
    because logs have its readings."""


Factor = Annotated[str, Field(pattern=r"^((rate|force) [xyz]|\|(rate|force) [xyz]\||dT/dt)$")]


class OwnError(Section):
    """An estimated error term of your own: a product of `factors`, or a subclass of `gradcal_jax.model.OwnTerm`."""

    term: q.Text | None = None
    """Name of the class."""
    factors: tuple[Factor, ...] = ()
    """The factors of the product, such as ["force x", "|force y|"] or ["rate z", "dT/dt"], in SI units (rad/s, m/s²,
    K/s)."""
    prior: Annotated[q.Number, Field(gt=0.0)]
    """Standard deviation of each parameter of the term before the calibration, in SI units."""
    name: q.Text | None = None
    """Name of the parameters; absent: the name of the class, or the factors."""

    def _problems(self) -> Iterator[Problem]:
        if (self.term is None) == (not self.factors):
            yield Problem((), "give either the factors of a product, or the term of a class")


Plays = Annotated[tuple[PlayOfBias, ...], Field(max_length=10)]
ScaleFactorPlays = Annotated[tuple[PlayOfScaleFactor, ...], Field(max_length=10)]


class TemperaturePath(Section):
    """Errors that depend on past temperatures, and not only on the present one, and error terms of your own; all are
    estimated."""

    hysteresis: Plays = ()
    """Hysteresis of the bias, as a sum of plays."""
    scale_factor_hysteresis: ScaleFactorPlays = ()
    """Hysteresis of the scale factor, as a sum of plays."""
    scale_factor_temperature_gradient: ScaleFactorTemperatureGradient | None = None
    """Scale-factor error proportional to dT/dt."""
    own: Annotated[tuple[OwnError, ...], Field(max_length=20)] = ()
    """Error terms of your own."""
    thermometer_difference: DifferenceOfBias | None = None
    """Bias proportional to the difference of the two thermometers."""

    @property
    def on_path(self) -> bool:
        """Whether any of these is named."""
        return any(getattr(self, key) for key in TemperaturePath.model_fields)

    def _problems(self) -> Iterator[Problem]:
        for key in ("hysteresis", "scale_factor_hysteresis"):
            widths = [float(play.width) for play in getattr(self, key)]
            if len(set(widths)) < len(widths):
                yield Problem((key,), "two entries have the same width, so their coefficients cannot be separated")
