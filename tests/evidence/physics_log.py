"""A simulator of logs written from physics: what a table, the Earth, a chamber and a chain of electronics make of a
sensor. It shares no code, column or belief with the program: of `gradcal_jax` it takes the log's file alone.

Attitude is a product of finite rotations: base, an axis, what the axes lack of a right angle, the next axis. Angular
rate is what turns one attitude into the next within a fraction of a sample; gravity and the Earth's rate are vectors
fixed in East-North-Up that the attitude carries into the body. What a gyro says is the mean over a sample of
(1 + M(T, ω))·ω + B(T) + … along its own input axis, at the temperature of its own die; clock, filter, quantisation and
saturation come after that. SI inside; degrees, ppm and deg/h where a scene is written down.
"""

from collections.abc import Callable, Sequence
from dataclasses import dataclass, field, replace

import numpy as np
from scipy.signal import lfilter
from scipy.spatial.transform import Rotation

from gradcal_jax.records.log import Log

DEG = np.pi / 180.0
DEG_H = DEG / 3600.0
PPM = 1e-6
EARTH = 7.292115e-5
G = 9.80665

Floats = np.ndarray
Law = Callable[[Floats], Floats]
Surface = Callable[[Floats, Floats], Floats]


@dataclass(frozen=True)
class Move:
    """A rest of `duration` s; or a turn of one axis by `angle` (deg, signed): a constant `rate` (deg/s) between two
    ramps of `ramp` s each, of a half cosine."""

    duration: float = 0.0
    angle: float = 0.0
    rate: float = 1.0
    ramp: float = 0.0
    axis: int = 0

    @property
    def lasts(self) -> float:
        return abs(self.angle) / self.rate + self.ramp if self.angle else self.duration

    def after(self, t: Floats) -> Floats:
        """Angle turned (deg) at times since its begin."""
        t = np.clip(t, 0.0, self.lasts)
        back = t > 0.5 * self.lasts
        x = np.where(back, self.lasts - t, t)
        y = np.clip(x, 0.0, self.ramp)
        ramped = 0.5 * self.rate * (y - self.ramp / np.pi * np.sin(np.pi * y / self.ramp))
        part = ramped + self.rate * (x - y)
        return np.sign(self.angle) * np.where(back, abs(self.angle) - part, part)


@dataclass(frozen=True)
class Motion:
    """Commanded angles of the axes at any time: cycles of moves for as long as whole ones fit, then rest."""

    moves: Sequence[Move]
    end: float
    axes: int

    def at(self, t: Floats) -> tuple[Floats, Floats]:
        """Angles `(n, axes)` rad, and the number of the standstill, −1 on the move."""
        whole = int(self.end / sum(move.lasts for move in self.moves) + 1e-9)
        moves = [*list(self.moves) * whole, Move(1e9)]
        edges = np.cumsum([0.0, *(move.lasts for move in moves)])
        rows = np.searchsorted(t, edges)
        angles, stands = np.zeros((len(t), self.axes)), np.zeros(len(t), np.int64)
        here, number = np.zeros(self.axes), 0
        for k, move in enumerate(moves):
            part = slice(rows[k], rows[k + 1])
            angles[part], stands[part] = here, number
            if move.angle:
                angles[part, move.axis] += move.after(t[part] - edges[k])
                here[move.axis] += move.angle
                stands[part] = -1
                number += 1
        return angles * DEG, stands


# --- the bench --------------------------------------------------------------------------------------------------------


@dataclass(frozen=True)
class Encoder:
    """What an axis's encoder says beside the angle. Standard deviations and amplitudes in degrees; `slip`: from when
    (s), by how much; `step`: resolution; `backlash`: by how much what is shown after turns to and fro differs."""

    noise: float = 0.0
    offset: float = 0.0
    scale: float = 0.0
    waves: dict[int, tuple[float, float]] = field(default_factory=dict[int, tuple[float, float]])
    slip: tuple[float, float] = (0.0, 0.0)
    step: float = 0.0
    backlash: float = 0.0

    def reads(self, t: Floats, angle: Floats, stands: Floats, rng: np.random.Generator) -> Floats:
        said = angle * (1.0 + self.scale)
        for order, (cosine, sine) in self.waves.items():
            said = said + DEG * (cosine * np.cos(order * angle) + sine * np.sin(order * angle))
        way = np.sign(np.diff(angle, prepend=angle[:1]))
        last = np.maximum.accumulate(np.where(way != 0.0, np.arange(len(way)), 0))
        said = said + 0.5 * DEG * self.backlash * way[last]
        draws = self.offset * rng.standard_normal(int(stands.max()) + 2)
        said = said + DEG * np.where(stands >= 0, draws[stands], 0.0) + DEG * self.noise * rng.standard_normal(len(t))
        said = said + DEG * self.slip[1] * (t > self.slip[0])
        return in_steps(said, self.step * DEG)


@dataclass
class Axis:
    """An axis of the table: its direction while all stand at zero (East, North, up), and its faults.

    `skew`: rad, by which the angle to the next axis inside differs from the nominal one. `wobble`: rad; the axis draws
    a cone of this half angle, twice a turn: once a turn it would be a stage mounted askew, and no wobble.
    """

    direction: Sequence[float]
    encoder: Encoder
    skew: float = 0.0
    wobble: float = 0.0

    def turned(self, angle: Floats) -> Rotation:
        d = np.array(self.direction, float)
        own = Rotation.from_rotvec(angle[:, None] * d)
        if not self.wobble:
            return own
        across = np.cross(d, [0.6, 0.64, -0.48])
        across /= np.linalg.norm(across)
        phase = 2.0 * angle[:, None]
        return Rotation.from_rotvec(self.wobble * (np.cos(phase) * across + np.sin(phase) * np.cross(d, across))) * own


@dataclass
class Bench:
    """`base`: rotation vector of the table's base in East-North-Up, rad; `lever`: where the unit sits on the innermost
    stage, from the axes' intersection, m."""

    axes: Sequence[Axis]
    latitude: float = 48.0
    gravity: float = G
    base: Sequence[float] = (0.0, 0.0, 0.0)
    lever: Sequence[float] = (0.0, 0.0, 0.0)

    def attitude(self, angles: Floats) -> Rotation:
        """Of the innermost stage."""
        q = Rotation.from_rotvec(self.base)
        for k, axis in enumerate(self.axes):
            q = q * axis.turned(angles[:, k])
            if axis.skew:
                q = q * Rotation.from_rotvec(axis.skew * np.cross(self.axes[k + 1].direction, axis.direction))
        return q

    def felt(self, angles: Floats, step: float) -> tuple[Floats, Floats]:
        """Angular rate and specific force in the body between angles that are `step` s apart, `(n − 1, 3)`."""
        attitude = self.attitude(angles)
        turn = (attitude[:-1].inv() * attitude[1:]).as_rotvec()
        middle = attitude[:-1] * Rotation.from_rotvec(0.5 * turn)
        phi = self.latitude * DEG
        rate = turn / step + middle.apply(EARTH * np.array([0.0, np.cos(phi), np.sin(phi)]), inverse=True)
        force = middle.apply([0.0, 0.0, self.gravity], inverse=True)
        if any(self.lever):
            arm = np.array(self.lever, float)
            force = force + np.cross(rate, np.cross(rate, arm)) + np.cross(np.gradient(rate, step, axis=0), arm)
        return rate, force


@dataclass(frozen=True)
class Climate:
    """Air of a chamber over time, die and thermometer: `corners` are (s, °C); lags of first order, s; offsets, K.

    `thermometer_to_die`: the die follows the thermometer, which sits outside of it; `self_heating`: the die is so much
    warmer than its thermometer; `offset`: the thermometer shows so much more than the temperature where it sits;
    `frozen`: between these times it shows what it showed before.
    """

    corners: Sequence[tuple[float, float]]
    air_to_die: float = 0.0
    thermometer_to_die: float = 0.0
    self_heating: float = 0.0
    offset: float = 0.0
    noise: float = 0.01
    step: float = 0.0
    frozen: tuple[float, float] | None = None

    def at(self, t: Floats) -> tuple[Floats, Floats]:
        """Die, and what the thermometer's place is at, °C."""
        times, course = zip(*self.corners, strict=True)
        place = follow(np.interp(t, times, course), t, self.air_to_die)
        return follow(place, t, self.thermometer_to_die) + self.self_heating, place

    def shows(self, t: Floats, place: Floats, rng: np.random.Generator) -> Floats:
        said = in_steps(place + self.offset + self.noise * rng.standard_normal(len(t)), self.step)
        return said if self.frozen is None else held(said, t, *self.frozen)


def held(values: Floats, t: Floats, begin: float, end: float) -> Floats:
    """The value before `begin` again, until `end`."""
    inside = np.flatnonzero((t > begin) & (t < end))
    values[inside] = values[inside[0] - 1]
    return values


def in_steps(values: Floats, step: float) -> Floats:
    return np.round(values / step) * step if step else values


def follow(course: Floats, t: Floats, lag: float) -> Floats:
    """A first-order lag behind a course that is straight between its samples; it begins at rest."""
    if not lag:
        return course
    step = t[1] - t[0]
    keep = np.exp(-step / lag)
    mean = 1.0 - (1.0 - keep) * lag / step
    drive = np.empty_like(course)
    drive[0] = course[0]
    drive[1:] = (1.0 - keep - mean) * course[:-1] + mean * course[1:]
    return lfilter([1.0], [1.0, -keep], drive)


# --- sensors ----------------------------------------------------------------------------------------------------------


@dataclass(frozen=True)
class Channel:
    """A gyro or an accelerometer, SI: what it says of `along`, its input axis (a unit vector of the body).

    `scale(T, input)`, `bias(T)`; `force`: answer of a gyro to the specific force (3); `square`: of an accelerometer to
    the square of its input; `gradient`: rad/K, times dT/dt of the die; `hysteresis(t, T)`: added to the bias; `white`:
    per √Hz (one-sided √(1/Hz)); `drift`: Gauss–Markov, standard deviation and correlation time; `walk`: of the bias,
    per √s; `vibration`: of the rate while the table turns, rms; `rectified`: what the sensor makes of it.
    """

    along: Sequence[float]
    bias: Law
    scale: Surface
    force: Sequence[float] = (0.0, 0.0, 0.0)
    square: float = 0.0
    gradient: float = 0.0
    hysteresis: Surface | None = None
    white: float = 0.0
    drift: Sequence[tuple[float, float]] = ()
    walk: float = 0.0
    scale_drift: Sequence[tuple[float, float]] = ()
    turn_on: float = 0.0
    vibration: float = 0.0
    rectified: float = 0.0
    kind: str = "gyro"

    def says(self, t: Floats, die: Floats, rate: Floats, force: Floats, own: Floats) -> Floats:
        felt = (rate if self.kind == "gyro" else force) @ np.array(self.along, float)
        said = felt * (1.0 + self.scale(die, felt) + own) + self.bias(die) + self.turn_on
        said = said + force @ np.array(self.force, float) + self.square * felt**2
        if self.gradient:
            said = said + self.gradient * np.gradient(die, t)
        return said if self.hysteresis is None else said + self.hysteresis(t, die)


@dataclass(frozen=True)
class Chain:
    """From what a sensor feels to the rows of a log.

    `clock`: the sensor's seconds are so much too many (a ratio), its stamps run fast; `host`: scatter of the computer's
    stamps (s), where the log has them; `low_pass`: corner of a first-order filter, Hz; `delay`: the samples are of so
    long ago, s; `step`, `limit`: by kind of channel; `lost`: share of rows that never arrive; `late`: share of stamps,
    and by how much (s); `spikes`: share of gyro samples, and their size, rad/s; `frozen`: between these times these
    channels repeat their last sample.
    """

    hz: float = 50.0
    clock: float = 0.0
    host: float | None = None
    low_pass: float = 0.0
    delay: float = 0.0
    step: dict[str, float] = field(default_factory=dict[str, float])
    limit: dict[str, float] = field(default_factory=dict[str, float])
    lost: float = 0.0
    late: tuple[float, float] = (0.0, 0.0)
    spikes: tuple[float, float] = (0.0, 0.0)
    frozen: tuple[float, float, tuple[int, ...]] | None = None


@dataclass(frozen=True)
class Recorded:
    """Rows as they leave the chain: SI, °C; `values` [row, channel]."""

    time: Floats
    values: Floats
    temperature: Floats
    angles: Floats
    stands: Floats
    host: Floats | None = None

    def rows(self, kept: Floats | slice) -> "Recorded":
        """Some of them."""
        host = None if self.host is None else self.host[kept]
        columns = (self.time, self.values, self.temperature, self.angles, self.stands)
        return Recorded(*(column[kept] for column in columns), host)


FINE = 4  # Parts of a sample in which all is as in its middle.


def record(
    bench: Bench, channels: Sequence[Channel], motion: Motion, climate: Climate, chain: Chain, seed: int
) -> Recorded:
    """What is recorded of a run. Each effect draws from a generator of its own, so that scenes differ by their fault
    alone."""
    draw = lambda number: np.random.default_rng([seed, number])  # noqa: E731
    count, h = round(motion.end * chain.hz), 1.0 / chain.hz
    edges = np.arange(count * FINE + 1) * (h / FINE)
    angles, _ = motion.at(np.maximum(edges - chain.delay, 0.0))
    rate, force = bench.felt(angles, h / FINE)
    die_at, place = climate.at(edges)
    within, die = 0.5 * (edges[1:] + edges[:-1]), 0.5 * (die_at[1:] + die_at[:-1])
    moving = np.any(angles[1:] != angles[:-1], axis=1)
    values = np.empty((count, len(channels)))
    for k, channel in enumerate(channels):
        rng = draw(100 + k)
        own = np.repeat(_drifts(channel.scale_drift, h, count, rng), FINE)
        said = channel.says(within, die, rate, force, own)
        if channel.vibration:
            shake = np.sqrt(2.0) * np.sin(2.0 * np.pi * 17.3 * within + k) + draw(50 + k).standard_normal(len(within))
            said = said + moving * (channel.vibration * shake + channel.rectified)
        if chain.low_pass:
            keep = np.exp(-2.0 * np.pi * chain.low_pass * h / FINE)
            said, _ = lfilter([1.0 - keep], [1.0, -keep], said, zi=[keep * said[0]])
        mean = said.reshape(count, FINE).mean(axis=1)
        mean += channel.white / np.sqrt(h) * rng.standard_normal(count)
        mean += _drifts(channel.drift, h, count, rng)
        mean += channel.walk * np.sqrt(h) * np.cumsum(rng.standard_normal(count))
        values[:, k] = mean
    true = edges[FINE::FINE]
    here, stands = motion.at(true)
    read = [axis.encoder.reads(true, here[:, k], stands, draw(20 + k)) for k, axis in enumerate(bench.axes)]
    shown = climate.shows(true, place[FINE::FINE], draw(1))
    return _through(Recorded(true, values, shown, np.column_stack(read), stands), channels, chain, draw)


def _through(
    found: Recorded, channels: Sequence[Channel], chain: Chain, draw: Callable[[int], np.random.Generator]
) -> Recorded:
    """The electronics after the samples."""
    true, values = found.time, found.values
    for k, channel in enumerate(channels):
        if channel.kind == "gyro" and chain.spikes[0]:
            rng = draw(60 + k)
            hit = rng.random(len(true)) < chain.spikes[0]
            values[hit, k] += chain.spikes[1] * rng.choice([-1.0, 1.0], int(hit.sum()))
        if limit := chain.limit.get(channel.kind):
            values[:, k] = np.clip(values[:, k], -limit, limit)
        values[:, k] = in_steps(values[:, k], chain.step.get(channel.kind, 0.0))
    if chain.frozen is not None:
        begin, end, which = chain.frozen
        for k in which:
            values[:, k] = held(values[:, k], true, begin, end)
    count = np.arange(len(true))
    behind = np.where(draw(2).random(len(true)) < chain.late[0], chain.late[1], 0.0)
    # A stamp that would come after the next one is the next one's less a little.
    stamps = np.minimum.accumulate((true * (1.0 + chain.clock) + behind - 1e-6 * count)[::-1])[::-1] + 1e-6 * count
    host = None
    if chain.host is not None:
        host = np.maximum.accumulate(true + chain.host * np.abs(draw(3).standard_normal(len(true)))) + 1e-7 * count
    kept = draw(4).random(len(true)) >= chain.lost
    kept[0] = True
    return replace(found, time=stamps, host=host).rows(kept)


def _drifts(processes: Sequence[tuple[float, float]], h: float, count: int, rng: np.random.Generator) -> Floats:
    total = np.zeros(count)
    for sigma, tau in processes:
        keep = np.exp(-h / tau)
        kicks = sigma * np.sqrt(1.0 - keep**2) * rng.standard_normal(count)
        kicks[0] = sigma * rng.standard_normal()
        total += lfilter([1.0], [1.0, -keep], kicks)
    return total


# --- laws of hysteresis -----------------------------------------------------------------------------------------------


def play(width: float, size: float) -> Surface:
    """Backlash: the bias keeps the sign of the last change of temperature once that exceeds `width` K; ± `size`.

    What is added is zero on average of both directions."""

    def law(t: Floats, die: Floats) -> Floats:
        """Prandtl's element: a point that is dragged within ± half of the width."""
        every = max(1, len(t) // 20_000)
        course = die[::every]
        at = course[0] - 0.5 * width * np.sign(course[len(course) // 8] - course[0])
        dragged = np.empty_like(course)
        for k, here in enumerate(course):
            at = min(max(at, here - 0.5 * width), here + 0.5 * width)
            dragged[k] = here - at
        return size * np.interp(t, t[::every], dragged) / (0.5 * width)

    return law


def creep(tau: float, per_kelvin: float) -> Surface:
    """Visco-elastic: proportional to how far the die is ahead of its own mean over the last `tau` s."""
    return lambda t, die: per_kelvin * (die - follow(die, t, tau))


# --- the file ---------------------------------------------------------------------------------------------------------


def log_of(found: Recorded, channels: Sequence[Channel], table_axes: Sequence[str]) -> Log:
    """The rows as the program's log; gyros and accelerometers are called x, y, z in their order."""
    gyros = [k for k, channel in enumerate(channels) if channel.kind == "gyro"]
    forces = [k for k, channel in enumerate(channels) if channel.kind != "gyro"]
    return Log(
        time_s=found.time,
        rate_rad_per_s=found.values[None, :, gyros],
        units=("physics",),
        axes=tuple("xyz"[: len(gyros)]),
        temperature_c=found.temperature[None],
        table_axes=tuple(table_axes),
        table_angle_rad=found.angles,
        standstill=found.stands,
        stretch_starts=np.array([0]),
        host_time_s=found.host,
        simulated=True,
        specific_force_m_per_s2=found.values[None, :, forces] if forces else None,
        force_axes=tuple("xyz"[: len(forces)]),
    )
