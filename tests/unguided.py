"""A box on axles that a hand turns, with nothing that reads its angle: recordings by the simulator's physics.

The unit is `hardware.simulate.imu.SimulatedImu`: finite rotations, lever arms, drifts and noise of its own. Every turn
ends off the plan's angle by a draw of the standard deviation `spoilt`, takes more or less time than planned, and is
uneven; the log has rates, forces and temperature, and nothing else.
"""

import math
from dataclasses import dataclass
from typing import Any

import numpy as np

from gradcal_jax.hardware.simulate.draws import draw_table, draw_truth
from gradcal_jax.hardware.simulate.imu import SimulatedImu
from gradcal_jax.records.log import Log
from gradcal_jax.spec.spec_sections import Spec

RATE_HZ = 50.0
# Parts of a turn by which its uneven course is integrated.
_PARTS = 400
# Time to hang the unit anew, s.
_HANGS_S = 30.0


@dataclass
class UnguidedAxis:
    """Where an axis is: `position` (deg) at times, from tables of knots."""

    times: np.ndarray
    angles: np.ndarray

    def position(self, times_s: np.ndarray) -> np.ndarray:
        from scipy.interpolate import CubicHermiteSpline

        # Zero rates outside, and the rates of the knots within: the course is smooth.
        slope = np.gradient(self.angles, self.times)
        standing = (np.diff(self.angles, prepend=self.angles[0]) == 0.0) | (
            np.diff(self.angles, append=self.angles[-1]) == 0.0
        )
        return CubicHermiteSpline(self.times, self.angles, np.where(standing, 0.0, slope))(times_s)


@dataclass
class Course:
    """The die's temperature at times, °C."""

    times: np.ndarray
    values: np.ndarray

    def load_at(self, times_s: np.ndarray) -> np.ndarray:
        return np.interp(times_s, self.times, self.values)


def _turn(angle: float, uneven: float) -> np.ndarray:
    """The angles (deg) of a turn by hand at the edges of `_PARTS` equal times."""
    u = np.linspace(0.0, 1.0, _PARTS + 1)
    rate = np.sin(np.pi * u) ** 2 * (1.0 + uneven * np.sin(4.0 * np.pi * u))
    way = np.concatenate([[0.0], np.cumsum(rate[1:] + rate[:-1])])

    return angle * way / way[-1]


def course_of(spec: Spec, rng: np.random.Generator, spoilt: float):
    """Axes and mountings of the plan as a hand executes it: the axes, and for each stretch its begin and end (s)."""
    axes = len(spec.rig.table.axis)
    schedule = spec.gradient_schedule
    knots = [([-100.0], [math.degrees(schedule.start[k])]) for k in range(axes)]
    spans, now = [], 0.0
    for stretch in schedule.stretches:
        began, end = now, now + stretch.duration
        # Where the plan's angles are counted from, and by how much the hand missed them.
        meant, miss = np.degrees(np.array(schedule.start)), np.zeros(axes)
        for k in range(axes):
            # Hung anew, the box stands anywhere near.
            miss[k] = spoilt * rng.standard_normal()
            knots[k][0].extend((now - 0.5 * _HANGS_S, now))
            knots[k][1].extend((knots[k][1][-1], meant[k] + miss[k]))
        while True:
            steps = schedule.steps
            lasts = [s.move.duration * (1.0 if s.axis < 0 else 1.0 + 0.05 * rng.standard_normal()) for s in steps]
            if now + sum(lasts) > end + 1e-6:
                break
            for step, whole in zip(steps, lasts, strict=True):
                if step.axis >= 0:
                    k = step.axis
                    meant[k] += math.degrees(step.move.angle)
                    before, miss[k] = knots[k][1][-1], spoilt * rng.standard_normal()
                    # The operator's time lies before and after the turn.
                    stands = (step.move.ramp or 0.0) if step.move.shape == "hand" else 0.0
                    times = np.linspace(now + stands, now + whole - stands, _PARTS + 1)
                    way = _turn(meant[k] + miss[k] - before, 0.3 * rng.standard_normal())
                    knots[k][0].extend(times.tolist())
                    knots[k][1].extend((before + way).tolist())
                now += whole
        spans.append((began, now))
        now = end + _HANGS_S
    found = []
    for times, angles in knots:
        t, a = np.array(times), np.array(angles)
        keep = np.concatenate([[True], np.diff(t) > 1e-9])
        found.append(UnguidedAxis(np.append(t[keep], now + 100.0), np.append(a[keep], a[keep][-1])))
    return found, spans


def recorded(spec: Spec, seed: int, spoilt: float, **changes: Any) -> tuple[Log, dict[str, float]]:
    """A log of the plan without any angle, and the truth of unit and table by the names of the calibration (SI)."""
    rng = np.random.default_rng([seed, 7])
    axes, spans = course_of(spec, rng, spoilt)
    schedule = spec.gradient_schedule
    course = [(s.start, s.temperature_start) for s in schedule.segments]
    course.append((schedule.segments[-1].end, schedule.segments[-1].temperature_end))
    truth, (table, _, installation) = draw_truth(spec, seed, 1), draw_table(spec, seed)
    for name, value in changes.items():
        setattr(truth, name, value)
    rows: list[np.ndarray] = []
    hung: list[np.ndarray] = []
    # Each stretch has its own part of the course; nothing holds the temperature to it.
    times, values = [], []
    for (begin, _), stretch in zip(spans, schedule.stretches, strict=True):
        at = np.linspace(0.0, stretch.duration, 400)
        times.append(begin + at)
        values.append(np.interp(stretch.start + at, *zip(*course, strict=True)))
    at = np.concatenate(times)
    die = Course(at, np.concatenate(values) + 0.4 * np.sin(2.0 * np.pi * (at / 170.0 + 0.01 * seed)))
    unit = SimulatedImu(truth, table, die, axes, sample_rate_hz=RATE_HZ, seed=seed)  # pyright: ignore[reportArgumentType]
    starts, count = [], 0
    for number, (begin, end) in enumerate(spans):
        unit.mounting = number if len(table.mountings) > 1 else 0
        if (wait := unit.due(begin)) > 0:
            unit.take(wait)
        samples = unit.take(unit.due(end))
        starts.append(count)
        count += len(samples.time_s)
        rows.append(
            np.column_stack(
                [samples.time_s, np.radians(samples.rate_dps), samples.acceleration_g * 9.80665, samples.temperature_c]
            )
        )
        hung.append(np.full(len(samples.time_s), unit.mounting))
    of = np.concatenate(rows)
    log = Log(
        of[:, 0],
        of[None, :, 1:4],
        ("unguided",),
        ("x", "y", "z"),
        of[None, :, 7],
        mounting=np.concatenate(hung),
        stretch_starts=np.array(starts),
        specific_force_m_per_s2=of[None, :, 4:7],
        force_axes=("x", "y", "z"),
        simulated=True,
    )
    return log, truth.names | installation
