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
    """A box of temperature and rate. `grid`: numbers of temperatures and of rates, ends included.

    `target` is a limit on the error. It is met where `coverage` times the statistic of the standard deviation is
    within it (simple acceptance; 1, where the key is absent, as in files of before and in the paper). With `risk` it is
    guarded: met where the error at the worst place of the box is beyond it with no more than that chance.
    """

    name: Text
    quantity: Literal["scale_factor"]
    temperature: tuple[Temperature, Temperature]
    rate: tuple[Rate, Rate]
    statistic: Literal["mean of max", "max", "mean", "rms"] = "mean of max"
    target: PositiveScaleFactor | None = None
    coverage: Coverage = 1.0
    risk: Risk | None = None
    grid: tuple[Points, Points] = (101, 121)

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
    """A range of temperature. `grid`: number of temperatures, ends included. `target`: as of a scale factor."""

    name: Text
    quantity: Literal["bias"]
    temperature: tuple[Temperature, Temperature]
    statistic: Annotated[Literal["max", "mean", "rms"], BeforeValidator(_rates_only)] = "mean"
    target: PositiveRate | None = None
    coverage: Coverage = 1.0
    risk: Risk | None = None
    grid: tuple[Points] = (101,)

    @model_validator(mode="after")
    def _ordered(self) -> "BiasRequirement":
        refuse(*increasing(self.temperature, "temperature"))
        return self


def _requirement(value: object) -> object:
    return choose(value, "quantity", {"scale_factor": ScaleFactorRequirement, "bias": BiasRequirement})


Requirement = Annotated[ScaleFactorRequirement | BiasRequirement, BeforeValidator(_requirement)]
