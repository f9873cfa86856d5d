"""`[rig]` of a whole unit: the site, a table of one to three nested axes, how the unit hangs on it, the chamber."""

import math
from collections.abc import Mapping
from typing import Annotated, Final, Literal, cast

from pydantic import BeforeValidator, Field, model_validator

from gradcal_jax.files.bench import Chamber, Harmonic, Resolution
from gradcal_jax.files.problems import Problem
from gradcal_jax.files.quantity import (
    Angle,
    Latitude,
    Number,
    PositiveAcceleration,
    PositiveRate,
    PositiveSpecificForce,
    Quantity,
    SizeOfAngle,
    SizeOfSpecificForce,
    Text,
    Time,
    Travel,
)
from gradcal_jax.files.rig import Name
from gradcal_jax.files.section import Section, refuse

NO_ANGLE: Final = Quantity(0.0, "0 deg", "angle")
_DIRECTIONS: Final = {
    f"{sign}{axis}": tuple(float(f"{sign}1") * (k == i) for k in range(3))
    for i, axis in enumerate("xyz")
    for sign in "+-"
}
Direction = Literal["+x", "-x", "+y", "-y", "+z", "-z"]
Vector = tuple[Number, Number, Number]


class Site(Section):
    """Where the rig stands. `gravity` as far as it is known; its error is common to all accelerometers."""

    latitude: Latitude
    gravity: PositiveSpecificForce = Quantity(9.80665, "9.80665 m/s^2", "acceleration")
    gravity_accuracy: SizeOfSpecificForce = Quantity(0.0, "0 mg", "acceleration")


class AxisEncoder(Section):
    """An axis's angle: one draw of `standstill_offset` and one of `reading_noise` for each reading, `read_every` apart
    while it stands; `harmonics`: what repeats with the angle."""

    reading_noise: SizeOfAngle = NO_ANGLE
    standstill_offset: SizeOfAngle = NO_ANGLE
    read_every: Time = Quantity(1.0, "1 s", "time")
    harmonics: Annotated[tuple[Harmonic, ...], Field(max_length=50)] = ()


class TableAxis(Section):
    """`[[rig.table.axis]]`, outermost first. `direction`: of the axis while all stand at zero, in the frame that the
    axis outside it carries (the outermost: East, North, up). `orthogonality`: how well it is known to the next one."""

    name: Name
    direction: Vector
    max_rate: PositiveRate
    max_acceleration: PositiveAcceleration
    travel: Travel = Quantity(float("inf"), "unlimited", "angle")
    orthogonality: SizeOfAngle = NO_ANGLE
    angle: AxisEncoder = AxisEncoder()

    @model_validator(mode="after")
    def _points_somewhere(self) -> "TableAxis":
        if not math.hypot(*self.direction) > 0.0:
            refuse(Problem(("direction",), "is no direction; expected such as [0.0, 0.0, 1.0]", list(self.direction)))
        return self

    @property
    def unit_vector(self) -> tuple[float, ...]:
        """The direction, of length 1."""
        length = math.hypot(*self.direction)
        return tuple(c / length for c in self.direction)


class UnitMounting(Section):
    """`[rig.table.mounting]`: along which axes of the innermost table axis's frame the body's x, y and z point, turned
    on by the rotation vector `rotation` (body); `accuracy`: of each of the three angles."""

    name: Text | None = None
    x: Direction = "+x"
    y: Direction = "+y"
    z: Direction = "+z"
    rotation: tuple[Angle, Angle, Angle] | None = None
    accuracy: SizeOfAngle = NO_ANGLE

    @model_validator(mode="after")
    def _right_handed(self) -> "UnitMounting":
        if self.determinant != 1.0:
            said = f"x = {self.x}, y = {self.y}, z = {self.z}"
            refuse(Problem((), "the body's axes must be three different ones and right-handed (x × y = z)", said))
        return self

    @property
    def columns(self) -> tuple[tuple[float, ...], ...]:
        """The body's x, y and z in the frame of the innermost axis, before `rotation`."""
        return tuple(_DIRECTIONS[d] for d in (self.x, self.y, self.z))

    @property
    def determinant(self) -> float:
        """1 for a rotation."""
        (a, b, c), (d, e, f), (g, h, i) = self.columns
        return a * (e * i - f * h) - b * (d * i - f * g) + c * (d * h - e * g)


def _one_or_more(value: object) -> object:
    return (cast("object", value),) if isinstance(value, Mapping) else value


class UnitTable(Section):
    """The table. `tilt`, `azimuth`: how well it is known how the base stands. It holds its axes where they stand."""

    standing: Literal["held"] = "held"
    tilt: SizeOfAngle = NO_ANGLE
    azimuth: SizeOfAngle = NO_ANGLE
    axis: Annotated[tuple[TableAxis, ...], Field(min_length=1, max_length=3)]
    mounting: Annotated[tuple[UnitMounting, ...], BeforeValidator(_one_or_more), Field(min_length=1, max_length=12)] = (
        UnitMounting(),
    )

    @model_validator(mode="after")
    def _consistent(self) -> "UnitTable":
        names = [axis.name for axis in self.axis]
        problems = [
            Problem(("axis", i, "name"), "two axes have this name", name)
            for i, name in enumerate(names)
            if name in names[:i]
        ]
        if self.axis[-1].orthogonality:
            message = "is told to the next axis inside, and there is none; leave it out of the innermost one"
            problems.append(
                Problem(("axis", len(names) - 1, "orthogonality"), message, str(self.axis[-1].orthogonality))
            )
        refuse(*problems)
        return self


class UnitRig(Section):
    """The bench of a whole unit."""

    name: Text | None = None
    site: Site
    table: UnitTable
    chamber: Chamber
    resolution: Resolution | None = None
