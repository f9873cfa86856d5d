"""A whole unit, three gyros and three accelerometers, on nested axes with errors of orthogonality and mounting.

Attitude is a product of rotation matrices, body to East-North-Up, outermost stage first, every angle finite:

    base (tilt, azimuth) · axis 1 · (its non-orthogonality to axis 2) · axis 2 · … · mounting · (mounting's error)

The unit turns at the Earth's rate and at those of the axes, and senses the reaction to gravity. Its sensors are off the
intersection of the axes, so that they also sense the acceleration by rotation. Each sample is the mean over its
interval, with the sensors' own errors (IEEE 1431, 1293):

    gyro           s_i + B(T) + M(T, s_i)s_i + Σ G_ij(T)f_j + Σ Q_ij(T)f_j² + k dT/dt + drift + walks
    accelerometer  s_i + b(T) + s(T)s_i + k(T)s_i² + h(T)s_i³ + a(T)|s_i| + Σ c_jl(T)f_j f_l + drift + walk
    both           s_i = ω_i + Σ m_ij(T)ω_j, or of f: the input along the sensor's own axis of sensitivity, on which
                   its scale factor acts;
                   loops over the temperature (`Loop`)

Units are SI here (rad/s, m/s², °C), unlike in the rest of this package.
"""

from abc import ABC, abstractmethod
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from itertools import accumulate
from typing import Any, Literal, Protocol

import numpy as np
from numpy.typing import NDArray

from gradcal_jax.hardware.simulate.plants import AxisPlant, Mass, filtered

Vectors = NDArray[np.float64]
Functions = Callable[[Vectors], Vectors]
"""Functions of a temperature (°C) or a rate (rad/s), `(n,) -> (n, k)`."""
Kind = Literal["gyro", "accelerometer"]
Loop = Callable[[Vectors, float], Vectors]
"""The errors `(n, 3)` of a hysteresis loop at consecutive temperatures `(n,)`, with their period (s)."""
Factors = Callable[[Vectors, Vectors], Vectors]
"""The factors `(n, 3 or 1, k)` of an error, for each sensor axis or the same for all, as functions of the inputs of
three sensors and of the specific force, `(n, 3)` each."""

EARTH_RATE = 7.292115e-5
_STANDARD_GRAVITY = 9.80665  # m/s² in the g of SensorSamples
# Parts of a sample: the attitude is that at the middle of each, and rates are exact means.
_PARTS = 3


def one(own: Vectors, force: Vectors) -> Vectors:
    return np.ones((len(own), 1, 1))


def own_input(own: Vectors, force: Vectors) -> Vectors:
    return own[..., None]


def own_squared(own: Vectors, force: Vectors) -> Vectors:
    return own[..., None] ** 2


def all_inputs(own: Vectors, force: Vectors) -> Vectors:
    """Of misalignments, which change what the sensors sense, before their other errors."""
    return own[:, None]


def all_forces(own: Vectors, force: Vectors) -> Vectors:
    return force[:, None]


def rate_functions(functions: Functions) -> Factors:
    """The rate times functions of it: those of M(T, ω)."""
    return lambda own, force: functions(own.ravel()).reshape(*own.shape, -1) * own[..., None]


class HysteresisLoop(Protocol):
    """What depends on past temperatures. `of_input`: it multiplies the input, as a scale factor."""

    @property
    def of_input(self) -> bool: ...

    def begin(self, temperature_c: float) -> Loop:
        """The loop in a sensor that has been long at a temperature."""
        ...


@dataclass(frozen=True)
class PlayTruth:
    """A play of half-width `width_k` behind the temperature of three sensors, of which `slopes` (SI, for each K) are
    the errors."""

    slopes: tuple[float, ...]
    width_k: float
    of_input: bool = False

    def begin(self, temperature_c: float) -> Loop:
        place_k, slopes = temperature_c, np.array(self.slopes)

        def pushed(place_k: float, at_c: float) -> float:
            return min(max(place_k, at_c - self.width_k), at_c + self.width_k)

        def loop(temperatures_c: Vectors, period_s: float) -> Vectors:
            nonlocal place_k
            _, *places_k = accumulate(temperatures_c.tolist(), pushed, initial=place_k)
            place_k = places_k[-1]
            return (np.array(places_k) - temperatures_c)[:, None] * slopes

        return loop


@dataclass(frozen=True)
class Process:
    """A Gauss–Markov process of each axis; it adds `bias_gain` times itself to the output and `rate_gain` times itself
    to the scale factor. An infinite `tau_s` is one draw."""

    sigma: float
    tau_s: float
    bias_gain: float = 0.0
    rate_gain: float = 0.0


@dataclass(frozen=True)
class ErrorTerm:
    """An error of the three sensors: factors times functions of temperature, `values` `(3, k, nT)` by sensor axis."""

    values: Vectors
    basis: Functions
    factors: Factors

    def __call__(self, own: Vectors, force: Vectors, temperature_c: Vectors) -> Vectors:
        count = self.values.shape[1]
        coefficients = self.basis(temperature_c) @ self.values.reshape(3 * count, -1).T
        return np.add.reduce(coefficients.reshape(-1, 3, count) * self.factors(own, force), axis=2)


@dataclass(frozen=True)
class TriadTruth:
    """Three sensors of a kind, SI. `white`: random walk of the integral for √s, `walk` of the output for √s;
    `gradient`: of the output for each K/s. `loops` over the temperature."""

    errors: tuple[ErrorTerm, ...]
    white: float
    walk: float = 0.0
    drifts: tuple[Process, ...] = ()
    gradient: tuple[float, ...] = (0.0, 0.0, 0.0)
    loops: tuple[HysteresisLoop, ...] = ()


@dataclass(frozen=True)
class TableTruth:
    """True attitudes of the table and its axes, rad. `axes` outermost first, each in the frame that the next outer axis
    carries while all are at zero. `mountings`: true attitudes, body to the innermost axis's frame."""

    axes: tuple[tuple[float, ...], ...]
    latitude: float
    gravity: float
    base: tuple[float, float, float] = (0.0, 0.0, 0.0)
    orthogonality: tuple[float, ...] = ()
    mountings: tuple[Vectors, ...] = (np.eye(3),)
    earth_rate: float = EARTH_RATE


@dataclass(frozen=True)
class ImuTruth:
    """A unit's errors. `lever`, `gyro_lever`: of the accelerometers and gyros from the intersection of the axes, m, in
    the body. `names`: the hidden parameters, by their names in a calibration. The dies follow what the
    thermometer measures `die_lag_s` late, and it is `thermometer_offset` K off."""

    triads: Mapping[Kind, TriadTruth]
    lever: tuple[float, ...] = (0.0, 0.0, 0.0)
    gyro_lever: tuple[float, ...] = (0.0, 0.0, 0.0)
    clock_error: float = 0.0
    names: dict[str, float] = field(default_factory=dict[str, float])
    die_lag_s: float = 0.0
    thermometer_offset: float = 0.0


@dataclass(frozen=True)
class SensorSamples:
    """`n` samples: mean rate as measured (deg/s), specific force (g), temperature (°C), true time of their ends."""

    time_s: Vectors
    rate_dps: Vectors
    acceleration_g: Vectors
    temperature_c: Vectors


class SampledSensor(ABC):
    """Consecutive samples by the unit's own clock; the same seed gives the same samples in blocks of any size. A
    subclass gives their values in `take`."""

    clock_error: float
    taken: int
    """Samples since the last restart."""

    def restart(self, now_s: float, sample_rate_hz: float) -> None:
        """Sample at this rate of the unit's clock from now on, which runs fast by the clock error."""
        self._start_s, self.taken = now_s, 0
        self.true_period_s = 1.0 / sample_rate_hz / (1.0 + self.clock_error)

    def next_time_s(self, ahead: int = 1) -> float:
        """True time at which the sample `ahead` from now is complete."""
        return self._start_s + (self.taken + ahead) * self.true_period_s

    def due(self, now_s: float) -> int:
        """The number of complete samples not yet taken."""
        return max(0, int((now_s - self._start_s) / self.true_period_s + 1e-6) - self.taken)

    def ends_of(self, count: int) -> Vectors:
        """`(count + 1,)`: the true times at the ends of the next samples, which count as taken."""
        ends = self._start_s + (self.taken + np.arange(count + 1.0)) * self.true_period_s
        self.taken += count
        return ends

    @abstractmethod
    def take(self, count: int) -> SensorSamples:
        """The next samples."""


class Climate(Protocol):
    """A chamber, or a room: the temperature of the load at times `(n,)`, s."""

    def load_at(self, times_s: Vectors) -> Vectors: ...


def _skew(vector: Any) -> Vectors:
    x, y, z = vector
    return np.array([[0.0, -z, y], [z, 0.0, -x], [-y, x, 0.0]])


def turn_about(axis: Sequence[float] | Vectors, angle: float | Vectors) -> Vectors:
    """`(…, 3, 3)`, the matrices of turns by angles `(…)` (rad) about a unit vector (Rodrigues)."""
    k, angle = _skew(axis), np.asarray(angle)[..., None, None]
    return np.eye(3) + np.sin(angle) * k + (1.0 - np.cos(angle)) * (k @ k)


def turn_by(vector: Sequence[float] | Vectors) -> Vectors:
    """`(3, 3)`, the matrix of a turn by a rotation vector (rad)."""
    size = float(np.linalg.norm(vector))
    return turn_about(np.array(vector) / size, size) if size > 0.0 else np.eye(3)


def _means(parts: Vectors) -> Vectors:
    """Means of the parts of samples, `(n · parts, …) -> (n, …)`."""
    return np.add.reduce(parts.reshape(-1, _PARTS, *parts.shape[1:]), axis=1) / _PARTS


class _Triad:
    """Three sensors of a kind, with what they remember."""

    def __init__(self, truth: TriadTruth, random: np.random.Generator) -> None:
        self._truth, self._random = truth, random
        drawn = random.standard_normal((3, len(truth.drifts)))
        self._drifts = [process.sigma * draw for process, draw in zip(truth.drifts, drawn.T, strict=True)]
        self._walked = np.zeros(3)
        self._loops: list[Loop] = []

    def output(
        self, own: Vectors, felt: Vectors, parts_c: Vectors, middles_c: Vectors, change: Vectors, period_s: float
    ) -> Vectors:
        """What they say of their inputs `own` and of the force, at temperatures, of all parts of the samples; and of
        each sample, its temperature and the slope (K/s)."""
        truth = self._truth
        senses = [error for error in truth.errors if error.factors is all_inputs]
        others = [error for error in truth.errors if error.factors is not all_inputs]
        along = sum((error(own, felt, parts_c) for error in senses), start=own)
        said = sum((error(along, felt, parts_c) for error in others), start=along)
        mean = _means(along)
        added, scaled = self._noise(len(mean), period_s)
        said = _means(said) + added + scaled * mean + change[:, None] * np.array(truth.gradient)
        self._loops = self._loops or [loop.begin(float(middles_c[0])) for loop in truth.loops]
        for law, loop in zip(truth.loops, self._loops, strict=True):
            said = said + loop(middles_c, period_s) * (mean if law.of_input else 1.0)
        return said

    def _noise(self, count: int, dt: float) -> tuple[Vectors, Vectors | float]:
        """The additive error and the scale-factor error of every sample: `(count, 3)` each."""
        truth = self._truth
        draws = self._random.standard_normal((count, 3, 2 + len(truth.drifts)))
        walk = self._walked + np.cumsum(truth.walk * dt**0.5 * draws[..., 1], axis=0)
        self._walked = walk[-1]
        added, scaled = truth.white / dt**0.5 * draws[..., 0] + walk, 0.0
        for number, process in enumerate(truth.drifts):
            decay = float(np.exp(-dt / process.tau_s))
            size = process.sigma * np.sqrt(1.0 - decay**2)
            state = decay * self._drifts[number][None]
            values = filtered([size], [1.0, -decay], draws[..., 2 + number], state)
            self._drifts[number] = values[-1]
            added = added + process.bias_gain * values
            scaled = scaled + process.rate_gain * values
        return added, scaled


class SimulatedImu(SampledSensor):
    """One unit on a table that others may share. `mounting`: the present one, from 0; the operator changes it."""

    def __init__(
        self,
        truth: ImuTruth,
        table: TableTruth,
        chamber: Climate,
        axes: Sequence[AxisPlant],
        *,
        sample_rate_hz: float,
        seed: int,
        mounting: int = 0,
        start_s: float = 0.0,
    ) -> None:
        if len(axes) != len(table.axes):
            raise ValueError(f"the table has {len(table.axes)} axes, but {len(axes)} axes are given: give all axes.")
        self.truth, self.table, self.mounting = truth, table, mounting
        self.clock_error = truth.clock_error
        self._chamber, self._axes = chamber, tuple(axes)
        random = np.random.default_rng([seed, 20263])
        self._triads: dict[Kind, _Triad] = {kind: _Triad(triad, random) for kind, triad in truth.triads.items()}
        self._die: Mass | None = None
        self.restart(start_s, sample_rate_hz)

    def take(self, count: int) -> SensorSamples:
        ends, truth, period_s = self.ends_of(count), self.truth, self.true_period_s
        edges = np.interp(np.arange(count * _PARTS + 1) / _PARTS, np.arange(count + 1.0), ends)
        rate, force = self._motion(edges)
        acceleration = _slopes(rate, period_s / _PARTS)
        temperature = self._chamber.load_at((edges[1:] + edges[:-1]) / 2.0)
        middles = shown = self._chamber.load_at((ends[1:] + ends[:-1]) / 2.0)
        change = np.diff(self._chamber.load_at(ends)) / period_s
        if truth.die_lag_s:
            self._die = self._die or Mass(float(temperature[0]), truth.die_lag_s)
            temperature = self._die.take(temperature, period_s / _PARTS)
            middles = _means(temperature)
            change = (shown - middles) / truth.die_lag_s
        absent = np.full((count, 3), np.nan)
        output: dict[Kind, Vectors] = {"gyro": absent, "accelerometer": absent}
        for kind, triad in self._triads.items():
            lever = np.array(truth.gyro_lever if kind == "gyro" else truth.lever)
            felt = force + _at_lever(lever, rate, acceleration)
            sensed = rate if kind == "gyro" else felt
            output[kind] = triad.output(sensed, felt, temperature, middles, change, period_s)
        outputs = np.degrees(output["gyro"]), output["accelerometer"] / _STANDARD_GRAVITY
        return SensorSamples(ends[1:], *outputs, shown + truth.thermometer_offset)

    def _motion(self, edges: Vectors) -> tuple[Vectors, Vectors]:
        """Rate against inertial space (rad/s) and specific force (m/s²) in the body, `(n, 3)` between `n + 1` times."""
        table = self.table
        middles, lasting = (edges[1:] + edges[:-1]) / 2.0, np.diff(edges)
        attitude = turn_by(table.base)[None]
        turning = np.zeros((len(middles), 3))
        for l, (axis, plant) in enumerate(zip(table.axes, self._axes, strict=True)):
            direction = np.array(axis)
            pace = np.radians(np.diff(plant.position(edges))) / lasting
            turning = turning + attitude @ direction * pace[:, None]
            attitude = attitude @ turn_about(direction, np.radians(plant.position(middles)))
            if l + 1 < len(table.axes):
                off = table.orthogonality[l] * np.cross(np.array(table.axes[l + 1]), direction)
                attitude = attitude @ turn_by(off)
        attitude = attitude @ table.mountings[self.mounting]
        earth = table.earth_rate * np.array([0.0, np.cos(table.latitude), np.sin(table.latitude)])
        return np.einsum("nij,ni->nj", attitude, turning + earth), table.gravity * attitude[:, 2]


def _slopes(values: Vectors, step_s: float) -> Vectors:
    """Derivatives of values a step apart, by both neighbours."""
    steps = np.diff(values, axis=0)
    within = 0.5 * (steps[1:] + steps[:-1])
    return np.concatenate([steps[:1], within, steps[-1:]]) / step_s


def _at_lever(lever: Vectors, rate: Vectors, acceleration: Vectors) -> Vectors:
    """The acceleration by rotation in the specific force: ω × (ω × r) + ω̇ × r."""
    turned = rate * (rate @ lever)[:, None] - lever * np.sum(rate * rate, axis=1)[:, None]
    return turned + acceleration @ _skew(lever)
