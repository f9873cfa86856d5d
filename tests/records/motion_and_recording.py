"""A table's motion, what is read of it, and what a unit with a logger of its own records: for tests of alignment alone.

Trapezoids in closed form; nothing of it is the package's.
"""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

Floats = NDArray[np.float64]


@dataclass(frozen=True)
class Motion:
    """Knots of piecewise constant acceleration: times, s, angles, deg, rates, deg/s."""

    time_s: Floats
    angle_deg: Floats
    rate_dps: Floats

    def at(self, times_s: Floats) -> tuple[Floats, Floats]:
        row = np.clip(np.searchsorted(self.time_s, times_s, side="right") - 1, 0, len(self.time_s) - 2)
        width = self.time_s[row + 1] - self.time_s[row]
        slope = (self.rate_dps[row + 1] - self.rate_dps[row]) / width
        after = np.clip(times_s - self.time_s[row], 0.0, width)
        angle = self.angle_deg[row] + after * (self.rate_dps[row] + 0.5 * slope * after)
        return angle, self.rate_dps[row] + slope * after


def turns(random: np.random.Generator, cycles: int, *, alike: bool = False) -> Motion:
    """Cycles of turns and rests from 100 s on, each cycle the same where `alike`, with waits between them where not."""
    plan = [(random.choice([-360.0, 360.0, 720.0, -720.0]), random.uniform(40.0, 200.0)) for _ in range(4)]
    knots = [(0.0, 0.0, 0.0), (100.0, 0.0, 0.0)]

    def rest(duration_s: float) -> None:
        time_s, angle, _ = knots[-1]
        knots.append((time_s + duration_s, angle, 0.0))

    for _ in range(cycles):
        for way, rate in plan:
            time_s, angle, _ = knots[-1]
            ramp_s = rate / 200.0
            cruise_s = abs(way) / rate - ramp_s
            sign = np.sign(way)
            knots.append((time_s + ramp_s, angle + sign * 0.5 * rate * ramp_s, sign * rate))
            knots.append((time_s + ramp_s + cruise_s, angle + way - sign * 0.5 * rate * ramp_s, sign * rate))
            knots.append((time_s + 2.0 * ramp_s + cruise_s, angle + way, 0.0))
            rest(5.0)
        rest(30.0 if alike else random.uniform(20.0, 60.0))
    rest(100.0)
    return Motion(*np.array(knots).T)


@dataclass(frozen=True)
class Recorded:
    """What the tests know of a recording: its rows, and the truth of its clock."""

    time_s: Floats
    rate_dps: Floats
    offset_s: float
    rate: float

    def host_s(self, recorded_s: Floats | float) -> Floats | float:
        return self.offset_s + self.rate * recorded_s


def readings(random: np.random.Generator, motion: Motion) -> tuple[Floats, Floats]:
    """Once a second, 30 arcsec of noise, and at times that are known to a millisecond."""
    told = np.arange(10.0, motion.time_s[-1] - 10.0) + random.uniform(0.0, 0.05)
    angle, _ = motion.at(told + 1e-3 * random.standard_normal(len(told)))
    return told, angle + 30.0 / 3600.0 * random.standard_normal(len(told))


def recording(
    random: np.random.Generator, motion: Motion, begins_s: float, ends_s: float | None = None, ppm: float = 50.0
) -> Recorded:
    """100 Hz from one of the run's times to another or its end: bias, its drift, a scale factor, 0.15 deg/√h."""
    ends_s = float(motion.time_s[-1]) if ends_s is None else ends_s
    rate = 1.0 + 1e-6 * ppm
    began = random.uniform(0.0, 1e5)
    count = int((ends_s - begins_s) * 100.0)
    time_s = began + np.arange(count) / 100.0
    offset_s = begins_s - rate * began
    _, true = motion.at(offset_s + rate * time_s)
    drift = 1e-5 * np.cumsum(random.standard_normal(count)) / 10.0
    noise = 0.15 / 60.0 * 10.0 * random.standard_normal(count)
    return Recorded(time_s, (1.0005 * rate * true + 0.02 + drift + noise)[:, None], offset_s, rate)
