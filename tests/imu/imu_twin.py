"""A unit on a real table, simulated from physics, for proofs of the estimate: shares no code and no column with it.

Attitude is a product of rotations with the base, the axes, the encoders and the mounting finitely off; every sample
is the mean of what the channel says within its interval (three Gauss–Legendre points). What a channel says is written
out from the names of the calibration's coefficients, as the projection on its own axis and then what the sensor makes
of it. Accelerometers sit off the axes and feel it.
"""

from typing import NamedTuple

import numpy as np
from scipy.signal import lfilter
from scipy.spatial.transform import Rotation

from gradcal_jax.records.log import Log

OMEGA = 7.292115e-5
HZ = 50.0
_X, _W = np.polynomial.legendre.leggauss(3)
_X, _W = 0.5 * (_X + 1.0), 0.5 * _W


class Leg(NamedTuple):
    """A rest (`axis` −1) or a turn of one axis with cosine ramps (s, rad), which `stands` before and after (a hand)."""

    axis: int
    duration: float
    angle: float = 0.0
    ramp: float = 1e-6
    stands: float = 0.0


class Course:
    """Legs at times `(n,)`: the number of the leg, the share of it that is turned, and how fast that grows."""

    def __init__(self, legs: list[Leg], t: np.ndarray) -> None:
        _, duration, _, ramp, stands = np.array(legs).T
        edges = np.concatenate([[0.0], np.cumsum(duration)])
        self.number = k = np.clip(np.searchsorted(edges, t, side="right") - 1, 0, len(legs) - 1)
        ramp, lasts = ramp[k], (duration - 2.0 * stands)[k]
        since = np.clip(t - edges[k] - stands[k], 0.0, lasts)
        near = np.minimum(since, lasts - since)
        x, pace = np.minimum(near, ramp), 1.0 / (lasts - ramp)
        part = pace * (0.5 * (x - ramp / np.pi * np.sin(np.pi * x / ramp)) + near - x)
        self.share = np.where(since > 0.5 * lasts, 1.0 - part, part)
        self.pace = 0.5 * pace * (1.0 - np.cos(np.pi * x / ramp))

    def along(self, points: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """What has these values before each leg and after the last, `(K + 1, L)`, and its rate: `(n, L)`."""
        change = np.diff(points, axis=0)[self.number]
        return points[self.number] + self.share[:, None] * change, self.pace[:, None] * change


def angles_of(legs: list[Leg], start) -> np.ndarray:
    """Angles of the axes before each leg and after the last."""
    turned = [[leg.angle * (leg.axis == l) for l in range(len(start))] for leg in legs]
    return np.cumsum([np.array(start, float), *turned], axis=0)


def record(
    spec,
    truth: dict[str, float],
    rng: np.random.Generator,
    name: str = "SN7",
    *,
    lever: tuple[float, float, float] = (0.03, -0.02, 0.01),
    offset: float | None = None,
    table_rng: np.random.Generator | None = None,
    punctual: bool = False,
) -> list[Log]:
    """What a logger keeps of a spec's plan: a log for each stretch of used data, so for each mounting. `truth`: errors
    by the names of the calibration's coefficients (SI).

    `lever` (m): how far off the axes the unit is; `offset` (rad): of all encoders, in the place of the spec's.
    `table_rng` draws the encoders' errors, in the place of `rng`: for several IMUs on one table. `punctual`: encoders
    are read when they are due, at both ends of a standstill too; otherwise in equal parts of it, the last of which ends
    with it.
    """
    schedule, table, sensor = spec.schedule, spec.rig.table, spec.sensor
    logs = []
    names, triads = tuple(axis.name for axis in table.axis), (sensor.gyro, sensor.accelerometer)
    white = float(sensor.gyro.angle_random_walk), float(sensor.accelerometer.velocity_random_walk)
    segments = schedule.segments
    times = [segments[0].start, *(s.start + s.duration for s in segments)]
    course = [segments[0].temperature_start, *(s.temperature_end for s in segments)]
    for k, stretch in enumerate(schedule.stretches):
        legs = [_leg(step) for step in schedule.steps] * stretch.cycles
        legs += [Leg(-1, stretch.leftover)] * (stretch.leftover > 0.0)
        count = int(sum(leg.duration for leg in legs) * HZ)
        time = np.arange(count + 1) / HZ
        nodes = (time[:-1, None] + _X / HZ).ravel()
        within, ends = (np.interp(stretch.start + at, times, course) for at in (nodes, time[1:]))
        draws, readings = _encoders(table, legs, schedule.start, time[1:], table_rng or rng, offset, punctual=punctual)
        mounting = min(k, len(table.mounting) - 1)
        omega, force = _felt(spec, truth, legs, nodes, draws, mounting, np.array(lever))
        warm, pace = (within - 20.0) / 50.0, float(sensor.gyro.scale_factor.rate.scale)
        said = said_by(truth, "gyro", omega, force, warm, pace), said_by(truth, "accelerometer", force, force, warm)
        clock, found = 1.0 + truth.get("sample_clock", 0.0), []
        for values, triad, noise in zip(said, triads, white, strict=True):
            mean = np.tensordot(values.reshape(count, 3, 3), _W, (1, 0)) * clock
            mean += noise * np.sqrt(HZ) * rng.standard_normal(mean.shape)
            for process in triad.drift:
                mean += _markov(float(process.standard_deviation), float(process.correlation_time), mean.shape, rng)
            found.append(mean[None])
        turning = Course(legs, time[1:] - 0.5 / HZ).along(angles_of(legs, schedule.start))[1]
        standing = ~np.any(turning != 0.0, axis=1)
        number = np.where(standing, np.cumsum(np.diff(standing, prepend=False) & standing) - 1, -1)
        logs.append(
            Log(
                time[1:], found[0], (name,), tuple("xyz"), ends[None], names, readings, None, number,
                specific_force_m_per_s2=found[1], force_axes=tuple("xyz"), simulated=True,
            )
        )  # fmt: skip
    return logs


def _leg(step) -> Leg:
    """Of a step of a plan: a hand turns by a raised cosine, whatever the plan calls it."""
    move = step.move
    if step.axis < 0:
        return Leg(-1, move.duration)
    hand = move.shape == "hand"
    ramp, stands = (0.5 * move.duration - move.ramp, move.ramp) if hand else (move.ramp, 0.0)
    return Leg(step.axis, move.duration, move.angle, ramp, stands)


def _felt(spec, truth, legs, nodes, draws, mounting: int, lever) -> tuple[np.ndarray, np.ndarray]:
    """Rate and specific force in the body, `(n, 3)`."""
    table, site = spec.rig.table, spec.rig.site
    course = Course(legs, nodes)
    angles, rates = course.along(angles_of(legs, spec.schedule.start))
    # An axis stands beyond its encoder's angle by what repeats, and by the draw of its standstill, which goes over to
    # the next in proportion to the angle turned.
    true, pace = (of + error for of, error in zip((angles, rates), course.along(draws), strict=True))
    for l, axis in enumerate(table.axis):
        for key, value in truth.items():
            head, _, wave = key.rpartition("_")
            if head == f"angle_{axis.name}":
                order, phase = int(wave[3:]), 0.0 if wave.startswith("cos") else -0.5 * np.pi
                true[:, l] += value * np.cos(order * angles[:, l] + phase)
                pace[:, l] -= value * order * np.sin(order * angles[:, l] + phase) * rates[:, l]
    of_vector = Rotation.from_rotvec
    stage, outward = of_vector([truth.get(k, 0.0) for k in ("tilt_east", "tilt_north", "azimuth")]), []
    for l, axis in enumerate(table.axis):
        own = np.array(axis.unit_vector)
        outward.append((stage, own))
        stage = stage * of_vector(true[:, l, None] * own)
        for inner in table.axis[l + 1 : l + 2]:
            delta = truth.get(f"orthogonality_{axis.name}_{inner.name}", 0.0)
            stage = stage * of_vector(delta * np.cross(inner.unit_vector, own))
    stage = stage * Rotation.from_matrix(np.array(table.mounting[mounting].columns).T)
    into_body = (stage * of_vector([truth.get(f"mounting{mounting + 1}_{a}", 0.0) for a in "xyz"])).inv()
    latitude = float(site.latitude)
    omega = into_body.apply(OMEGA * np.array([0.0, np.cos(latitude), np.sin(latitude)]))
    for l, (outer, own) in enumerate(outward):
        omega = omega + (into_body * outer).apply(own) * pace[:, l : l + 1]
    force = into_body.apply([0.0, 0.0, float(site.gravity) + truth.get("gravity", 0.0)])
    return omega, force + np.cross(omega, np.cross(omega, lever)) + np.cross(np.gradient(omega, nodes, axis=0), lever)


def said_by(truth, kind: str, vector, force, warm, pace: float = 1.0) -> np.ndarray:
    """What three gyros or accelerometers say of the rate or the force `vector` `(n, 3)`, by the names of their
    coefficients: each leans towards the others, and multiplies what is along its own axis."""

    def of_axis(i: int) -> np.ndarray:
        own = [(k.partition(".")[2], value) for k, value in truth.items() if k.startswith(f"{kind}_{'xyz'[i]}.")]
        along = vector[:, i].copy()
        for symbol, value in own:
            if symbol[0] == "m":
                along += value * warm ** int(symbol[3:] or 0) * vector[:, "xyz".index(symbol[2])]

        def factor(symbol: str):
            match symbol[0]:
                case "m":
                    return 0.0
                case "a":
                    return warm ** int(symbol[1:] or 0)
                case "b":
                    return (along / pace) ** int(symbol[1]) * warm ** int(symbol[2]) * along
                case "s":
                    return warm ** int(symbol[1:] or 0) * along
                case "g":
                    return warm ** int(symbol[3:] or 0) * force[:, "xyz".index(symbol[2])]
                case "k":
                    return along**2
            raise KeyError(symbol)

        return along + sum(value * factor(symbol) for symbol, value in own)

    return np.stack([of_axis(i) for i in range(3)], axis=1)


def _markov(sigma: float, tau: float, shape, rng) -> np.ndarray:
    """Stationary first-order Gauss–Markov samples."""
    keep = np.exp(-1.0 / (HZ * tau))
    kicks = sigma * np.sqrt(1.0 - keep**2) * rng.standard_normal(shape)
    kicks[0] = sigma * rng.standard_normal(shape[1:])
    return lfilter([1.0], [1.0, -keep], kicks, axis=0)


def _encoders(table, legs, start, time, rng, offset, *, punctual: bool) -> tuple[np.ndarray, np.ndarray]:
    """How far beyond its mean reading each axis stands before each leg and after the last; and the readings at each
    sample: one each `read_every`, held until the next, as slow encoders are logged."""
    angles, _ = Course(legs, time).along(angles_of(legs, start))
    edges = np.concatenate([[0.0], np.cumsum([leg.duration for leg in legs])])
    draws = np.zeros((len(edges), len(table.axis)))
    for l, axis in enumerate(table.axis):
        own, of = np.flatnonzero([leg.axis == l for leg in legs]), axis.angle
        for begin, end in zip([0, *own + 1], [*own, len(legs)], strict=True):
            std = float(of.standstill_offset) if offset is None else offset
            draws[begin : end + 1, l] = std * rng.standard_normal()
            rows = slice(*np.searchsorted(time, edges[[begin, end]] + [-1e-9, 1e-9]))
            lasts, every = edges[end] - edges[begin], float(of.read_every)
            count = int(np.floor(lasts / every + 1e-9)) + 1
            if rows.stop > rows.start:
                noise = float(of.reading_noise) * rng.standard_normal(count)
                part = every if punctual else lasts / count
                held = np.floor((time[rows] - edges[begin]) / part + 1e-9).astype(int)
                held[-1] = count - 1 if punctual else held[-1]
                angles[rows, l] += noise[np.clip(held, 0, count - 1)]
    return draws, angles
