"""`[[requirement]]`: what the calibration must serve, and how the residual is summed up there."""

from typing import Annotated, Literal

from pydantic import BeforeValidator, Field, Strict, model_validator

from gradcal_jax.files.bases import increasing
from gradcal_jax.files.problems import Problem
from gradcal_jax.files.quantity import Of, PositiveRate, PositiveScaleFactor, Quantity, Rate, Temperature, Text
from gradcal_jax.files.section import Section, choose, refuse

Coverage = Annotated[float, Strict(), Field(gt=0.0, le=10.0, allow_inf_nan=False)]
Risk = Annotated[Quantity, Of("scale factor", above="0 %", at_most="50 %")]
Points = Annotated[int, Field(strict=True, ge=2, le=5001)]


def _rates_only(value: object) -> object:
    if value == "mean of max":
        raise ValueError('a bias has no rate to average over; expected "mean", "max" or "rms"')
    return value


class ScaleFactorRequirement(Section):
    """What a calibration must serve: the scale factor's error over a box of temperature and rate.

    The target is met where `coverage` times the statistic is within it (simple acceptance); with `risk` it is guarded:
    met where the error at the worst place of the box is beyond it with no more than that chance.
    """

    name: Text
    """Its name, by which verdicts and [design] speak of it."""
    quantity: Literal["scale_factor"]
    """What must be good."""
    temperature: tuple[Temperature, Temperature]
    """Lowest and highest temperature of the box."""
    rate: tuple[Rate, Rate]
    """Lowest and highest rate of the box."""
    statistic: Literal["mean of max", "max", "mean", "rms"] = "mean of max"
    """How the standard deviation is summed up over the box; "mean of max": mean over rate of the largest over
    temperature."""
    target: PositiveScaleFactor | None = None
    """Limit on the error, which gives a verdict; absent: none."""
    coverage: Coverage = 1.0
    """Standard deviations that must be within the target; 1 as in the paper."""
    risk: Risk | None = None
    """Largest chance that a unit beyond the target passes; absent: simple acceptance."""
    grid: tuple[Points, Points] = (101, 121)
    """Numbers of temperatures and of rates at which the box is evaluated, ends included."""

    @model_validator(mode="after")
    def _ordered(self) -> "ScaleFactorRequirement":
        too_fine = [Problem(("grid",), "at most 1000000 points together", list(self.grid))]
        fine = self.grid[0] * self.grid[1] > 1_000_000
        refuse(
            *increasing(self.temperature, "temperature"),
            *increasing(self.rate, "rate"),
            *(too_fine if fine else []),
        )
        return self


class BiasRequirement(Section):
    """What a calibration must serve: the bias's error over a range of temperature. Targets as of a scale factor."""

    name: Text
    """Its name, by which verdicts and [design] speak of it."""
    quantity: Literal["bias"]
    """What must be good."""
    temperature: tuple[Temperature, Temperature]
    """Lowest and highest temperature."""
    statistic: Annotated[Literal["max", "mean", "rms"], BeforeValidator(_rates_only)] = "mean"
    """How the standard deviation is summed up over temperature."""
    target: PositiveRate | None = None
    """Limit on the error, which gives a verdict; absent: none."""
    coverage: Coverage = 1.0
    """Standard deviations that must be within the target; 1 as in the paper."""
    risk: Risk | None = None
    """Largest chance that a unit beyond the target passes; absent: simple acceptance."""
    grid: tuple[Points] = (101,)
    """Number of temperatures at which the range is evaluated, ends included."""

    @model_validator(mode="after")
    def _ordered(self) -> "BiasRequirement":
        refuse(*increasing(self.temperature, "temperature"))
        return self


def _requirement(value: object) -> object:
    return choose(value, "quantity", {"scale_factor": ScaleFactorRequirement, "bias": BiasRequirement})


Requirement = Annotated[ScaleFactorRequirement | BiasRequirement, BeforeValidator(_requirement)]
