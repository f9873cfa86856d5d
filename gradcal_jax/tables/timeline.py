"""gradcal-timeline/3: all inputs from which another program can compute the covariance of a plan. SI, °C.

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

from gradcal_jax.tables import contracts as rows
from gradcal_jax.tables.section import Section

Vector3 = tuple[rows.Finite, rows.Finite, rows.Finite]
Matrix3 = tuple[Vector3, Vector3, Vector3]


class SiteRow(Section):
    """Where the rig stands."""

    latitude: rows.Finite
    """Latitude, north positive (rad)."""
    gravity: rows.Size
    """Local gravity, as used in the computation (m/s²)."""
    earth_rate: Vector3
    """Rate of the Earth: East, North and up component (rad/s)."""


class TableAxisRow(Section):
    """A table axis; the axes are listed from the outermost inwards. If it is held at rest, its encoder
    error at each standstill has the variance standstill_offset² + reading_noise²/n, with n = 1 + the number of whole
    intervals `read_every` in the standstill."""

    name: str
    """Name of the axis."""
    direction: Vector3
    """Direction of the axis if all axes are at zero, in the frame that turns with the next outer axis (for the
    outermost axis: East, North, up)."""
    reading_noise: rows.Size
    """Standard deviation of the white noise of a reading (rad)."""
    standstill_offset: rows.Size
    """Standard deviation of the error common to the readings of a standstill (rad)."""
    timing_error: rows.Size = 0.0
    """Standard deviation of the time of a reading during a move (s)."""
    read_every: rows.Size | None = None
    """Time between readings at rest (s); null: one reading in each standstill."""
    harmonics: tuple[rows.HarmonicRow, ...] = ()
    """Errors that are periodic in the angle."""


class MountingRow(Section):
    """The mounting of the body on the innermost axis."""

    name: str | None = None
    """Name of the mounting."""
    rotation: Matrix3
    """Rotation matrix from the body's frame to the innermost axis's frame."""


class TermRow(rows.MapRow):
    """One term of a channel: a function of temperature (and the channel's own rate) times the product of `signals`."""

    name: str
    """Name of the term."""
    signals: tuple[str, ...]
    """Signals that multiply the function: "rate x" (rad/s) and "force x" (m/s²) are components in the body's frame,
    "|force x|" is a magnitude; empty: the function alone. "size ik" (1/s²) is ω_i (ω + 2ω_earth)_k − δ_ik (ω +
    2ω_earth)·ω, where ω is the rate relative to the Earth."""
    parameters: tuple[str, ...]
    """Names of the coefficients in a prediction."""
    unit: str
    """SI unit of each coefficient."""
    lag: rows.Size | None = None
    """Time constant (s) of a first-order lag L of the temperature T, if the function depends on L instead of T; L = T
    at the start of the plan."""


class PathTermRow(Section):
    """A function of past temperatures times the product of `signals`, like `TermRow`. By `kind`:

    "hysteresis": the functions (high + low)/2 − T and (high − low)/(2 width) of the two extreme states of a play `P =
    max(T − width, min(T + width, P⁻))`; the states start at P = T ± width at the beginning of the temperature profile,
    soaks included. "temperature gradient": dT/dt. "transient": exp(−t/time_constant), t from the beginning of the plan.
    "temperature difference": gain·(L − T), L a first-order lag of T with the time constant, L = T at the beginning of
    the plan.
    """

    kind: Literal["hysteresis", "temperature gradient", "transient", "temperature difference"]
    """The function; see above."""
    signals: tuple[str, ...]
    """Signals that multiply the function; empty: the function alone."""
    parameters: tuple[str, ...]
    """Names of the coefficients in a prediction."""
    stds: tuple[rows.Size, ...]
    """Prior standard deviation of each coefficient."""
    unit: str
    """SI unit of the first coefficient."""
    width: rows.Size | None = None
    """Half-width of the play (K)."""
    time_constant: rows.Size | None = None
    """Time constant of the transient or of the lag (s)."""
    gain: float | None = None
    """Gain of the temperature difference (1, or 1/s)."""


class ChannelRow(Section):
    """A gyro or an accelerometer along one axis of the body. Its output is the integral of the rate (rad) or of the
    specific force (m/s)."""

    name: str
    """Name of the channel."""
    kind: Literal["gyro", "accelerometer"]
    """Kind of sensor."""
    axis: Literal["x", "y", "z"]
    """Axis of the body."""
    white: rows.Size
    """White noise: standard deviation of the integral after 1 s, growing with √time (rad/√s or m/s/√s)."""
    rate_random_walk: rows.Size = 0.0
    """Random walk of the rate or force: standard deviation after 1 s, growing with √time (rad/s/√s or m/s²/√s)."""
    drift: tuple[rows.ProcessRow, ...] = ()
    """Gauss–Markov drifts of the bias (rad/s or m/s²), stationary at the start of the first segment whose data are
    used."""
    scale_factor_instability: tuple[rows.ProcessRow, ...] = ()
    """Gauss–Markov instabilities of the scale factor; each is multiplied by the rate or force along the axis."""
    turn_on_bias: rows.Size | None = None
    """Standard deviation of the turn-on bias (rad/s or m/s²). It adds to the prior of the bias, along the coefficients
    of the function that is 1 everywhere; if no bias is estimated, it is an error of its own."""
    sample_clock_error: rows.Size | None = None
    """Standard deviation of the error of the channel's own clock, as a ratio: one random value, multiplied by the rate;
    absent: see "sample_clock"."""
    unknown_earth_rate: rows.Size | None = None
    """Standard deviation (rad/s) of one random value: the Earth's rate, if neither the site nor a bias is known."""
    temperature_error: rows.TemperatureErrorRow | None = None
    """Error of the measured temperature."""
    bias_temperature_gradient: rows.GradientSensitivityRow | None = None
    """Bias in proportion to dT/dt, estimated."""
    terms: tuple[TermRow, ...]
    """Terms that are estimated."""
    path: tuple[PathTermRow, ...] = ()
    """Estimated terms that depend on past temperatures."""


class InstallationRow(Section):
    """An error common to all channels, with a prior for each parameter. Each `kind` of angle error inserts a small
    rotation p (given here in the body's frame), which turns all that is outside of it relative to the body. "base": p =
    Rᵀ times East, North, up (tilt, tilt, azimuth); outside of it is the Earth. "orthogonality" of axes l and l + 1: p
    about e_{l+1} × e_l, carried by axis l; outside of it are the Earth and the axes up to l. "harmonics" of `axis` l: p
    = a_l (direction of axis l in the body's frame) times cosine and sine of `orders` times the angle of the axis;
    outside of it are the axes before l. While axis l turns, the row of gyro i also has a_li times the change of these
    functions. "mounting": p about the body's x, y and z, one for each mounting, while the mounting is used; everything
    is outside of it. "gravity" (m/s²): a force along up, for accelerometers. "sample_clock": an error in proportion to
    the rate itself and, if `forces` is true, to the force itself."""

    kind: Literal["base", "orthogonality", "harmonics", "mounting", "gravity", "sample_clock"]
    """The error; see above."""
    parameters: tuple[str, ...]
    """Names of the parameters in a prediction."""
    stds: tuple[rows.Size, ...]
    """Prior standard deviation of each parameter."""
    unit: str
    """SI unit of the parameters."""
    axis: str | None = None
    """Table axis that has the error; null: the error belongs to no single axis."""
    orders: tuple[int, ...] | None = None
    """For harmonics: periods in one turn."""
    forces: bool | None = None
    """For "sample_clock": whether the error also affects accelerometers."""


class SegmentRow(rows.CourseRow):
    """A rest, or the move of one axis."""

    axis: str | None = None
    """The axis that moves; null: all are at rest."""
    angles_before: tuple[rows.Finite, ...]
    """Angles of all axes at the start of the segment, outermost first (rad)."""
    angles_after: tuple[rows.Finite, ...]
    """Angles of all axes at the end of the segment (rad)."""
    attitude: Matrix3
    """Rotation matrix from the body's frame to East, North, up at the start of the segment."""
    mounting: int
    """Index of the mounting, counted from 0."""
    standstill_ids: tuple[int | None, ...]
    """For each axis, the index of its standstill; null while the axis moves."""


class ReadingRow(Section):
    """A reading: one row for each channel in `channels`, at the same time."""

    start: rows.Finite
    """Start of the rows (s): the previous reading, or the end of an unused segment, where the angle has its new
    origin."""
    time: rows.Finite
    """End of the rows (s)."""
    channels: tuple[str, ...]
    """Names of the channels."""
    standstill_ids: tuple[int | None, ...]
    """For each axis, the index of its standstill at `time`; null: the axis moves."""
    rate: rows.Finite | None = None
    """Reference rate of the table (rad/s); null: the reference is the table's angle, not its rate."""


class Timeline(Section):
    """gradcal-timeline/3: all inputs from which another program can compute the covariance of a plan.

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
    """Title of the spec."""
    estimator: Literal["best linear", "least squares"] = "best linear"
    """Generalised least squares with all priors, or unweighted mean rate errors without priors."""
    points: Literal["independent", "one run"] | None = None
    """Standard method: whether all readings share the noise processes of one run, or each has independent noise."""
    frame: Literal["table axes", "case"]
    """Reference of the misalignments: the table's axes or the case."""
    site: SiteRow
    """Where the rig stands."""
    table: tuple[TableAxisRow, ...]
    """Axes of the table, outermost first."""
    standing: Literal["held", "read"]
    """"held": an axis at rest does not turn; "read": its angle is known only from readings."""
    rate_accuracy: rows.Size = 0.0
    """Standard deviation of the reference rate, as a ratio."""
    mountings: tuple[MountingRow, ...]
    """Mountings of the IMU on the innermost axis."""
    thermal_lag: rows.Size | None = None
    """Time constant (s) of a first-order lag between the chamber's temperature and the temperature on which all terms
    depend; both are equal at the start."""
    channels: tuple[ChannelRow, ...]
    """Gyros and accelerometers."""
    installation: tuple[InstallationRow, ...]
    """Errors common to all channels."""
    segments: tuple[SegmentRow, ...]
    """Motion of the table, and temperature of the chamber."""
    readings: tuple[ReadingRow, ...]
    """Readings of the plan."""
