"""Errors that depend on the path of temperature and not on its present value alone, and error classes of one's own."""

from collections.abc import Iterator
from typing import Annotated

from pydantic import Field

from gradcal_jax.tables import quantity as q
from gradcal_jax.tables.problems import Problem
from gradcal_jax.tables.section import Section


class VariationOfBias(Section):
    """How the coefficient of a play varies with temperature: Legendre polynomials of the degrees 1 to `degree` in (T −
    `centre`)/`scale` are added to the coefficient. A loop that is not a sum of plays, for example a loop of many
    relays, is wider at some temperatures than at others."""

    standard_deviation: q.PositiveBiasSlope
    """Standard deviation of the coefficient of each polynomial before the calibration."""
    degree: Annotated[int, Field(ge=1, le=20)]
    """Highest degree."""
    centre: q.Temperature
    """Temperature at which the argument of the polynomials is 0."""
    scale: q.PositiveTemperatureDifference
    """Change of temperature over which the argument of the polynomials changes by 1."""


class VariationOfForce(VariationOfBias):
    """Variation of the coefficient of an accelerometer's play with temperature, like that of a gyro's."""

    standard_deviation: q.PositiveAccelerationSlope


class VariationOfScaleFactor(VariationOfBias):
    """Variation of the coefficient of a scale factor's play with temperature, like that of a bias."""

    standard_deviation: q.PositiveScaleFactorSlope  # pyright: ignore[reportIncompatibleVariableOverride]


class PlayOfBias(Section):
    """An error that depends on past temperatures: a play follows the temperature with a backlash of ± `width`,
    and the error is proportional to the difference between play and temperature. If the temperature changes by more
    than twice the width, heating and cooling differ by 2 × coefficient × width."""

    width: q.PositiveTemperatureDifference
    """Half-width of the play."""
    prior: q.PositiveBiasSlope
    """Standard deviation of the coefficient (error for each K between play and temperature) before the calibration."""
    over_temperature: VariationOfBias | None = None
    """Estimated variation of the coefficient with temperature; absent: the coefficient is constant."""


class PlayOfForce(PlayOfBias):
    """Hysteresis of an accelerometer's bias, modelled like that of a gyro's bias."""

    prior: q.PositiveAccelerationSlope
    over_temperature: VariationOfForce | None = None  # pyright: ignore[reportIncompatibleVariableOverride]


class PlayOfScaleFactor(PlayOfBias):
    """Hysteresis of the scale factor, modelled like that of the bias."""

    prior: q.PositiveScaleFactorSlope  # pyright: ignore[reportIncompatibleVariableOverride]
    over_temperature: VariationOfScaleFactor | None = None  # pyright: ignore[reportIncompatibleVariableOverride]


class ScaleFactorTemperatureGradient(Section):
    """Estimated sensitivity of the scale factor to dT/dt."""

    prior: q.PositiveScaleFactorGradient
    """Standard deviation of the coefficient before the calibration."""


class LateGradientOfBias(Section):
    """Bias proportional to dT/dt after a first-order lag, for example of a part that heats slowly. At the start, the
    lag is in equilibrium, as after a soak."""

    time_constant: q.Time
    """Time constant of the lag."""
    prior: q.SizeOfGradientSensitivity
    """Standard deviation of the coefficient before the calibration."""
    time_constant_uncertainty: q.Time | None = None
    """Standard uncertainty of the time constant; absent: the time constant is known. The error is then modelled by
    two terms, with a longer and a shorter time constant."""

    @property
    def lags(self) -> tuple[float, ...]:
        """The time constants of its terms, s. With independent coefficients of 1/√2 of the prior each, the sum of both
        has its variance, and their difference that of the coefficient times the time constant's error."""
        time, apart = float(self.time_constant), float(self.time_constant_uncertainty or 0.0)
        return (time - apart, time + apart) if apart else (time,)

    def _problems(self) -> Iterator[Problem]:
        if min(self.lags) <= 0.0:
            yield Problem(("time_constant_uncertainty",), "must be less than the time constant")


class LateGradientOfForce(LateGradientOfBias):
    """Bias of an accelerometer, proportional to dT/dt after a first-order lag."""

    prior: q.ForceGradientSensitivity


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
    late_temperature_gradient: Annotated[tuple[LateGradientOfBias, ...], Field(max_length=5)] = ()
    """Bias proportional to dT/dt that a first-order lag has filtered; the biases of several entries are added."""
    thermometer_difference: DifferenceOfBias | None = None
    """Bias proportional to the difference of the two thermometers."""

    @property
    def on_path(self) -> bool:
        """Whether any of these is named."""
        return any(getattr(self, key) for key in TemperaturePath.model_fields)

    def _problems(self) -> Iterator[Problem]:
        differ_by = {
            "hysteresis": "width",
            "scale_factor_hysteresis": "width",
            "late_temperature_gradient": "time_constant",
        }
        for key, of in differ_by.items():
            values = [float(getattr(entry, of)) for entry in getattr(self, key)]
            if len(set(values)) < len(values):
                yield Problem((key,), f"two entries have the same {of}, so their coefficients cannot be separated")
