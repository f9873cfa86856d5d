"""A whole unit, three gyros and three accelerometers, on nested axes with errors of orthogonality and mounting.

The rate against inertial space and the reaction to gravity are turned from East-North-Up into the body, stage by stage
from the outermost one, every angle finite:

    base (tilt, azimuth) · axis 1 · (its non-orthogonality to axis 2) · axis 2 · … · mounting · (mounting's error)

The sensors are off the intersection of the axes, so that they also sense the acceleration by rotation. Each sample is
the mean over its interval, with the sensors' own errors (IEEE 1431, 1293):

    gyro           s_i + B(T) + M(T, s_i)s_i + Σ G_ij(T)f_j + k dT/dt + drift + walks
    accelerometer  s_i + b(T) + s(T)s_i + k(T)s_i² + k dT/dt + drift
    both           s_i = ω_i + Σ m_ij(T)ω_j, or of f: the input along the sensor's own axis of sensitivity, on which
                   its scale factor acts;
                   loops over the temperature (`Loop`)

Units are SI here (rad/s, m/s², °C), unlike in the rest of this package. Vectors are columns: `(3, n)`.
"""

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from itertools import accumulate, pairwise
from typing import Any, Final, Literal

import numpy as np

from gradcal_jax.formulas import EARTH_RATE
from gradcal_jax.hardware.simulate.plants import AxisPlant, ChamberPlant, Floats, Mass, UncontrolledRoom, decayed

Functions = Callable[[Floats], Floats]
"""Functions of a temperature (°C) or a rate (rad/s), `(n,) -> (n, k)`."""
Kind = Literal["gyro", "accelerometer"]
Loop = Callable[[Floats, float], Floats]
"""The errors `(n, 3)` of a hysteresis loop at consecutive temperatures `(n,)`, with their period (s)."""
Factors = Callable[[Floats, Floats], Floats | float]
"""The factors of an error's `k` coefficients, of a shape like `(3, k, n)`, as functions of the inputs along the three
sensors and of the specific force, `(3, n)` each."""

_STANDARD_GRAVITY: Final = 9.80665  # m/s² in the g of SensorSamples
# Parts of a sample, an odd number: the attitude is that at the middle of each, and rates are exact means.
_PARTS: Final = 3
FACTORS: Final[Mapping[str, Factors]] = {
    "bias": lambda own, force: 1.0,
    "scale_factor": lambda own, force: own[:, None],
    "second_order": lambda own, force: own[:, None] ** 2,
    "misalignment": lambda own, force: own,
    "g_sensitivity": lambda own, force: force,
}


def rate_functions(functions: Functions) -> Factors:
    """The rate times functions of it: those of M(T, ω)."""

    def factors(own: Floats, force: Floats) -> Floats:
        values = functions(own.ravel()).T
        return values.reshape(-1, *own.shape).swapaxes(0, 1) * own[:, None]

    return factors


@dataclass(frozen=True)
class ErrorTerm:
    """An error of the three sensors: factors times functions of temperature, `values` `(3, k, nT)` by sensor axis; one
    that does not depend on temperature has no `basis`."""

    values: Floats
    basis: Functions | None
    factors: Factors

    def __call__(self, own: Floats, force: Floats, temperature_c: Floats) -> Floats:
        coefficients = self.values
        if self.basis is not None:
            of_one = self.values.reshape(-1, self.values.shape[2]) @ self.basis(temperature_c).T
            coefficients = of_one.reshape(*self.values.shape[:2], -1)
        return np.add.reduce(coefficients * self.factors(own, force), axis=1)


@dataclass(frozen=True)
class PlayTruth:
    """A play of half-width `width_k` behind the temperature of three sensors, of which `slopes` (SI, for each K) are
    the errors. `of_input`: it multiplies the input, as a scale factor."""

    slopes: tuple[float, ...]
    width_k: float
    of_input: bool = False

    def begin(self, temperature_c: float) -> Loop:
        """The loop in a sensor that has been long at a temperature."""
        place_k, slopes = temperature_c, np.array(self.slopes)

        def pushed(place_k: float, at_c: float) -> float:
            return min(max(place_k, at_c - self.width_k), at_c + self.width_k)

        def loop(temperatures_c: Floats, period_s: float) -> Floats:
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
class TriadTruth:
    """Three sensors of a kind, SI. `errors`: by name, of which "misalignment" changes what the others act on. `white`:
    random walk of the integral for √s, `walk` of the output for √s; `gradient`: of the output for each K/s. `loops`
    over the temperature."""

    errors: Mapping[str, ErrorTerm]
    white: float
    walk: float = 0.0
    drifts: tuple[Process, ...] = ()
    gradient: tuple[float, ...] = (0.0, 0.0, 0.0)
    loops: tuple[PlayTruth, ...] = ()


@dataclass(frozen=True)
class TableTruth:
    """True attitudes of the table and its axes, rad. `axes` outermost first, each in the frame that the next outer axis
    carries while all are at zero. `mountings`: true attitudes, body to the innermost axis's frame."""

    axes: tuple[tuple[float, ...], ...]
    latitude: float
    gravity: float
    base: tuple[float, float, float] = (0.0, 0.0, 0.0)
    orthogonality: tuple[float, ...] = ()
    mountings: tuple[Floats, ...] = (np.eye(3),)
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
    """`n` samples: mean rate as measured (deg/s), specific force (g), `(n, 3)`; temperature (°C), true time of their
    ends. A triad that the unit lacks has NaN."""

    time_s: Floats
    rate_dps: Floats
    acceleration_g: Floats
    temperature_c: Floats


def _cross(vector: Any) -> Floats:
    """The matrix of the cross product with a vector."""
    x, y, z = vector
    return np.array([[0.0, -z, y], [z, 0.0, -x], [-y, x, 0.0]])


def _turned(vectors: Floats, axis: Any, angle: Floats | float) -> Floats:
    """Vectors `(…, 3, n)` turned by angles (rad) about a unit vector (Rodrigues)."""
    cross = _cross(axis)
    across = cross @ vectors
    return vectors + np.sin(angle) * across + (1.0 - np.cos(angle)) * (cross @ across)


def turn_by(vector: Sequence[float] | Floats) -> Floats:
    """`(3, 3)`, the matrix of a turn by a rotation vector (rad)."""
    size = float(np.linalg.norm(vector))
    return _turned(np.eye(3), np.array(vector) / (size or 1.0), size)


def _means(parts: Floats) -> Floats:
    """Means of the parts of samples, `(…, n · parts) -> (…, n)`."""
    first, middle, last = (parts[..., part::_PARTS] for part in range(_PARTS))
    return (first + middle + last) / _PARTS


class _Triad:
    """Three sensors of a kind, with what they remember."""

    def __init__(self, truth: TriadTruth, random: np.random.Generator) -> None:
        self._truth, self._random = truth, random
        drifts = truth.drifts
        self._sigmas, self._taus_s = np.array([(p.sigma, p.tau_s) for p in drifts]).reshape(-1, 2).T[..., None, None]
        self._gains = np.array([(p.bias_gain, p.rate_gain) for p in drifts]).reshape(-1, 2).T
        self._drifts = self._sigmas * random.standard_normal((3, len(drifts))).T[..., None]
        self._walked = np.zeros((3, 1))
        self._loops: list[Loop] = []

    def output(
        self, own: Floats, felt: Floats, parts_c: Floats, middles_c: Floats, change: Floats, period_s: float
    ) -> Floats:
        """What they say of their inputs `own` and of the force, at temperatures, of all parts of the samples; and of
        each sample, its temperature and the slope (K/s). `(3, n)`."""
        truth = self._truth
        errors = dict(truth.errors)
        along = own
        if misalignment := errors.pop("misalignment", None):
            along = own + misalignment(own, felt, parts_c)
        said = sum((error(along, felt, parts_c) for error in errors.values()), start=along)
        mean = _means(along)
        added, scaled = self._noise(len(change), period_s)
        said = _means(said) + added + scaled * mean + np.array(truth.gradient)[:, None] * change
        self._loops = self._loops or [loop.begin(float(middles_c[0])) for loop in truth.loops]
        for law, loop in zip(truth.loops, self._loops, strict=True):
            said = said + loop(middles_c, period_s).T * (mean if law.of_input else 1.0)
        return said

    def _noise(self, count: int, period_s: float) -> tuple[Floats, Floats | float]:
        """The additive error and the scale-factor error of every sample: `(3, count)` each."""
        truth = self._truth
        draws = self._random.standard_normal((count, 3, 2 + len(truth.drifts))).T
        added = truth.white / period_s**0.5 * draws[0]
        if truth.walk:
            walk = self._walked + np.cumsum(truth.walk * period_s**0.5 * draws[1], axis=1)
            self._walked, added = walk[:, -1:], added + walk
        if not truth.drifts:
            return added, 0.0
        decay = np.exp(-period_s / self._taus_s)
        drifts = decayed(self._sigmas * np.sqrt(1.0 - decay**2) * draws[2:], decay, self._drifts)
        self._drifts = drifts[..., -1:]
        of_bias, of_rate = (self._gains @ drifts.reshape(len(drifts), -1)).reshape(2, 3, -1)
        return added + of_bias, of_rate


class SimulatedImu:
    """One unit on a table that others may share. `mounting`: the present one, from 0; the operator changes it.

    Its samples follow each other by its own clock; the same seed gives the same samples in blocks of any size.
    """

    def __init__(
        self,
        truth: ImuTruth,
        table: TableTruth,
        climate: ChamberPlant | UncontrolledRoom,
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
        self._climate, self._axes = climate, tuple(axes)
        # The turn from each stage to the next one.
        outer = [turn_by(table.base)]
        for lean, (axis, inner) in zip(table.orthogonality, pairwise(table.axes), strict=True):
            outer.append(turn_by(lean * np.cross(inner, axis)))
        self._stages = outer
        earth = table.earth_rate * np.array([0.0, np.cos(table.latitude), np.sin(table.latitude)])
        self._at_site = np.array([earth, [0.0, 0.0, table.gravity]])[..., None]
        random = np.random.default_rng([seed, 20263])
        self._triads: dict[Kind, _Triad] = {kind: _Triad(triad, random) for kind, triad in truth.triads.items()}
        self._die: Mass | None = None
        self.restart(start_s, sample_rate_hz)

    def restart(self, now_s: float, sample_rate_hz: float) -> None:
        """Sample at this rate of the unit's clock from now on, which runs fast by the clock error."""
        self._start_s, self.taken = now_s, 0
        self.true_period_s = 1.0 / sample_rate_hz / (1.0 + self.truth.clock_error)

    def next_time_s(self, ahead: int = 1) -> float:
        """True time at which the sample `ahead` from now is complete."""
        return self._start_s + (self.taken + ahead) * self.true_period_s

    def due(self, now_s: float) -> int:
        """The number of complete samples not yet taken."""
        return max(0, int((now_s - self._start_s) / self.true_period_s + 1e-6) - self.taken)

    def take(self, count: int) -> SensorSamples:
        """The next samples."""
        truth, period_s = self.truth, self.true_period_s
        samples = np.arange(count + 1.0)
        ends_s = self._start_s + (self.taken + samples) * period_s
        self.taken += count
        # The ends and middles of all parts.
        times_s = np.interp(np.arange(2.0 * _PARTS * count + 1.0) / (2.0 * _PARTS), samples, ends_s)
        rate, force = self._motion(times_s)
        acceleration = np.gradient(rate, period_s / _PARTS, axis=1)
        load_c = self._climate.load_at(times_s)
        parts_c, shown_c = load_c[1::2], load_c[_PARTS :: 2 * _PARTS]
        middles_c, change = shown_c, np.diff(load_c[:: 2 * _PARTS]) / period_s
        if truth.die_lag_s:
            self._die = self._die or Mass(float(parts_c[0]), truth.die_lag_s)
            parts_c = self._die.take(parts_c, period_s / _PARTS)
            middles_c = _means(parts_c)
            change = (shown_c - middles_c) / truth.die_lag_s
        absent = np.full((3, count), np.nan)
        output: dict[Kind, Floats] = {"gyro": absent, "accelerometer": absent}
        for kind, triad in self._triads.items():
            lever = np.array(truth.gyro_lever if kind == "gyro" else truth.lever)
            felt = force + _at_lever(lever, rate, acceleration)
            sensed = rate if kind == "gyro" else felt
            output[kind] = triad.output(sensed, felt, parts_c, middles_c, change, period_s)
        outputs = np.degrees(output["gyro"]).T, output["accelerometer"].T / _STANDARD_GRAVITY
        return SensorSamples(ends_s[1:], *outputs, shown_c + truth.thermometer_offset)

    def _motion(self, times_s: Floats) -> tuple[Floats, Floats]:
        """Rate against inertial space (rad/s) and specific force (m/s²) in the body, `(3, n)`, of `n` parts with their
        ends and middles."""
        lasting_s, seen = np.diff(times_s[::2]), self._at_site
        for stage, axis, plant in zip(self._stages, self.table.axes, self._axes, strict=True):
            angles = np.radians(plant.position(times_s))
            seen = _turned(stage.T @ seen, axis, -angles[1::2])
            seen[0] += np.array(axis)[:, None] * (np.diff(angles[::2]) / lasting_s)
        rate, force = self.table.mountings[self.mounting].T @ seen
        return rate, force


def _at_lever(lever: Floats, rate: Floats, acceleration: Floats) -> Floats:
    """The acceleration by rotation in the specific force: ω × (ω × r) + ω̇ × r."""
    return rate * (lever @ rate) - lever[:, None] * np.add.reduce(rate * rate) - _cross(lever) @ acceleration
