"""A whole unit, three gyros and three accelerometers, on nested axes with errors of orthogonality and mounting.

Attitude is a product of rotation matrices, body to East-North-Up, outermost stage first, every angle finite:

    base (tilt, azimuth) · axis 1 · (its non-orthogonality to axis 2) · axis 2 · … · mounting · (mounting's error)

The unit turns at the Earth's rate and at those of the axes, and senses the reaction to gravity. Its gyros and
accelerometers are off the intersection of the axes, some millimetres apart, so that they also sense the acceleration by
rotation. Each sample is the mean over its interval, with the sensors' own errors (IEEE 1431, 1293):

    gyro           ω_i + B(T) + M(T, ω_i)ω_i + Σ m_ij(T)ω_j + Σ G_ij(T)f_j + Σ Q_ij(T)f_j² + k dT/dt + drift + walks
    accelerometer  f_i + b(T) + s(T)f_i + Σ m_ij(T)f_j + k(T)f_i² + h(T)f_i³ + a(T)|f_i| + Σ c_jl(T)f_j f_l + drift
                   + walk
    both           loops over the temperature (`loops`), exponentials since the unit was switched on, and differences of
                   temperature to other masses, one of which the second thermometer measures

Units are SI here (rad/s, m/s², °C), unlike in the rest of this package.
"""

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from typing import Final, Literal

import numpy as np
from numpy.typing import NDArray

from ..pose import turn_about, turn_by
from .loops import Loop, LoopTruth, Mass
from .plants import AxisPlant, ChamberPlant, UncontrolledRoom
from .sensor import Drifts, Process, SampledSensor, SensorSamples, TruthBasis, Vectors

EARTH_RATE = 7.292115e-5
_STANDARD_GRAVITY = 9.80665  # m/s² in the g of SensorSamples
# Parts of a sample: the attitude is that at the middle of each, and rates are exact means.
_PARTS = 3
Matrix = NDArray[np.float64]
Kind = Literal["gyro", "accelerometer"]

FACTORS: Final[Mapping[str, Callable[[Vectors, Vectors], NDArray[np.float64]]]] = {
    "one": lambda own, force: np.ones((len(own), 1, 1)),
    "own": lambda own, force: own[..., None],
    "own squared": lambda own, force: own[..., None] ** 2,
    "own cubed": lambda own, force: own[..., None] ** 3,
    "own size": lambda own, force: np.abs(own)[..., None],
    "inputs": lambda own, force: own[:, None],
    "force": lambda own, force: force[:, None],
    "force squared": lambda own, force: force[:, None] ** 2,
    "products": lambda own, force: (force[:, [0, 0, 1]] * force[:, [1, 2, 2]])[:, None],
}
"""The factors of an error: of the inputs of three sensors and the specific force, `(n, 3)` each, `(n, 3 or 1, k)`: by
sensor axis, or the same for all. The products are xy, xz and yz."""


@dataclass(frozen=True)
class ErrorTerm:
    """An error of the three sensors: factors times functions of temperature, `values` `(3, k, nT)` by sensor axis;
    `lag_s`: of the mass whose temperature it follows."""

    values: NDArray[np.float64]
    basis: TruthBasis
    factors: str
    lag_s: float = 0.0

    def __call__(self, own: Vectors, force: Vectors, temperature_c: NDArray[np.float64]) -> Vectors:
        coefficients = np.einsum("nt,akt->nak", self.basis(temperature_c), self.values)
        factors = np.broadcast_to(FACTORS[self.factors](own, force), coefficients.shape)
        return np.einsum("nak,nak->na", coefficients, factors)


@dataclass(frozen=True)
class ScaleFactors:
    """M(T, ω), `values` `(3, nT, nω)`, of gyros; ω in deg/s in its basis; `lag_s`: as of `ErrorTerm`."""

    values: NDArray[np.float64]
    temperature: TruthBasis
    rate: TruthBasis
    lag_s: float = 0.0

    def __call__(self, own: Vectors, force: Vectors, temperature_c: NDArray[np.float64]) -> Vectors:
        of_rate = self.rate(np.degrees(own).ravel()).reshape(*own.shape, -1)
        return np.einsum("nt,naw,atw->na", self.temperature(temperature_c), of_rate, self.values) * own


@dataclass(frozen=True)
class DifferenceTruth:
    """Errors of three sensors, `values`, for each K that a mass with the time constant `lag_s` is warmer; `of_input`:
    they multiply the input."""

    values: tuple[float, float, float]
    lag_s: float
    of_input: bool = False


@dataclass(frozen=True)
class TriadTruth:
    """Three sensors of a kind, SI. `white`: random walk of the integral for √s, `walk` of the output for √s;
    `gradient`: of the output for each K/s. `loops` over the temperature; `transients`: values at power-on of three
    sensors, and time constant (s); `differences` of temperature."""

    errors: tuple[ErrorTerm | ScaleFactors, ...]
    white: float
    walk: float = 0.0
    drifts: tuple[Process, ...] = ()
    gradient: tuple[float, float, float] = (0.0, 0.0, 0.0)
    loops: tuple[LoopTruth, ...] = ()
    transients: tuple[tuple[tuple[float, float, float], float], ...] = ()
    differences: tuple[DifferenceTruth, ...] = ()

    @property
    def lags_s(self) -> set[float]:
        """Of the masses that it follows."""
        return {of.lag_s for of in (*self.errors, *self.differences) if of.lag_s}


@dataclass(frozen=True)
class TableTruth:
    """True attitudes of the table and its axes, rad. `axes` outermost first, each in the frame that the next outer axis
    carries while all are at zero. `mountings`: true attitudes, body to the innermost axis's frame."""

    axes: tuple[tuple[float, ...], ...]
    latitude: float
    gravity: float
    base: tuple[float, float, float] = (0.0, 0.0, 0.0)
    orthogonality: tuple[float, ...] = ()
    mountings: tuple[Matrix, ...] = (np.eye(3),)
    earth_rate: float = EARTH_RATE


@dataclass(frozen=True)
class ImuTruth:
    """A unit's errors. `lever`, `gyro_lever`: of the accelerometers and gyros from the intersection of the axes, m, in
    the body. `names`: the hidden parameters, by their names in a calibration. `second_lag_s`: of the mass that the
    second thermometer measures; 0: none."""

    triads: Mapping[Kind, TriadTruth]
    lever: tuple[float, float, float] = (0.0, 0.0, 0.0)
    gyro_lever: tuple[float, float, float] = (0.0, 0.0, 0.0)
    clock_error: float = 0.0
    names: dict[str, float] = field(default_factory=dict[str, float])
    second_lag_s: float = 0.0


class SimulatedImu(SampledSensor):
    """One unit on a table that others may share. `mounting`: the present one, from 0; the operator changes it."""

    def __init__(
        self,
        truth: ImuTruth,
        table: TableTruth,
        chamber: ChamberPlant | UncontrolledRoom,
        axes: Sequence[AxisPlant],
        *,
        sample_rate_hz: float,
        seed: int,
        mounting: int = 0,
        start_s: float = 0.0,
    ) -> None:
        if len(axes) != len(table.axes):
            raise ValueError(f"the table has {len(table.axes)} axes and {len(axes)} are given; give as many.")
        self.truth, self.table, self.mounting = truth, table, mounting
        self.clock_error = truth.clock_error
        self._chamber, self._axes = chamber, tuple(axes)
        self._random = np.random.default_rng([seed, 20263])
        self._walked: dict[Kind, Vectors] = {"gyro": np.zeros(3), "accelerometer": np.zeros(3)}
        self._drifts = {kind: Drifts(triad.drifts, self._random) for kind, triad in truth.triads.items()}
        self._loops: dict[Kind, list[tuple[LoopTruth, Loop]]] = {}
        self._lags_s = {lag for triad in truth.triads.values() for lag in triad.lags_s} | {truth.second_lag_s} - {0.0}
        self._masses: dict[float, Mass] = {}
        self._power_on_s = start_s
        self.restart(start_s, sample_rate_hz)

    def take(self, count: int) -> SensorSamples:
        ends = self.ends_of(count)
        nan = np.full((count, 3), np.nan)
        if not count:
            return SensorSamples(ends[1:], nan, nan, np.zeros(0))
        shares = np.arange(count * _PARTS + 1) / _PARTS
        edges = np.interp(shares, np.arange(count + 1.0), ends)
        rate, force = self._motion(edges)
        temperature = self._chamber.load_at((edges[1:] + edges[:-1]) / 2.0)
        middles = self._chamber.load_at((ends[1:] + ends[:-1]) / 2.0)
        late = {0.0: temperature} | {lag: self._mass(lag, temperature) for lag in sorted(self._lags_s)}
        output: dict[Kind, Vectors] = {"gyro": nan, "accelerometer": nan}
        for kind, triad in self.truth.triads.items():
            lever = self.truth.gyro_lever if kind == "gyro" else self.truth.lever
            felt = force + _at_lever(np.array(lever), rate, edges)
            noise, own = self._noise(kind, triad, count), rate if kind == "gyro" else felt
            mean = own.reshape(count, _PARTS, 3).mean(axis=1)
            sensed = own
            for error in triad.errors:
                sensed = sensed + error(own, felt, late[error.lag_s])
            output[kind] = sensed.reshape(count, _PARTS, 3).mean(axis=1) + noise[0] + noise[1] * mean
            if any(triad.gradient):
                change = np.diff(self._chamber.load_at(ends)) / self.true_period_s
                output[kind] = output[kind] + change[:, None] * np.array(triad.gradient)
            output[kind] = output[kind] + self._of_path(kind, triad, middles, mean, ends[1:] - 0.5 * self.true_period_s)
            for of in triad.differences:
                apart = (late[of.lag_s] - temperature).reshape(count, _PARTS).mean(axis=1)
                driven = apart[:, None] * (mean if of.of_input else 1.0)
                output[kind] = output[kind] + driven * np.array(of.values)
        lag_s = self.truth.second_lag_s
        second = late[lag_s].reshape(count, _PARTS).mean(axis=1) if lag_s else None
        outputs = np.degrees(output["gyro"]), output["accelerometer"] / _STANDARD_GRAVITY
        return SensorSamples(ends[1:], *outputs, middles, second)

    def _mass(self, lag_s: float, temperature_c: Vectors) -> Vectors:
        """The temperatures of a mass at all parts of the samples."""
        if lag_s not in self._masses:
            self._masses[lag_s] = Mass(float(temperature_c[0]), lag_s)
        return self._masses[lag_s].take(temperature_c, self.true_period_s / _PARTS)

    def _of_path(
        self, kind: Kind, triad: TriadTruth, temperature_c: Vectors, mean: Vectors, time_s: Vectors
    ) -> Vectors:
        """What depends on the path of temperature, or on the time since power-on, `(n, 3)`."""
        if kind not in self._loops:
            self._loops[kind] = [(loop, loop.begin(float(temperature_c[0]))) for loop in triad.loops]
        total = np.zeros_like(mean)
        for truth, loop in self._loops[kind]:
            total = total + loop.take(temperature_c, self.true_period_s) * (mean if truth.of_input else 1.0)
        for values, time_constant_s in triad.transients:
            total = total + np.exp(-(time_s - self._power_on_s) / time_constant_s)[:, None] * np.array(values)
        return total

    def _noise(self, kind: Kind, triad: TriadTruth, count: int) -> tuple[Vectors, Vectors]:
        """The additive error and the scale-factor error of every sample: `(count, 3)` each."""
        dt = self.true_period_s
        draws = self._random.standard_normal((count, 3, 2 + len(triad.drifts)))
        drift, unsteady = self._drifts[kind].take(draws[..., 2:], dt)
        walk = self._walked[kind] + np.cumsum(triad.walk * dt**0.5 * draws[..., 1], axis=0)
        self._walked[kind] = walk[-1]
        return triad.white / dt**0.5 * draws[..., 0] + walk + drift, unsteady

    def _motion(self, edges: NDArray[np.float64]) -> tuple[Vectors, Vectors]:
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


def _at_lever(lever: Vectors, rate: Vectors, edges: NDArray[np.float64]) -> Vectors:
    """The acceleration by rotation in the specific force: ω × (ω × r) + ω̇ × r."""
    middles = (edges[1:] + edges[:-1]) / 2.0
    return np.cross(rate, np.cross(rate, lever)) + np.cross(np.gradient(rate, middles, axis=0), lever)
