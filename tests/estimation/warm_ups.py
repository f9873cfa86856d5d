"""Simulated vehicles that warm up at rest, whose sensors err by PX4's and ArduPilot's own formulas."""

import numpy as np
from scipy.signal import lfilter

from gradcal_jax.records.log import Log

DEG_PER_H = np.radians(1.0) / 3600.0
MICRO_G = 9.80665e-6
WALK = np.radians(0.3) / 60.0  # rad/√s


def cubic(seed, sizes, about_c):
    """The biases of a triad, as a function of temperature `(n,)` that gives `(n, 3)`, SI."""
    powers = np.random.default_rng(seed).standard_normal((3, 4)) * sizes

    def bias(temperature_c):
        return np.stack([np.polynomial.polynomial.polyval(temperature_c - about_c, row) for row in powers], axis=1)

    return bias


def gyros(seed):
    """Biases of consumer gyros: some 0.5 deg/s, 0.02 deg/s/K, and curved."""
    return cubic([seed, 1], np.radians([0.5, 0.02, 2e-4, 3e-6]), 35.0)


def accelerometers(seed):
    """Some 150 µg/K, and curved."""
    return cubic([seed, 5], np.array([20000.0, 150.0, 3.0, 0.05]) * MICRO_G, 31.0)


def warming(seconds, sample_rate_hz, cold=15.0, warmer_by=35.0, time_constant_s=700.0):
    """(times, temperatures) of a vehicle that was switched on cold."""
    time = np.arange(int(seconds * sample_rate_hz)) / sample_rate_hz
    return time, cold + warmer_by * (1.0 - np.exp(-time / time_constant_s))


def output(bias, time, temperature, seed, walk=WALK, drift=8.0 * DEG_PER_H, correlation_s=300.0):
    """A triad `(n, 3)` at rest, SI: bias, white noise and a Markov process."""
    rng = np.random.default_rng([seed, 2])
    interval = time[1] - time[0]
    kept = np.exp(-interval / correlation_s)
    white = walk / np.sqrt(interval) * rng.standard_normal((len(time), 3))
    pushes = drift * np.sqrt(1 - kept**2) * rng.standard_normal((len(time), 3))
    pushes[0] = drift * rng.standard_normal(3)
    return bias(temperature) + lfilter([1.0], [1.0, -kept], pushes, axis=0) + white


def warm_up(seed, seconds=2400.0, hertz=10.0, force=False, **noise):
    """The log of a vehicle: gyros, and accelerometers in an attitude that nobody knows."""
    time, temperature = warming(seconds, hertz)
    more = {}
    if force:
        up = np.random.default_rng([seed, 6]).standard_normal(3) * 0.1 + [0.0, 0.0, 1.0]
        own = output(accelerometers(seed), time, temperature, seed + 500, 0.08 / 60.0, 100.0 * MICRO_G)
        force_m_per_s2 = 9.81 * up / np.linalg.norm(up) + own
        more = {"specific_force_m_per_s2": force_m_per_s2[None], "force_axes": ("x", "y", "z")}
        more["standstill"] = np.zeros(len(time), int)
    rates = output(gyros(seed), time, temperature, seed, **noise)
    return Log(time, rates[None], ("g",), ("x", "y", "z"), temperature[None], **more)
