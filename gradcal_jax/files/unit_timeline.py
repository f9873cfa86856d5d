"""gradcal-unit-timeline/1: all that another program needs to compute a whole unit's covariance by itself. SI, °C.

Every channel has one row of each segment that lists it in `read`: its own integral over the segment, in the body, less
what is known,

    gyro            ∫ω̃_i dt − ∫(Rᵀω_earth)_i dt − Σ_l a_li Δθ̃_l          (rad)
    accelerometer   ∫f̃_i dt − ∫(Rᵀ(0, 0, g))_i dt                        (m/s)

with R the attitude and a_l the direction of axis l in the body. It holds ∫(terms' functions × their signals) dt; of the
installation, for each small rotation p (body) inserted at a stage, ∫(ω_outer × p + ṗ)_i dt or ∫(f × p)_i dt, ω_outer
being the rate of all outside that stage; of each axis's encoder, whose error e_l is one draw a standstill, the same
with p = a_l e_l (by angle between the two errors while l turns) and a_li times its change where l itself turns; and the
integrated noise. Estimated by generalised least squares with all priors.
"""

from typing import Literal

from gradcal_jax.files.contracts import Finite, HarmonicRow, MapRow, ProcessRow, Size
from gradcal_jax.files.section import Section

Vector3 = tuple[Finite, Finite, Finite]
Matrix3 = tuple[Vector3, Vector3, Vector3]


class SiteRow(Section):
    """Latitude (rad), gravity as it is used (m/s²), and the Earth's rate (East, North, up; rad/s)."""

    latitude: Finite
    gravity: Size
    earth_rate: Vector3


class TableAxisRow(Section):
    """A table axis, outermost first. `direction` while all stand at zero, in the frame that the axis outside it
    carries (the outermost: East, North, up). An encoder error at each standstill: variance standstill_offset² +
    reading_noise²/n (rad), with n = 1 + the whole number of `read_every` (s) in the standstill.
    """

    name: str
    direction: Vector3
    reading_noise: Size
    standstill_offset: Size
    read_every: Size
    harmonics: tuple[HarmonicRow, ...] = ()


class MountingRow(Section):
    """How the body hangs on the innermost axis: the rotation from body to that axis's frame."""

    name: str | None = None
    rotation: Matrix3


class UnitTermRow(MapRow):
    """One term of a channel: a function of temperature (and of the channel's own rate) times the product of `signals`.

    Signals are "rate x" (rad/s) and "force x" (m/s²), components in the body, "|force x|" a magnitude; none: 1. "size
    ik" (1/s²) is ω_i (ω + 2ω_earth)_k − δ_ik (ω + 2ω_earth)·ω, with ω the rate against the Earth.
    `parameters`: names of the coefficients in a prediction; `unit` of each, in SI.
    """

    name: str
    signals: tuple[str, ...]
    parameters: tuple[str, ...]
    unit: str


class ChannelRow(Section):
    """A gyro (rad) or accelerometer (m/s) along one axis of the body. `white`: of the integral, for √s; `rate_random_
    walk` for s√s; `drift` in rad/s or m/s², stationary at the first used segment; `scale_factor_instability` is
    multiplied by the rate along the axis.
    """

    name: str
    kind: Literal["gyro", "accelerometer"]
    axis: Literal["x", "y", "z"]
    white: Size
    rate_random_walk: Size = 0.0
    drift: tuple[ProcessRow, ...] = ()
    scale_factor_instability: tuple[ProcessRow, ...] = ()
    terms: tuple[UnitTermRow, ...]


class InstallationRow(Section):
    """An error that all channels see, with a prior for each parameter. By `kind` the rotation p inserted (body):

    "base": Rᵀ times East, North, up (tilt, tilt, azimuth); outside it turns the Earth. "orthogonality" of axes l and
    l + 1: about e_{l+1} × e_l, carried by axis l; outside it turn the Earth and the axes up to l. "harmonics" of `axis`
    l: a_l times cosine and sine of `orders` times its angle; outside, the axes before l; besides, a_li times their
    change where l turns. "mounting": the body's x, y, z, of each mounting while it is used; outside, everything.
    "gravity" (m/s²): along up, for accelerometers. "sample_clock": the rate and the force themselves.
    """

    kind: Literal["base", "orthogonality", "harmonics", "mounting", "gravity", "sample_clock"]
    parameters: tuple[str, ...]
    stds: tuple[Size, ...]
    unit: str
    axis: str | None = None
    orders: tuple[int, ...] | None = None


class UnitSegmentRow(Section):
    """A rest, or the move of one axis, from `start` for `duration` (s).

    `axis`: which moves; null: all stand. `shape` and its figures are those of gradcal-timeline/2. `angles_before`,
    `angles_after` (rad) of all axes, outermost first; `attitude` as it begins, from body to East, North, up.
    `standstill_ids` number each axis's standstills; null while it moves. `read`: channels that have a row of it.
    `mounting` counts from 0. Temperatures (°C) are the chamber's, linear or through `temperature_bends` (time s, °C).
    `used`: false where the data are not part of the calibration.
    """

    start: Finite
    duration: Size
    axis: str | None = None
    shape: str
    peak_rate: Finite = 0.0
    angle: Finite = 0.0
    ramp: Size | None = None
    cycles: int | None = None
    controls: tuple[Finite, ...] | None = None
    unevenness: Size | None = None
    angles_before: tuple[Finite, ...]
    angles_after: tuple[Finite, ...]
    attitude: Matrix3
    mounting: int
    standstill_ids: tuple[int | None, ...]
    read: tuple[str, ...]
    used: bool = True
    temperature_start: Finite
    temperature_end: Finite
    temperature_bends: tuple[tuple[Finite, Finite], ...] | None = None


class UnitTimeline(Section):
    """gradcal-unit-timeline/1. `standing`: "held", as said at the head; "read": every segment ends with a reading of
    all axes, whose error is its standstill's draw of `standstill_offset` and a draw of `reading_noise`, and a rest from
    reading to reading is a segment; a gyro's row has each axis's mean direction times its error's change, and what
    stands turns the attitude by the mean of the errors at both ends. `thermal_lag` (s) is first order, between the
    chamber and what all terms see, in equilibrium at the start of the first segment. Processes go on through segments
    that are not used.
    """

    format: Literal["gradcal-unit-timeline/1"] = "gradcal-unit-timeline/1"
    title: str | None = None
    frame: Literal["table axes", "case"]
    site: SiteRow
    table: tuple[TableAxisRow, ...]
    standing: Literal["held", "read"]
    mountings: tuple[MountingRow, ...]
    thermal_lag: Size | None = None
    channels: tuple[ChannelRow, ...]
    installation: tuple[InstallationRow, ...]
    segments: tuple[UnitSegmentRow, ...]
