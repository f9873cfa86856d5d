"""A simulator of logs written from physics: what a table, the Earth, a chamber and a chain of electronics make of a
sensor. It shares no code, column or belief with the program: of `gradcal_jax` it takes the log's file alone.

Attitude is a product of finite rotations (quaternions): base, an axis, what the axes lack of a right angle, the next
axis, mounting. Angular rate is what turns one attitude into the next within a fraction of a sample; gravity and the
Earth's rate are vectors fixed in East-North-Up that the attitude carries into the body. What a gyro says is the mean
over a sample of (1 + M(T, ω))·ω + B(T) + … along its own input axis, at the temperature of its own die; clock, filter,
quantisation and saturation come after that. SI inside; degrees, ppm and deg/h where a scene is written down.
"""

from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from typing import Any

import numpy as np
from scipy.signal import lfilter

from gradcal_jax.records.log import Log

DEG = np.pi / 180.0
DEG_H = DEG / 3600.0
PPM = 1e-6
EARTH = 7.292115e-5
G = 9.80665

Floats = np.ndarray
Law = Callable[[Floats], Floats]

# --- rotations --------------------------------------------------------------------------------------------------------


def rotation(vector: Floats) -> Floats:
    """Quaternions `(…, 4)`, scalar first, of rotation vectors `(…, 3)`."""
    size = np.linalg.norm(vector, axis=-1, keepdims=True)
    half = 0.5 * size
    return np.concatenate([np.cos(half), 0.5 * np.sinc(half / np.pi) * vector], axis=-1)


def product(p: Floats, q: Floats) -> Floats:
    """First `q`, then `p`, for vectors carried outwards."""
    a, b, c, d = (p[..., i] for i in range(4))
    e, f, g, h = (q[..., i] for i in range(4))
    return np.stack(
        [
            a * e - b * f - c * g - d * h,
            a * f + b * e + c * h - d * g,
            a * g - b * h + c * e + d * f,
            a * h + b * g - c * f + d * e,
        ],
        axis=-1,
    )


def inwards(q: Floats, vector: Floats) -> Floats:
    """Components in the body of a vector that is fixed outside."""
    u = -q[..., 1:]
    t = 2.0 * np.cross(u, vector)
    return vector + q[..., :1] * t + np.cross(u, t)


def turned_by(before: Floats, after: Floats) -> Floats:
    """Rotation vectors, in the body, from one attitude to the next."""
    step = product(before * np.array([1.0, -1.0, -1.0, -1.0]), after)
    size = np.linalg.norm(step[:, 1:], axis=1, keepdims=True)
    angle = 2.0 * np.arctan2(size, step[:, :1])
    angle = np.where(angle > np.pi, angle - 2.0 * np.pi, angle)
    return np.where(size > 0.0, angle / np.where(size > 0.0, size, 1.0), 2.0) * step[:, 1:]


# --- motion -----------------------------------------------------------------------------------------------------------


@dataclass(frozen=True)
class Rest:
    duration: float


@dataclass(frozen=True)
class Turn:
    """Of one axis, by `angle` (deg, signed): a constant `rate` (deg/s) between two ramps of `ramp` s each, of a half
    cosine or straight."""

    angle: float
    rate: float
    ramp: float
    axis: int = 0
    straight: bool = False

    @property
    def duration(self) -> float:
        return abs(self.angle) / self.rate + self.ramp

    def after(self, t: Floats) -> Floats:
        """Angle turned (deg) at times since its begin."""
        t = np.clip(t, 0.0, self.duration)
        back = t > 0.5 * self.duration
        x = np.where(back, self.duration - t, t)
        y = np.clip(x, 0.0, self.ramp)
        if self.straight:
            ramped = 0.5 * self.rate * y**2 / self.ramp
        else:
            ramped = 0.5 * self.rate * (y - self.ramp / np.pi * np.sin(np.pi * y / self.ramp))
        part = ramped + self.rate * (x - y)
        return np.sign(self.angle) * np.where(back, abs(self.angle) - part, part)


def quick(angle: float, axis: int, rate: float, acceleration: float) -> Turn:
    """As fast as an axis goes, with half-cosine ramps."""
    ramp = 0.5 * np.pi * rate / acceleration
    if rate * ramp > abs(angle):
        rate = float(np.sqrt(2.0 * abs(angle) * acceleration / np.pi))
        ramp = abs(angle) / rate
    return Turn(angle, rate, float(ramp), axis)


Moves = Sequence[Rest | Turn]


def lasts(moves: Moves) -> float:
    return float(sum(move.duration for move in moves))


@dataclass(frozen=True)
class Motion:
    """Commanded angles of the axes at any time: cycles of moves for as long as whole ones fit, then rest."""

    moves: Moves
    end: float
    axes: int = 1

    def at(self, t: Floats) -> tuple[Floats, Floats]:
        """Angles `(n, axes)` rad, and the number of the standstill, −1 on the move."""
        whole = int(self.end / lasts(self.moves) + 1e-9)
        moves = [*list(self.moves) * whole, Rest(1e9)]
        edges = np.concatenate([[0.0], np.cumsum([m.duration for m in moves])])
        rows = np.searchsorted(t, edges)
        angles, stands = np.zeros((len(t), self.axes)), np.zeros(len(t), np.int64)
        here, number = np.zeros(self.axes), 0
        for k, move in enumerate(moves):
            part = slice(rows[k], rows[k + 1])
            angles[part] = here
            if isinstance(move, Turn):
                angles[part, move.axis] += move.after(t[part] - edges[k])
                here[move.axis] += move.angle
                stands[part], number = -1, number + 1
            else:
                stands[part] = number
        return angles * DEG, stands


# --- the bench --------------------------------------------------------------------------------------------------------


@dataclass
class Encoder:
    """What an axis's encoder says beside the angle. Standard deviations and amplitudes in degrees."""

    noise: float = 0.0
    offset: float = 0.0
    scale: float = 0.0
    waves: dict[int, tuple[float, float]] = field(default_factory=dict[int, tuple[float, float]])
    slip: tuple[float, float] | None = None
    """From when (s), by how much (deg)."""
    step: float = 0.0
    """Resolution, deg."""
    backlash: float = 0.0
    """By how much (deg) what is shown after turns to and fro differs."""

    def reads(self, t: Floats, angle: Floats, stands: Floats, rng: np.random.Generator) -> Floats:
        said = angle * (1.0 + self.scale)
        for order, (cosine, sine) in self.waves.items():
            said = said + DEG * (cosine * np.cos(order * angle) + sine * np.sin(order * angle))
        way = np.sign(np.diff(angle, prepend=angle[:1]))
        last = np.maximum.accumulate(np.where(way != 0.0, np.arange(len(way)), 0))
        said = said + 0.5 * DEG * self.backlash * way[last]
        draws = self.offset * rng.standard_normal(int(stands.max()) + 2)
        said = said + DEG * np.where(stands >= 0, draws[stands], 0.0) + DEG * self.noise * rng.standard_normal(len(t))
        if self.slip is not None:
            said = said + DEG * self.slip[1] * (t > self.slip[0])
        return np.round(said / (self.step * DEG)) * self.step * DEG if self.step else said


@dataclass
class Axis:
    """An axis of the table: its direction while all stand at zero (East, North, up), and its faults.

    `skew`: rad, by which the angle to the next axis inside differs from the nominal one. `wobble`: rad; the axis draws
    a cone of this half angle, `wobble_order` times a turn.
    """

    direction: Sequence[float] = (0.0, 0.0, 1.0)
    encoder: Encoder = field(default_factory=Encoder)
    skew: float = 0.0
    wobble: float = 0.0
    wobble_order: int = 1


@dataclass
class Bench:
    axes: Sequence[Axis]
    latitude: float = 48.0
    gravity: float = G
    base: Sequence[float] = (0.0, 0.0, 0.0)
    """Rotation vector of the table's base in East-North-Up, rad."""
    lever: Sequence[float] = (0.0, 0.0, 0.0)
    """Where the unit sits on the innermost stage, from the axes' intersection, m."""

    def attitude(self, angles: Floats) -> Floats:
        """Quaternions of the innermost stage."""
        q = rotation(np.broadcast_to(np.array(self.base, float), (len(angles), 3)))
        for k, axis in enumerate(self.axes):
            d, angle = np.array(axis.direction, float), angles[:, k]
            if axis.wobble:
                across = np.cross(d, [0.6, 0.64, -0.48])
                across /= np.linalg.norm(across)
                other, phase = np.cross(d, across), axis.wobble_order * angle[:, None]
                q = product(q, rotation(axis.wobble * (np.cos(phase) * across + np.sin(phase) * other)))
            q = product(q, rotation(angle[:, None] * d))
            if axis.skew:
                inner = np.array(self.axes[k + 1].direction, float)
                q = product(q, rotation(np.broadcast_to(axis.skew * np.cross(inner, d), (len(angles), 3))))
        return q


@dataclass
class Climate:
    """Air of a chamber over time, die and thermometer: `corners` are (s, °C); lags of first order, s; offsets, K."""

    corners: Sequence[tuple[float, float]]
    air_to_die: float = 0.0
    die_to_thermometer: float = 0.0
    thermometer_to_die: float = 0.0
    """The die follows what the thermometer shows, which sits outside of it."""
    self_heating: float = 0.0
    """The die is so much warmer than its thermometer."""
    offset: float = 0.0
    """The thermometer shows so much more than the temperature where it sits."""
    noise: float = 0.01
    step: float = 0.0
    frozen: tuple[float, float] | None = None
    """Between these times it shows what it showed before."""

    def at(self, t: Floats) -> tuple[Floats, Floats]:
        """Die, and what the thermometer's place is at, °C."""
        times, course = zip(*self.corners, strict=True)
        place = _follow(np.interp(t, times, course), t, self.air_to_die)
        if self.thermometer_to_die:
            return _follow(place, t, self.thermometer_to_die) + self.self_heating, place
        return place + self.self_heating, _follow(place, t, self.die_to_thermometer)

    def shows(self, t: Floats, place: Floats, rng: np.random.Generator) -> Floats:
        said = place + self.offset + self.noise * rng.standard_normal(len(t))
        if self.step:
            said = np.round(said / self.step) * self.step
        if self.frozen is not None:
            inside = (t > self.frozen[0]) & (t < self.frozen[1])
            said[inside] = said[np.flatnonzero(inside)[0] - 1]
        return said


def _follow(course: Floats, t: Floats, lag: float) -> Floats:
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


def powers(coefficients: Sequence[float]) -> Law:
    """A map over temperature in powers of (T − 20)/50."""
    return lambda t: np.polynomial.polynomial.polyval((t - 20.0) / 50.0, np.array(coefficients, float))


def zero(t: Floats) -> Floats:
    return np.zeros_like(t)


@dataclass
class Channel:
    """A gyro or an accelerometer, SI: what it says of `along`, its input axis (a unit vector of the body).

    `scale(T, input)`, `bias(T)`; `force`: answer of a gyro to the specific force (3); `square`: of an accelerometer to
    the square of its input. `gradient`: rad/K, times dT/dt of the die. `white`: per √Hz (one-sided √(1/Hz)).
    """

    along: Sequence[float]
    bias: Law = zero
    scale: Callable[[Floats, Floats], Floats] = lambda t, x: np.zeros_like(t)
    force: Sequence[float] = (0.0, 0.0, 0.0)
    square: float = 0.0
    gradient: float = 0.0
    hysteresis: Callable[[Floats, Floats], Floats] | None = None
    """Of time and temperature of the die: added to the bias."""
    white: float = 0.0
    drift: Sequence[tuple[float, float]] = ()
    """Gauss–Markov: standard deviation, correlation time."""
    walk: float = 0.0
    """Random walk of the bias, per √s."""
    scale_drift: Sequence[tuple[float, float]] = ()
    turn_on: float = 0.0
    vibration: float = 0.0
    """Of the rate while the table turns, rms; and what the sensor rectifies of it:"""
    rectified: float = 0.0
    kind: str = "gyro"

    def says(self, t: Floats, die: Floats, rate: Floats, force: Floats, own: Floats) -> Floats:
        felt = (rate if self.kind == "gyro" else force) @ np.array(self.along, float)
        said = felt * (1.0 + self.scale(die, felt) + own) + self.bias(die) + self.turn_on
        if any(self.force):
            said = said + force @ np.array(self.force, float)
        if self.square:
            said = said + self.square * felt**2
        if self.gradient:
            said = said + self.gradient * np.gradient(die, t)
        if self.hysteresis is not None:
            said = said + self.hysteresis(t, die)
        return said


@dataclass
class Chain:
    """From what a sensor feels to the rows of a log."""

    hz: float = 50.0
    clock: float = 0.0
    """The sensor's seconds are so much too many (a ratio): its stamps run fast."""
    host: float | None = None
    """Scatter of the computer's stamps (s), where the log has them."""
    low_pass: float = 0.0
    """Corner of a first-order filter, Hz."""
    delay: float = 0.0
    """The samples are of so long ago, s."""
    step: dict[str, float] = field(default_factory=dict[str, float])
    limit: dict[str, float] = field(default_factory=dict[str, float])
    lost: float = 0.0
    """Share of rows that never arrive."""
    late: tuple[float, float] = (0.0, 0.0)
    """Share of stamps, and by how much (s) they are late."""
    spikes: tuple[float, float] = (0.0, 0.0)
    """Share of gyro samples, and their size, rad/s."""
    frozen: tuple[float, float, tuple[int, ...]] | None = None
    """Between these times these channels repeat their last sample."""


@dataclass
class Recorded:
    """Rows as they leave the chain: SI, °C; `values` [row, channel]."""

    time: Floats
    values: Floats
    temperature: Floats
    angles: Floats
    stands: Floats
    host: Floats | None = None


def record(
    bench: Bench,
    channels: Sequence[Channel],
    motion: Motion,
    climate: Climate,
    chain: Chain | None = None,
    *,
    seed: int = 0,
    fine: int = 4,
) -> Recorded:
    """What is recorded of a run. Each effect draws from a generator of its own, so that scenes differ by their fault
    alone."""
    chain = Chain() if chain is None else chain
    draw = lambda number: np.random.default_rng([seed, number])  # noqa: E731
    count, h = round(motion.end * chain.hz), 1.0 / chain.hz
    edges = np.arange(count * fine + 1) * (h / fine)
    angles, _ = motion.at(np.maximum(edges - chain.delay, 0.0))
    attitude = bench.attitude(angles)
    middle = 0.5 * (attitude[1:] + attitude[:-1])
    middle /= np.linalg.norm(middle, axis=1, keepdims=True)
    phi = bench.latitude * DEG
    earth = EARTH * np.array([0.0, np.cos(phi), np.sin(phi)])
    rate = turned_by(attitude[:-1], attitude[1:]) * (chain.hz * fine) + inwards(middle, earth)
    force = inwards(middle, np.array([0.0, 0.0, bench.gravity]))
    if any(bench.lever):
        arm = np.array(bench.lever, float)
        force = force + np.cross(rate, np.cross(rate, arm))
        force = force + np.cross(np.gradient(rate, h / fine, axis=0), arm)
    die_at, place = climate.at(edges)
    within, die = 0.5 * (edges[1:] + edges[:-1]), 0.5 * (die_at[1:] + die_at[:-1])
    moving = np.any(angles[1:] != angles[:-1], axis=1)
    values = np.empty((count, len(channels)))
    for k, channel in enumerate(channels):
        rng = draw(100 + k)
        own = np.repeat(sum((_markov(s, tau, h, count, rng) for s, tau in channel.scale_drift), np.zeros(count)), fine)
        said = channel.says(within, die, rate, force, own)
        if channel.vibration or channel.rectified:
            shake = channel.vibration * np.sqrt(2.0) * np.sin(2.0 * np.pi * 17.3 * within + k)
            said = said + np.where(moving, shake + channel.vibration * draw(50 + k).standard_normal(len(within)), 0.0)
            said = said + np.where(moving, channel.rectified, 0.0)
        if chain.low_pass:
            keep = np.exp(-2.0 * np.pi * chain.low_pass * h / fine)
            said, _ = lfilter([1.0 - keep], [1.0, -keep], said, zi=[keep * said[0]])
        mean = said.reshape(count, fine).mean(axis=1)
        mean += channel.white / np.sqrt(h) * rng.standard_normal(count)
        mean += sum((_markov(s, tau, h, count, rng) for s, tau in channel.drift), np.zeros(count))
        mean += channel.walk * np.sqrt(h) * np.cumsum(rng.standard_normal(count))
        values[:, k] = mean
    true = edges[fine::fine]
    here, stands = motion.at(true)
    read = [axis.encoder.reads(true, here[:, k], stands, draw(20 + k)) for k, axis in enumerate(bench.axes)]
    found = Recorded(true, values, climate.shows(true, place[fine::fine], draw(1)), np.column_stack(read), stands)
    return _through(found, channels, chain, draw)


def _through(found: Recorded, channels: Sequence[Channel], chain: Chain, draw: Any) -> Recorded:
    """The electronics after the samples."""
    true, values = found.time, found.values
    for k, channel in enumerate(channels):
        if channel.kind == "gyro" and chain.spikes[0]:
            rng = draw(60 + k)
            hit = rng.random(len(true)) < chain.spikes[0]
            values[hit, k] += chain.spikes[1] * rng.choice([-1.0, 1.0], int(hit.sum()))
        if limit := chain.limit.get(channel.kind):
            values[:, k] = np.clip(values[:, k], -limit, limit)
        if step := chain.step.get(channel.kind):
            values[:, k] = np.round(values[:, k] / step) * step
    if chain.frozen is not None:
        begin, end, which = chain.frozen
        inside = np.flatnonzero((true > begin) & (true < end))
        values[np.ix_(inside, which)] = values[inside[0] - 1, list(which)]
    stamps = true * (1.0 + chain.clock)
    if chain.late[0]:
        rng = draw(2)
        behind = np.where(rng.random(len(true)) < chain.late[0], chain.late[1], 0.0)
        stamps = stamps + behind
        # A stamp that would come after the next one is the next one's less a little.
        stamps = np.minimum.accumulate((stamps - 1e-6 * np.arange(len(true)))[::-1])[::-1] + 1e-6 * np.arange(len(true))
    host = None
    if chain.host is not None:
        host = np.maximum.accumulate(true + chain.host * np.abs(draw(3).standard_normal(len(true))))
        host = host + 1e-7 * np.arange(len(true))
    kept = draw(4).random(len(true)) >= chain.lost
    kept[0] = True
    host = None if host is None else host[kept]
    return Recorded(stamps[kept], values[kept], found.temperature[kept], found.angles[kept], found.stands[kept], host)


def _markov(sigma: float, tau: float, h: float, count: int, rng: np.random.Generator) -> Floats:
    keep = np.exp(-h / tau)
    kicks = sigma * np.sqrt(1.0 - keep**2) * rng.standard_normal(count)
    kicks[0] = sigma * rng.standard_normal()
    return lfilter([1.0], [1.0, -keep], kicks)


# --- laws of hysteresis -----------------------------------------------------------------------------------------------


def play(width: float, size: float) -> Callable[[Floats, Floats], Floats]:
    """Backlash: the bias keeps the sign of the last change of temperature once that exceeds `width` K; ± `size`.

    What is added is zero on average of both directions."""

    def law(t: Floats, die: Floats) -> Floats:
        """Prandtl's element: a point that is dragged within ± half of the width."""
        every = max(1, len(t) // 20_000)
        course, dragged = die[::every], np.empty(len(die[::every]))
        at = course[0] - 0.5 * width * np.sign(course[-1 if len(course) < 3 else len(course) // 8] - course[0])
        for k, here in enumerate(course):
            at = min(max(at, here - 0.5 * width), here + 0.5 * width)
            dragged[k] = here - at
        return size * np.interp(t, t[::every], dragged) / (0.5 * width)

    return law


def creep(tau: float, per_kelvin: float) -> Callable[[Floats, Floats], Floats]:
    """Visco-elastic: proportional to how far the die is ahead of its own mean over the last `tau` s."""
    return lambda t, die: per_kelvin * (die - _follow(die, t, tau))


# --- the file ---------------------------------------------------------------------------------------------------------


def log_of(found: Recorded, channels: Sequence[Channel], table_axes: Sequence[str], axes: Sequence[str]) -> Log:
    """The rows as the program's log; `axes`: names of the gyros, then (from "x" on) of the accelerometers."""
    gyros = [k for k, channel in enumerate(channels) if channel.kind == "gyro"]
    forces = [k for k, channel in enumerate(channels) if channel.kind != "gyro"]
    return Log(
        time_s=found.time,
        rate_rad_per_s=found.values[None, :, gyros],
        units=("physics",),
        axes=tuple(axes[: len(gyros)]),
        temperature_c=found.temperature[None],
        table_axes=tuple(table_axes),
        table_angle_rad=found.angles,
        standstill=found.stands,
        stretch_starts=np.array([0]),
        host_time_s=found.host,
        simulated=True,
        specific_force_m_per_s2=found.values[None, :, forces] if forces else None,
        force_axes=tuple("xyz"[: len(forces)]) if forces else (),
    )
