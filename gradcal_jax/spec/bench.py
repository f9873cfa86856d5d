"""`[rig]` of a spec: site, table (axes, encoders, mountings, places), chamber, controllers' resolution."""

import math
from collections.abc import Iterable, Iterator, Sequence
from typing import Annotated, Final, Literal

from pydantic import Field

from gradcal_jax.spec.bases import increasing
from gradcal_jax.spec.rig import Name
from gradcal_jax.tables import quantity as q
from gradcal_jax.tables.problems import Problem, repeated_names
from gradcal_jax.tables.section import OneOrMore, Section

NO_TIME: Final = q.Quantity(0.0, "0 s", "time")


class Harmonic(Section):
    """Repeatable error of the encoder: the error is periodic in the angle."""

    order: Annotated[q.Count, Field(le=100_000)]
    """Periods in one turn."""
    amplitude: q.SizeOfAngle
    """Standard deviation of the cosine part and of the sine part."""


class Chamber(Section):
    """The climatic chamber: its range and its rates."""

    range: tuple[q.Temperature, q.Temperature]
    """Coldest and hottest temperature of the chamber."""
    max_heating: q.PositiveTemperatureSlope
    """Steepest heating slope."""
    max_cooling: q.PositiveTemperatureSlope
    """Steepest cooling slope, as a positive number."""
    control: Literal["chamber", "none"] = "chamber"
    """"none": there is no chamber; a fridge, a hair dryer or a bag of ice can be used. The run follows the clock:
    it neither commands temperatures nor waits for them, and its rig file needs no chamber. The operator tries to follow
    the planned temperature, and the actual temperature is recorded."""

    def _problems(self) -> Iterable[Problem]:
        return increasing(self.range, "range")


class Resolution(Section):
    """Steps of the controllers; the values of a recipe are rounded to multiples of these steps."""

    temperature: q.PositiveTemperatureDifference | None = None
    """Step of a temperature set point."""
    time: q.Time | None = None
    """Step of a duration."""
    rate: q.PositiveRate | None = None
    """Step of a rate."""
    acceleration: q.PositiveAcceleration | None = None
    """Step of an acceleration."""
    angle: q.SizeOfAngle | None = None
    """Step of an angle."""


NO_ANGLE: Final = q.Quantity(0.0, "0 deg", "angle")
_DIRECTIONS: Final = {
    f"{sign}{axis}": tuple(float(f"{sign}1") * (k == i) for k in range(3))
    for i, axis in enumerate("xyz")
    for sign in "+-"
}
Direction = Literal["+x", "-x", "+y", "-y", "+z", "-z"]
Vector = tuple[q.Number, q.Number, q.Number]
Spacing = q.Positive[Annotated[q.Quantity, q.Of("time", infinite="rest")]]


class Site(Section):
    """Where the rig stands."""

    latitude: q.Latitude | None = None
    """Geodetic latitude, north positive. For gyros along the only axis of a table it may be absent or "unknown"; then
    up to 15.04 deg/h of the Earth's rate count in their bias."""
    gravity: q.PositiveSpecificForce | None = None
    """Local gravity; absent: normal gravity at sea level for the latitude."""
    gravity_accuracy: q.SizeOfSpecificForce = q.Quantity(0.0, "0 mg", "acceleration")
    """Standard deviation of gravity; the error is common to all accelerometers."""

    @property
    def latitude_rad(self) -> float:
        """The latitude as it is used: the equator's where it is not stated."""
        return 0.0 if self.is_unknown else float(self.latitude or 0.0)

    @property
    def is_unknown(self) -> bool:
        """Whether the file says that the latitude is unknown."""
        return self.latitude == math.inf

    @property
    def gravity_m_per_s2(self) -> float:
        """Gravity as it is used, m/s²: stated, or Somigliana's formula with the constants of WGS 84 (NIMA TR8350.2,
        2000, section 4)."""
        if self.gravity is not None:
            return float(self.gravity)
        sine = math.sin(self.latitude_rad) ** 2
        return 9.7803253359 * (1.0 + 0.00193185265241 * sine) / math.sqrt(1.0 - 0.00669437999013 * sine)


class AxisEncoder(Section):
    """Errors of the angle of one table axis: white noise of each reading, an error common to a standstill, errors
    periodic in the angle, a scale error, and an error of time during moves; and how often this angle is read."""

    reference: Literal["encoder", "gravity"] = "encoder"
    """"gravity": no axis has an encoder. The IMU's accelerometers measure the angle of every standstill, and its gyros
    count whole turns. The actual angles may differ from the plan, and each is estimated. Leave out all other keys
    except `read_every`."""
    read_every: Spacing = q.Quantity(1.0, "1 s", "time")
    """Time between readings at rest; "rest": one reading, at the end of each rest."""
    reading_noise: q.SizeOfAngle = q.Quantity(0.0, "0 deg", "angle")
    """Standard deviation of each reading, independent of all others."""
    standstill_offset: q.SizeOfAngle = q.Quantity(0.0, "0 deg", "angle")
    """Standard deviation of an error that all readings of one standstill share; it is independent in the next
    standstill."""
    timing_error: q.SizeOfTime = q.Quantity(0.0, "0 s", "time")
    """Standard deviation of the time of a reading during a move; multiplied by the rate, it is an angle error."""
    scale_error: q.SizeOfScaleFactor | None = None
    """Standard deviation of the relative scale error of the angle (gear ratio, counts per revolution)."""
    backlash: q.SizeOfAngle | None = None
    """Standard deviation of the backlash of a drive whose angle is read at the motor: by so much the axis stands apart
    after turns in the two directions. 0 for an encoder on the axis."""
    harmonics: Annotated[tuple[Harmonic, ...], Field(max_length=50)] = ()
    """Errors that are periodic in the angle."""

    def _problems(self) -> Iterable[Problem]:
        message = "this order appears twice: give one amplitude for each order"
        return repeated_names("harmonics", "order", [str(harmonic.order) for harmonic in self.harmonics], message)


class TableAxis(Section):
    """An axis of the table; the axes are listed from the outermost inwards."""

    name: Name
    """Name of the axis, used by moves."""
    direction: Vector = (0.0, 0.0, 1.0)
    """Direction of the axis if all axes are at zero, in the frame that turns with the next outer axis (for the
    outermost axis: East, North, up); absent: up."""
    max_rate: q.PositiveRate
    """Largest rate."""
    max_acceleration: q.PositiveAcceleration
    """Largest acceleration."""
    travel: q.Travel = q.Quantity(float("inf"), "unlimited", "angle")
    """Largest angle from zero in each direction; "unlimited" if no cable winds up."""
    orthogonality: q.SizeOfAngle = NO_ANGLE
    """Standard deviation of the error of the angle between this axis and the next inner axis."""
    angle: AxisEncoder = AxisEncoder()
    """Errors of the angle of this axis."""

    def _problems(self) -> Iterator[Problem]:
        if not math.hypot(*self.direction) > 0.0:
            message = "is not a direction; expected a vector such as [0.0, 0.0, 1.0]"
            yield Problem(("direction",), message, list(self.direction))

    @property
    def reach(self) -> tuple[float, float]:
        """The allowed range of angles (rad)."""
        return -float(self.travel), float(self.travel)

    @property
    def unit_vector(self) -> tuple[float, ...]:
        """The direction, of length 1."""
        length = math.hypot(*self.direction)
        return tuple(c / length for c in self.direction)


def _determinant(matrix: Iterable[Sequence[float]]) -> float:
    """Of a 3 × 3 matrix: 1 for a rotation."""
    (a, b, c), (d, e, f), (g, h, i) = matrix
    return a * (e * i - f * h) - b * (d * i - f * g) + c * (d * h - e * g)


class Mounting(Section):
    """The mounting of the IMU on the innermost axis."""

    name: q.Text | None = None
    """A title for tables and pages."""
    x: Direction = "+x"
    """Direction of the body's x axis in the frame of the innermost table axis."""
    y: Direction = "+y"
    """Direction of the body's y axis in the frame of the innermost table axis."""
    z: Direction = "+z"
    """Direction of the body's z axis in the frame of the innermost table axis."""
    rotation: tuple[q.Angle, q.Angle, q.Angle] | None = None
    """Additional rotation, as a rotation vector in the body frame."""
    accuracy: q.SizeOfAngle = NO_ANGLE
    """Standard deviation of the mounting error about each of the three axes."""

    def _problems(self) -> Iterator[Problem]:
        if _determinant(self.columns) != 1.0:
            directions = f"x = {self.x}, y = {self.y}, z = {self.z}"
            yield Problem((), "the body's axes must be three different ones and right-handed (x × y = z)", directions)

    @property
    def columns(self) -> tuple[tuple[float, ...], ...]:
        """Body x, y and z in the innermost axis's frame, before `rotation`."""
        return tuple(_DIRECTIONS[d] for d in (self.x, self.y, self.z))


class Place(Mounting):
    """`[[rig.table.place]]`: the place of an IMU in a fixture with several IMUs. Its directions are in the fixture's
    frame, and the table's mountings are those of the fixture."""

    name: q.Text  # pyright: ignore[reportIncompatibleVariableOverride, reportGeneralTypeIssues]
    """Name of the place. The IMU of the same name in a run or log is mounted at this place."""


class RigTable(Section):
    """The table."""

    grade: Literal["coarse", "middle", "fine"] | None = None
    """Class whose typical figures hold for all errors of the table that the spec does not state; absent: the errors of
    the angle determine the class, and its figures count only in verdicts."""
    standing: Literal["held", "read"] = "held"
    """"held": an axis at rest does not turn; "read": an axis at rest may turn a little, and its angle is known only
    from the readings, one every `read_every`."""
    drive: Literal["motor", "hand"] = "motor"
    """"motor": motors turn the axes; "hand": the operator turns the axes of a gimbal."""
    answer_time: q.SizeOfTime = NO_TIME
    """Time that the operator needs for each turn in addition to its duration: half of this time to read the request
    before the turn, half to answer afterwards."""
    tilt: q.SizeOfAngle = NO_ANGLE
    """Standard deviation of the base's two tilts."""
    azimuth: q.SizeOfAngle = NO_ANGLE
    """Standard deviation of the base's azimuth."""
    rate_accuracy: q.SizeOfScaleFactor | None = None
    """Standard deviation, as a ratio, of the reference rate of the standard method; absent: the reference is exact."""
    axis: Annotated[tuple[TableAxis, ...], Field(min_length=1, max_length=3), OneOrMore()]
    """Axes of the table, outermost first."""
    mounting: Annotated[tuple[Mounting, ...], Field(min_length=1, max_length=12), OneOrMore()] = (Mounting(),)
    """The mounting of the IMU, or several mountings that are used one after the other."""
    place: Annotated[tuple[Place, ...], Field(max_length=64)] = ()
    """Places of a fixture that holds several IMUs; absent: one IMU, in the mounting of the table."""

    @property
    def typed(self) -> bool:
        """Whether an operator types angles, and none where no cycle fills a stretch of used data."""
        told = self.drive == "hand" and all(math.isinf(axis.angle.read_every) for axis in self.axis)
        return told and not self.by_gravity

    @property
    def by_gravity(self) -> bool:
        """Whether no encoder tells the angles, and gravity does."""
        return self.axis[0].angle.reference == "gravity"

    def _problems(self) -> Iterator[Problem]:
        yield from repeated_names("axis", "name", [axis.name for axis in self.axis], "two axes have this name")
        yield from repeated_names("place", "name", [place.name for place in self.place], "two places have this name")
        if self.axis[-1].orthogonality:
            message = "refers to the next axis inside, and the innermost axis has none: leave this key out"
            yield Problem(("axis", len(self.axis) - 1, "orthogonality"), message, str(self.axis[-1].orthogonality))
        if any(axis.angle.reference == "gravity" for axis in self.axis):
            yield from self._without_encoder()
        every = [axis.angle.read_every for axis in self.axis]
        if self.standing == "read" and any(e != every[0] for e in every):
            message = 'if standing is "read", all axes of the table are read together: give the same time for all axes'
            k = next(i for i, e in enumerate(every) if e != every[0])
            yield Problem(("axis", k, "angle", "read_every"), message, str(every[k]))

    def _without_encoder(self) -> Iterator[Problem]:
        """Keys that speak of an encoder where an axis has none."""
        message = 'is only for an encoder, and the reference of the angle is "gravity": leave this key out'
        if self.standing == "read":
            yield Problem(("standing",), message, self.standing)
        if self.rate_accuracy is not None:
            yield Problem(("rate_accuracy",), message, str(self.rate_accuracy))
        for k, axis in enumerate(self.axis):
            if axis.angle.reference != "gravity":
                one = 'gravity must be the reference of all axes or of none: expected "gravity" here too'
                yield Problem(("axis", k, "angle", "reference"), one, axis.angle.reference)
            for name in sorted(axis.angle.model_fields_set - {"read_every", "reference"}):
                yield Problem(("axis", k, "angle", name), message)


class Rig(Section):
    """The rig: site, table and chamber."""

    site: Site = Site()
    """Where the rig stands."""
    table: RigTable
    """The table."""
    chamber: Chamber
    """The climatic chamber."""
    resolution: Resolution | None = None
    """Steps of the controllers; a recipe is rounded to these steps."""
