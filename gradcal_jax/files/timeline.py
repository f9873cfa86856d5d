"""gradcal-timeline/3: all inputs for another program to compute the covariance of a plan. SI, °C.

Every channel has one row of each reading that lists it: its own integral since the reading's `start`, in the body, less
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

from gradcal_jax.files import contracts as rows
from gradcal_jax.files.section import Section

Vector3 = tuple[rows.Finite, rows.Finite, rows.Finite]
Matrix3 = tuple[Vector3, Vector3, Vector3]


class SiteRow(Section):
    """Where the rig stands."""

    latitude: rows.Finite
    """North positive (rad)."""
    gravity: rows.Size
    """As it is used (m/s²)."""
    earth_rate: Vector3
    """East, North, up (rad/s)."""


class TableAxisRow(Section):
    """A table axis, outermost first. Where it is held, its encoder error at each standstill has the variance
    standstill_offset² + reading_noise²/n, with n = 1 + the whole number of `read_every` in the standstill."""

    name: str
    """Of the axis."""
    direction: Vector3
    """With all axes at zero, in the frame that the next outer axis carries (outermost: East, North, up)."""
    reading_noise: rows.Size
    """Standard deviation of a reading (rad)."""
    standstill_offset: rows.Size
    """Standard deviation of the error common to the readings of a standstill (rad)."""
    timing_error: rows.Size = 0.0
    """Standard deviation of the time of a reading on the move (s)."""
    read_every: rows.Size | None = None
    """Spacing of readings (s); absent: one reading in each standstill."""
    harmonics: tuple[rows.HarmonicRow, ...] = ()
    """Errors that are periodic in the angle."""


class MountingRow(Section):
    """The mounting of the body on the innermost axis."""

    name: str | None = None
    """Of the mounting."""
    rotation: Matrix3
    """Matrix from the body to the innermost axis's frame."""


class TermRow(rows.MapRow):
    """One term of a channel: a function of temperature (and the channel's own rate) times the product of `signals`."""

    name: str
    """Of the term."""
    signals: tuple[str, ...]
    """"rate x" (rad/s) and "force x" (m/s²) in the body, "|force x|" a magnitude; none: 1. "size ik" (1/s²) is
    ω_i (ω + 2ω_earth)_k − δ_ik (ω + 2ω_earth)·ω, ω the rate against the Earth."""
    parameters: tuple[str, ...]
    """Names of the coefficients in a prediction."""
    unit: str
    """Of each coefficient, in SI."""
    lag: rows.Size | None = None
    """Time constant (s) of a first-order lag of the temperature, which replaces it in the function; L = T at the
    beginning of the plan."""


class PathTermRow(Section):
    """A function of the path of temperature times the product of `signals`, as of `TermRow`. By `kind`:

    "hysteresis": of the two extreme states of a play, `P = max(T − width, min(T + width, P⁻))` from P = T ± width at
    the beginning of the temperature profile, soaks included: the functions (high + low)/2 − T and
    (high − low)/(2 width). "temperature gradient": dT/dt. "transient": exp(−t/time_constant), t from the beginning of
    the plan. "temperature difference": gain·(L − T), L a first-order lag of T with the time constant, L = T at the
    beginning of the plan.
    """

    kind: Literal["hysteresis", "temperature gradient", "transient", "temperature difference"]
    """Which function."""
    signals: tuple[str, ...]
    """Its factors; none: 1."""
    parameters: tuple[str, ...]
    """Names of the coefficients in a prediction."""
    stds: tuple[rows.Size, ...]
    """Prior standard deviation of each."""
    unit: str
    """Of the first coefficient, in SI."""
    width: rows.Size | None = None
    """Half-width of the play (K)."""
    time_constant: rows.Size | None = None
    """Of the transient, or of the lag (s)."""
    gain: float | None = None
    """Of the temperature difference (1, or 1/s)."""


class ChannelRow(Section):
    """A gyro (rad) or accelerometer (m/s) along one axis of the body."""

    name: str
    """Of the channel."""
    kind: Literal["gyro", "accelerometer"]
    """Gyro or accelerometer."""
    axis: Literal["x", "y", "z"]
    """Axis of the body."""
    white: rows.Size
    """White noise of the integral, for √s (rad or m/s)."""
    rate_random_walk: rows.Size = 0.0
    """For s√s (rad or m/s)."""
    drift: tuple[rows.ProcessRow, ...] = ()
    """In rad/s or m/s², stationary at the first used segment."""
    scale_factor_instability: tuple[rows.ProcessRow, ...] = ()
    """Multiplied by the rate, or the force, along the axis."""
    turn_on_bias: rows.Size | None = None
    """Of a run (rad/s or m/s²): adds to the prior of the bias's constant (the coefficients of the function that is 1
    everywhere, all together), or acts alone where no bias is estimated."""
    sample_clock_error: rows.Size | None = None
    """Of a clock of its own, as a ratio: one draw, multiplied by the rate; absent: see "sample_clock"."""
    unknown_earth_rate: rows.Size | None = None
    """One draw (rad/s): the Earth's rate, where neither the site nor a bias is known."""
    temperature_error: rows.TemperatureErrorRow | None = None
    """Error of the measured temperature."""
    bias_temperature_gradient: rows.GradientSensitivityRow | None = None
    """Bias in proportion to dT/dt, estimated."""
    terms: tuple[TermRow, ...]
    """What is estimated."""
    path: tuple[PathTermRow, ...] = ()
    """What is estimated of the path of temperature."""


class InstallationRow(Section):
    """An error common to all channels, with a prior for each parameter. `kind` gives the inserted rotation p (in the
    body frame) and the part outside of it, which p turns relative to the body.

    "base": p = Rᵀ times East, North, up (tilt, tilt, azimuth); outside: the Earth. "orthogonality" of axes l and l + 1:
    p about e_{l+1} × e_l, carried by axis l; outside: the Earth and the axes up to l. "harmonics" of `axis` l: p = a_l
    times cosine and sine of `orders` times its angle; outside: the axes before l; in addition, a_li times their change
    while l turns. "mounting": p about the body's x, y, z, for each mounting while it is used; outside: everything.
    "gravity" (m/s²): a force along up, for accelerometers. "sample_clock": the rate itself and, with `forces`, the
    force itself.
    """

    kind: Literal["base", "orthogonality", "harmonics", "mounting", "gravity", "sample_clock"]
    """Which error."""
    parameters: tuple[str, ...]
    """Names of the parameters in a prediction."""
    stds: tuple[rows.Size, ...]
    """Prior standard deviation of each."""
    unit: str
    """Of the parameters, in SI."""
    axis: str | None = None
    """Table axis; null where it concerns none."""
    orders: tuple[int, ...] | None = None
    """Periods in one turn, of harmonics."""
    forces: bool | None = None
    """Of "sample_clock": whether it also affects accelerometers."""


class SegmentRow(rows.CourseRow):
    """A rest, or the move of one axis."""

    axis: str | None = None
    """The axis that moves; null: all are at rest."""
    angles_before: tuple[rows.Finite, ...]
    """Angles of all axes at its beginning, outermost first (rad)."""
    angles_after: tuple[rows.Finite, ...]
    """Angles of all axes at its end (rad)."""
    attitude: Matrix3
    """Matrix from the body to East, North, up at its beginning."""
    mounting: int
    """The mounting, counted from 0."""
    standstill_ids: tuple[int | None, ...]
    """Number of each axis's standstill; null while it moves."""


class ReadingRow(Section):
    """The rows of one time, of the channels that have one."""

    start: rows.Finite
    """Where they begin (s): the reading before, or the end of a segment that is not used, whose reading is the new
    origin of the angle."""
    time: rows.Finite
    """Where they end (s)."""
    channels: tuple[str, ...]
    """Names of the channels."""
    standstill_ids: tuple[int | None, ...]
    """Number of each axis's standstill at `time`; null: it moves."""
    rate: rows.Finite | None = None
    """Reference rate (rad/s), where it is the reference."""


class Timeline(Section):
    """gradcal-timeline/3: all inputs for another program to compute the covariance of a plan.

    With `standing` "held" every rest and every move is a reading, and a held axis does not turn. With "read" the error
    of a reading is its standstill's draw of `standstill_offset` and a draw of `reading_noise` or, on the move, a draw
    of `reading_noise` and the rate times a draw of `timing_error`; a gyro's row has each axis's mean direction times
    its error's change, and what stands turns the attitude by the mean of the errors at both ends. A reading with a
    `rate` has one error for all of its time, `rate_accuracy` times the rate. Processes begin with the first used
    segment (drifts and instabilities stationary, a random walk at zero, the rest with one draw), and go on through
    segments that are not used.
    """

    format: Literal["gradcal-timeline/3"] = "gradcal-timeline/3"
    """Name and version of this contract."""
    title: str | None = None
    """Of the spec."""
    estimator: Literal["best linear", "least squares"] = "best linear"
    """Generalised least squares with all priors, or unweighted mean rate errors without priors."""
    points: Literal["independent", "one run"] | None = None
    """Standard method: whether readings share the processes over the run, or have independent noise."""
    frame: Literal["table axes", "case"]
    """The reference of the misalignments."""
    site: SiteRow
    """Where the rig stands."""
    table: tuple[TableAxisRow, ...]
    """Axes of the table, outermost first."""
    standing: Literal["held", "read"]
    """The model of axes at rest: see above."""
    rate_accuracy: rows.Size = 0.0
    """Of a held rate, as a ratio."""
    mountings: tuple[MountingRow, ...]
    """The mounting of the IMU on the innermost axis."""
    thermal_lag: rows.Size | None = None
    """Time constant (s), first order, between the chamber and what all terms see; equilibrium at the start."""
    channels: tuple[ChannelRow, ...]
    """Gyros and accelerometers."""
    installation: tuple[InstallationRow, ...]
    """Errors that all channels see."""
    segments: tuple[SegmentRow, ...]
    """Motion of the table, and temperature of the chamber."""
    readings: tuple[ReadingRow, ...]
    """Which rows there are."""
