"""A gyro triad with hidden true parameters: the complete error model of the source, in NumPy.

    measured = ω + B(T) + k·dT/dt + turn-on + Σ drifts + (M(T, ω) + residual)·ω + random walks

with B and M by the shared formulas in any basis, the Gauss–Markov drifts exactly discretised, the rate the exact mean
over each sample's interval, the Earth's rate by latitude and attitude, and a sample clock of its own. Vectors: lab
frame x east, y north, z up; the table's axes outermost first, given in the lab frame at angle zero; `mounting` turns
the innermost axis' frame into the sensor's.
"""

from abc import ABC, abstractmethod
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Literal

import numpy as np
from numpy.typing import NDArray

from ... import formulas
from ..pose import turn_about
from .plants import AxisPlant, ChamberPlant

EARTH_RATE_DPS = 15.041067 / 3600.0

_BLOCK = 64

Vectors = NDArray[np.float64]
Triple = tuple[float, float, float]


@dataclass(frozen=True)
class TruthBasis:
    """Functions of a temperature (°C) or a rate (deg/s): "polynomial" (monomials), "b-spline" or "bins"."""

    kind: Literal["polynomial", "b-spline", "bins"] = "polynomial"
    degree: int = 0
    centre: float = 0.0
    scale: float = 1.0
    knots: tuple[float, ...] = ()

    def __call__(self, x: NDArray[np.float64]) -> NDArray[np.float64]:
        if self.kind == "polynomial":
            return formulas.monomials((x - self.centre) / self.scale, self.degree)
        return (
            formulas.b_spline(x, self.knots, self.degree) if self.kind == "b-spline" else formulas.bins(x, self.knots)
        )


@dataclass(frozen=True)
class Process:
    """A Gauss–Markov process of each axis; it adds `bias_gain` times itself to the rate (deg/s) and `rate_gain` times
    itself to the scale factor. An infinite `tau_s` is one draw."""

    sigma: float
    tau_s: float
    bias_gain: float = 0.0
    rate_gain: float = 0.0


class Drifts:
    """Gauss–Markov processes of three axes, advanced from sample to sample."""

    def __init__(self, processes: Sequence[Process], random: np.random.Generator) -> None:
        self._sigmas = np.array([process.sigma for process in processes])
        self._taus_s = np.array([process.tau_s for process in processes])
        self._gains = np.array([(process.bias_gain, process.rate_gain) for process in processes]).reshape(-1, 2)
        self._states = self._sigmas * random.standard_normal((3, len(processes)))
        self._period_s, self._weights = 0.0, np.zeros((0, 0, 0))

    def take(self, draws: Vectors, period_s: float) -> tuple[Vectors, Vectors]:
        """`(n, 3, k)` standard normals -> what the `k` processes add to the output and to the scale factor at the next
        samples, `(n, 3)` each."""
        if not self._sigmas.size:
            return np.zeros(draws.shape[:2]), np.zeros(draws.shape[:2])
        if period_s != self._period_s:
            self._period_s = period_s
            # `(p, block, block + 1)`: x_k = φ^(k + 1) x_0 + Σ_j φ^(k−j) w_j.
            decays, steps = np.exp(-period_s / self._taus_s), np.arange(_BLOCK, dtype=np.int64)
            lag = steps[:, None] - np.append(steps, -1)
            grown = decays[:, None, None] ** np.maximum(lag, 0)
            size = np.append(np.ones(_BLOCK), 0.0) * (self._sigmas * np.sqrt(1.0 - decays**2))[:, None]
            size[:, -1] = 1.0
            self._weights = np.where(lag >= 0, grown, 0.0) * size[:, None, :]
        # In blocks short enough for the little triangular matrices.
        values = np.empty_like(draws)
        for start in range(0, draws.shape[0], _BLOCK):
            kicks = draws[start : start + _BLOCK]
            count = len(kicks)
            known = np.concatenate([kicks, self._states[None]]).transpose(2, 0, 1)
            columns = [*range(count), -1]
            weights = self._weights[:, :count] if count == _BLOCK else self._weights[:, :count, columns]
            values[start : start + count] = (weights @ known).transpose(1, 2, 0)
            self._states = values[start + count - 1]
        return values @ self._gains[:, 0], values @ self._gains[:, 1]


@dataclass(frozen=True)
class SensorTruth:
    """The true parameters, and the noise. One row per sensor axis.

    bias_dps       (3, nT)      coefficients of B, deg/s
    scale_factor   (3, nT, nω)  coefficients of M, ratio; row index power of temperature, column power of rate

    `gradient_deg_per_k` (3,) is the bias for each K/s.
    """

    bias_dps: tuple[tuple[float, ...], ...] = ((0.0,), (0.0,), (0.0,))
    scale_factor: tuple[tuple[tuple[float, ...], ...], ...] = (((0.0,),), ((0.0,),), ((0.0,),))
    angle_random_walk_deg_sqrt_s: float = 0.0
    turn_on_dps: float = 0.0
    processes: tuple[Process, ...] = ()
    rate_random_walk_dps_sqrt_s: float = 0.0
    gradient_deg_per_k: tuple[float, float, float] = (0.0, 0.0, 0.0)
    bias_basis: TruthBasis = TruthBasis()
    temperature_basis: TruthBasis = TruthBasis()
    rate_basis: TruthBasis = TruthBasis()
    clock_error: float = 0.0


@dataclass(frozen=True)
class Mounting:
    """The mounting of the sensor on the table, and of the table in the lab."""

    axes: tuple[Triple, ...] = ((0.0, 0.0, 1.0),)
    mounting: tuple[Triple, Triple, Triple] = ((1.0, 0.0, 0.0), (0.0, 1.0, 0.0), (0.0, 0.0, 1.0))
    latitude_deg: float = 45.0
    azimuth_deg: float = 0.0
    earth_rate_dps: float = EARTH_RATE_DPS


@dataclass(frozen=True)
class SensorSamples:
    """`n` samples: mean rate as measured (deg/s), specific force (g), temperature (°C), true time of their ends."""

    time_s: NDArray[np.float64]
    rate_dps: NDArray[np.float64]
    acceleration_g: NDArray[np.float64]
    temperature_c: NDArray[np.float64]


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

    def ends_of(self, count: int) -> NDArray[np.float64]:
        """`(count + 1,)`: the true times at the ends of the next samples, which count as taken."""
        ends = self._start_s + (self.taken + np.arange(count + 1.0)) * self.true_period_s
        self.taken += count
        return ends

    @abstractmethod
    def take(self, count: int) -> SensorSamples:
        """The next samples."""


class SimulatedSensor(SampledSensor):
    """Three gyros on their table."""

    def __init__(
        self,
        truth: SensorTruth,
        mounting: Mounting,
        chamber: ChamberPlant,
        axes: Sequence[AxisPlant],
        *,
        sample_rate_hz: float,
        seed: int,
        start_s: float = 0.0,
    ) -> None:
        if len(axes) != len(mounting.axes):
            raise ValueError(f"{len(mounting.axes)} axes are mounted and {len(axes)} given; give as many.")
        self.truth = truth
        self.clock_error = truth.clock_error
        self._mounting = mounting
        self._chamber, self._axes = chamber, tuple(axes)
        self._bias, self._scale = np.array(truth.bias_dps), np.array(truth.scale_factor)
        self._random = np.random.default_rng(seed)
        self._walked = np.zeros(3)
        self.restart(start_s, sample_rate_hz)
        self._drifts = Drifts(truth.processes, self._random)
        self.turn_on_dps = truth.turn_on_dps * self._random.standard_normal(3)

    def take(self, count: int) -> SensorSamples:
        truth = self.truth
        ends = self.ends_of(count)
        middles = (ends[1:] + ends[:-1]) / 2.0
        rates, up = self._motion(ends, middles)
        temperature = self._chamber.load_at(middles) if count else np.zeros(0)
        processes = len(truth.processes)
        # Four of the draws have no use; without them a seed would give other samples than it did.
        draws = self._random.standard_normal((count, 7 + 3 * processes))
        drift, unsteady = self._drifts.take(draws[:, 7:].reshape(count, 3, processes), self.true_period_s)
        bias = truth.bias_basis(temperature) @ self._bias.T + self.turn_on_dps + drift
        if any(truth.gradient_deg_per_k) and count:
            change = np.diff(self._chamber.load_at(ends)) / self.true_period_s
            bias = bias + change[:, None] * np.array(truth.gradient_deg_per_k)
        if truth.rate_random_walk_dps_sqrt_s:
            kick = truth.rate_random_walk_dps_sqrt_s * self.true_period_s**0.5
            walked = self._walked + np.cumsum(kick * self._random.standard_normal((count, 3)), axis=0)
            bias = bias + walked
            self._walked = walked[-1] if count else self._walked
        factor = formulas.scale_factor_map(
            truth.temperature_basis(temperature)[:, None, None, :], truth.rate_basis(rates)[:, :, None, :], self._scale
        )[..., 0]
        factor = factor + unsteady
        walk = truth.angle_random_walk_deg_sqrt_s / self.true_period_s**0.5 * draws[:, :3]
        error = bias + factor * rates + walk
        return SensorSamples(ends[1:], rates + error, up, temperature)

    def _motion(self, ends: NDArray[np.float64], middles: NDArray[np.float64]) -> tuple[Vectors, Vectors]:
        """Mean inertial rate (deg/s) and up-vector in the sensor's frame, `(n, 3)` each."""
        latitude, azimuth = np.radians(self._mounting.latitude_deg), np.radians(self._mounting.azimuth_deg)
        north = np.cos(latitude) * np.array([np.sin(azimuth), np.cos(azimuth), 0.0])
        fixed = np.zeros((3, middles.size, 3))
        earth, up, turning = fixed
        earth[:] = self._mounting.earth_rate_dps * (north + np.array([0.0, 0.0, np.sin(latitude)]))
        up[:, 2] = 1.0
        for direction, plant in zip(self._mounting.axes, self._axes, strict=True):
            axis = np.array(direction)
            # Vectors of the outer frame, in the frame that the axis carries.
            fixed = np.einsum("kni,nij->knj", fixed, turn_about(axis, np.radians(plant.position(middles))))
            earth, up, turning = fixed
            turning += np.diff(plant.position(ends))[:, None] / self.true_period_s * axis
        matrix = np.array(self._mounting.mounting)
        return (turning + earth) @ matrix.T, up @ matrix.T
