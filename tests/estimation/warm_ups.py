"""Simulated vehicles that warm up at rest, whose gyros err by PX4's and ArduPilot's own formulas."""

from dataclasses import dataclass

import numpy as np
from scipy.signal import lfilter

DEG_PER_H = np.radians(1.0) / 3600.0


@dataclass(frozen=True)
class Vehicle:
    """`bias` `(3, 4)`: powers 0 to 3 of (T − 35 °C), rad/s, of each axis. Noise: N in rad/√s, one Markov process."""

    bias: np.ndarray
    angle_random_walk: float = np.radians(0.3) / 60.0
    drift_std: float = 8.0 * DEG_PER_H
    correlation_time_s: float = 300.0

    def true_bias(self, temperature_c):
        """`(n, 3)`, rad/s."""
        return np.stack([np.polynomial.polynomial.polyval(temperature_c - 35.0, b) for b in self.bias], axis=1)


def vehicle(seed, **noise):
    """Biases of consumer gyros: some 0.5 deg/s, 0.02 deg/s/K, and curved."""
    sizes = np.radians([0.5, 0.02, 2e-4, 3e-6])
    return Vehicle(np.random.default_rng([seed, 1]).standard_normal((3, 4)) * sizes, **noise)


def warming(seconds, sample_rate_hz, cold=15.0, warmer_by=35.0, time_constant_s=700.0):
    """(times, temperatures) of a vehicle that was switched on cold."""
    time = np.arange(int(seconds * sample_rate_hz)) / sample_rate_hz
    return time, cold + warmer_by * (1.0 - np.exp(-time / time_constant_s))


def output(unit, time, temperature, seed):
    """Raw rates `(n, 3)` at rest, rad/s."""
    rng = np.random.default_rng([seed, 2])
    interval = time[1] - time[0]
    kept = np.exp(-interval / unit.correlation_time_s)
    pushes = unit.drift_std * np.sqrt(1 - kept**2) * rng.standard_normal((len(time), 3))
    pushes[0] = unit.drift_std * rng.standard_normal(3)
    drift = lfilter([1.0], [1.0, -kept], pushes, axis=0)
    white = unit.angle_random_walk / np.sqrt(interval) * rng.standard_normal((len(time), 3))
    return unit.true_bias(temperature) + drift + white
