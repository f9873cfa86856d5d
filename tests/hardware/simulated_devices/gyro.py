"""A gyro triad with hidden true parameters, of which the tests know all: the complete error model of the source.

    measured = ω + B(T) + k·dT/dt + turn-on + Σ drifts + (M(T, ω) + residual)·ω + random walks

The rate is the exact mean over each sample's interval. Vectors: lab frame x east, y north, z up; the table's axes
outermost first, given in the lab frame at angle zero; `mounting` turns the innermost axis' frame into the sensor's.
"""

from collections.abc import Sequence
from dataclasses import dataclass, field

import numpy as np
from numpy.typing import NDArray

from gradcal_jax.hardware.simulate.imu import Drifts, Process, SampledSensor, SensorSamples, Vectors, turn_about
from gradcal_jax.hardware.simulate.plants import AxisPlant, ChamberPlant

EARTH_RATE_DPS = 15.041067 / 3600.0
Triple = tuple[float, float, float]


@dataclass(frozen=True)
class Powers:
    """Powers of (x - centre)/scale, of a temperature (°C) or a rate (deg/s)."""

    degree: int = 0
    centre: float = 0.0
    scale: float = 1.0

    def __call__(self, x: Vectors) -> Vectors:
        return ((x - self.centre) / self.scale)[..., None] ** np.arange(self.degree + 1)


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
    bias_basis: Powers = field(default_factory=Powers)
    temperature_basis: Powers = field(default_factory=Powers)
    rate_basis: Powers = field(default_factory=Powers)
    clock_error: float = 0.0


@dataclass(frozen=True)
class Mounting:
    """The mounting of the sensor on the table, and of the table in the lab."""

    axes: tuple[Triple, ...] = ((0.0, 0.0, 1.0),)
    mounting: tuple[Triple, Triple, Triple] = ((1.0, 0.0, 0.0), (0.0, 1.0, 0.0), (0.0, 0.0, 1.0))
    latitude_deg: float = 45.0
    azimuth_deg: float = 0.0
    earth_rate_dps: float = EARTH_RATE_DPS


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
        factor = unsteady + np.einsum(
            "nt,atr,nar->na", truth.temperature_basis(temperature), self._scale, truth.rate_basis(rates)
        )
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
