"""`[[requirement]]`: what the calibration must serve, and how the residual is summed up there."""

from typing import Annotated, Literal

from pydantic import BeforeValidator, Field, Strict, model_validator

from gradcal_jax.files.bases import increasing
from gradcal_jax.files.mission import Missions
from gradcal_jax.files.problems import Problem
from gradcal_jax.files.quantity import (
    Of,
    PositiveAngle,
    PositiveRate,
    PositiveScaleFactor,
    Quantity,
    Rate,
    Temperature,
    Text,
    Time,
)
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


class HeadingRequirement(Section):
    """What the calibration leaves of the integrated rate at the end of a `mission`, or `after` a time in it.

    Of several missions the root mean square by their weights, or the "max". `target` limits the calibration's part
    alone: the unit's own noise no calibration takes off. `coverage`, `risk`: as of a scale factor.
    """

    name: Text
    """Its name, by which verdicts and [design] speak of it."""
    quantity: Literal["heading"]
    """What must be good."""
    mission: Missions
    """Tables of rate and temperature over time, with weights."""
    after: Time | None = None
    """When the error is taken; absent: at the end of each mission."""
    statistic: Literal["rms", "max"] = "rms"
    """How several missions are summed up."""
    target: PositiveAngle | None = None
    """Limit on the error that the calibration leaves, which gives a verdict; absent: none."""
    coverage: Coverage = 1.0
    """Standard deviations that must be within the target; 1 as in the paper."""
    risk: Risk | None = None
    """Largest chance that a unit beyond the target passes; absent: simple acceptance."""

    @model_validator(mode="after")
    def _within(self) -> "HeadingRequirement":
        problems: list[Problem] = []
        for i, mission in enumerate(self.mission):
            end = mission.rows.time[-1]
            if self.after is not None and self.after > end:
                message = f"is after the end of {mission.file}, which lasts {end:.6g} s"
                problems.append(Problem(("after",), message, self.after.text))
            if self.statistic == "max" and "weight" in mission.model_fields_set:
                problems.append(
                    Problem(("mission", i, "weight"), 'has no effect on the statistic "max"', mission.weight)
                )
        refuse(*problems)
        return self

    @property
    def grid(self) -> tuple[int]:
        """Number of missions."""
        return (len(self.mission),)

    @property
    def temperature(self) -> tuple[Quantity, Quantity]:
        """The coldest and the warmest of all missions."""
        every = [t for mission in self.mission for t in mission.rows.temperature]
        return Quantity.of(min(every), "degC"), Quantity.of(max(every), "degC")

    @property
    def rate(self) -> tuple[Quantity, Quantity]:
        """The least and the largest rate of all missions."""
        every = [w for mission in self.mission for w in mission.rows.rate]
        return Quantity.of(min(every), "deg/s"), Quantity.of(max(every), "deg/s")


class NorthRequirement(Section):
    """The error of a gyrocompass: of the bias, over the Earth's rate across the meridian at the `latitude`.

    `after`: how long it stands to find north, of which the unit's own noise depends. The rest as of a bias.
    """

    name: Text
    """Its name, by which verdicts and [design] speak of it."""
    quantity: Literal["north"]
    """What must be good."""
    latitude: Annotated[Quantity, Of("angle", at_least="-89 deg", at_most="89 deg")]
    """Where north is sought."""
    after: Time
    """How long it stands to find north, on which the unit's own noise depends."""
    temperature: tuple[Temperature, Temperature]
    """Lowest and highest temperature."""
    statistic: Literal["max", "mean", "rms"] = "mean"
    """How the standard deviation is summed up over temperature."""
    target: PositiveAngle | None = None
    """Limit on the error that the calibration leaves, which gives a verdict; absent: none."""
    coverage: Coverage = 1.0
    """Standard deviations that must be within the target; 1 as in the paper."""
    risk: Risk | None = None
    """Largest chance that a unit beyond the target passes; absent: simple acceptance."""
    grid: tuple[Points] = (101,)
    """Number of temperatures at which the range is evaluated, ends included."""

    @model_validator(mode="after")
    def _ordered(self) -> "NorthRequirement":
        refuse(*increasing(self.temperature, "temperature"))
        return self


def _requirement(value: object) -> object:
    classes: dict[str, type[Section]] = {
        "scale_factor": ScaleFactorRequirement,
        "bias": BiasRequirement,
        "heading": HeadingRequirement,
        "north": NorthRequirement,
    }
    return choose(value, "quantity", classes)


Requirement = Annotated[
    ScaleFactorRequirement | BiasRequirement | HeadingRequirement | NorthRequirement, BeforeValidator(_requirement)
]
