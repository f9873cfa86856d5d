"""A box on axles that a hand turns, with nothing that reads its angle: recordings by the simulator's physics.

The unit is `hardware.simulate.imu.SimulatedImu`: finite rotations, lever arms, drifts and noise of its own. Every turn
ends off the plan's angle by a draw of the standard deviation `spoilt`, takes more or less time than planned, and is
uneven; the log has rates, forces and temperature, and nothing else.
"""

import math
from types import SimpleNamespace
from typing import Any

import numpy as np
from scipy.interpolate import PchipInterpolator

from gradcal_jax.hardware.simulate.draws import draw_table, draw_truth
from gradcal_jax.hardware.simulate.imu import SimulatedImu
from gradcal_jax.records.log import Log
from gradcal_jax.spec.spec_sections import Spec

RATE_HZ = 50.0
# Parts of a turn by which its uneven course is integrated.
_PARTS = 400
# Time to hang the unit anew, s.
_HANGS_S = 30.0


def _turn(angle: float, uneven: float) -> np.ndarray:
    """The angles (deg) of a turn by hand at the edges of `_PARTS` equal times."""
    u = np.linspace(0.0, 1.0, _PARTS + 1)
    rate = np.sin(np.pi * u) ** 2 * (1.0 + uneven * np.sin(4.0 * np.pi * u))
    way = np.concatenate([[0.0], np.cumsum(rate[1:] + rate[:-1])])

    return angle * way / way[-1]


def course_of(spec: Spec, rng: np.random.Generator, spoilt: float):
    """Axes of the plan as a hand turns them, each with its `position` (deg) at times; and for each stretch its begin
    and end (s)."""
    schedule = spec.gradient_schedule
    starts = np.degrees(np.array(schedule.start))
    times, angles = [[-100.0] for _ in starts], [[start] for start in starts.tolist()]
    spans, now = [], 0.0
    for stretch in schedule.stretches:
        began, end = now, now + stretch.duration
        # Where the plan's angles are; hung anew, the box stands anywhere near.
        meant = starts.copy()
        for k, start in enumerate(starts):
            times[k] += [now - 0.5 * _HANGS_S, now]
            angles[k] += [angles[k][-1], start + spoilt * rng.standard_normal()]
        while True:
            steps = schedule.steps
            lasts = [s.move.duration * (1.0 if s.axis < 0 else 1.0 + 0.05 * rng.standard_normal()) for s in steps]
            if now + sum(lasts) > end + 1e-6:
                break
            for step, whole in zip(steps, lasts, strict=True):
                if step.axis >= 0:
                    k = step.axis
                    meant[k] += math.degrees(step.move.angle)
                    before, goal = angles[k][-1], meant[k] + spoilt * rng.standard_normal()
                    # The operator's time lies before and after the turn.
                    stands = (step.move.ramp or 0.0) if step.move.shape == "hand" else 0.0
                    times[k] += np.linspace(now + stands, now + whole - stands, _PARTS + 1).tolist()
                    angles[k] += (before + _turn(goal - before, 0.3 * rng.standard_normal())).tolist()
                now += whole
        spans.append((began, now))
        now = end + _HANGS_S
    found = []
    for t, a in zip(times, angles, strict=True):
        keep = np.concatenate([[True], np.diff(t) > 1e-9])
        course = PchipInterpolator(np.append(np.array(t)[keep], now + 100.0), np.append(np.array(a)[keep], a[-1]))
        found.append(SimpleNamespace(position=course))
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
    # Each stretch has its own part of the course; nothing holds the temperature to it.
    times, values = [], []
    for (begin, _), stretch in zip(spans, schedule.stretches, strict=True):
        at = np.linspace(0.0, stretch.duration, 400)
        times.append(begin + at)
        values.append(np.interp(stretch.start + at, *zip(*course, strict=True)))
    at = np.concatenate(times)
    values = np.concatenate(values) + 0.4 * np.sin(2.0 * np.pi * (at / 170.0 + 0.01 * seed))
    die = SimpleNamespace(load_at=lambda t: np.interp(t, at, values))
    unit = SimulatedImu(truth, table, die, axes, sample_rate_hz=RATE_HZ, seed=seed)  # pyright: ignore[reportArgumentType]
    rows, hung = list[np.ndarray](), list[int]()
    for number, (begin, end) in enumerate(spans):
        unit.mounting = number if len(table.mountings) > 1 else 0
        if (wait := unit.due(begin)) > 0:
            unit.take(wait)
        samples = unit.take(unit.due(end))
        force = samples.acceleration_g * 9.80665
        rows.append(np.column_stack([samples.time_s, np.radians(samples.rate_dps), force, samples.temperature_c]))
        hung.append(unit.mounting)
    counts = [len(part) for part in rows]
    of = np.concatenate(rows)
    log = Log(
        of[:, 0],
        of[None, :, 1:4],
        ("unguided",),
        ("x", "y", "z"),
        of[None, :, 7],
        mounting=np.repeat(hung, counts),
        stretch_starts=np.cumsum([0, *counts[:-1]]),
        specific_force_m_per_s2=of[None, :, 4:7],
        force_axes=("x", "y", "z"),
        simulated=True,
    )
    return log, truth.names | installation
