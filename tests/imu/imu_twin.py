"""A unit on a real table, simulated from physics, for proofs of the estimate: shares no code and no column with it.

Attitude is a product of rotations with the base, the axes, the encoders and the mounting finitely off; every sample
is the mean of what the channel says within its interval (three Gauss–Legendre points). What a channel says is written
out from the names of the calibration's coefficients, as the projection on its own axis and then what the sensor makes
of it. Accelerometers sit off the axes and feel it.
"""

from dataclasses import dataclass, replace

import numpy as np
from scipy.signal import lfilter
from scipy.spatial.transform import Rotation

OMEGA = 7.292115e-5
_X, _W = np.polynomial.legendre.leggauss(3)
_X, _W = 0.5 * (_X + 1.0), 0.5 * _W


@dataclass(frozen=True)
class Leg:
    """A rest (`axis` −1) or a turn of one axis with cosine ramps (rad, rad/s, s)."""

    axis: int
    duration: float
    angle: float = 0.0
    peak: float = 0.0
    ramp: float = 0.0
    stands: float = 0.0  # before and after a turn by hand


@dataclass(frozen=True)
class Bench:
    """Table, site and noise, SI. `axes` outermost first, `mounting` body to the innermost axis. `drift`: (σ, τ) and
    `white` by kind. `offset`, `reading`, `every`: of each axis's encoder; `centre`, `scale`, `pace`: of the maps.
    """

    axes: tuple[np.ndarray, ...]
    mounting: np.ndarray
    latitude: float
    gravity: float
    white: dict[str, float]
    drift: dict[str, tuple[float, float]]
    offset: tuple[float, ...]
    reading: tuple[float, ...]
    every: tuple[float, ...]
    centre: float = 20.0
    scale: float = 50.0
    pace: float = np.radians(300.0)
    lever: tuple[float, float, float] = (0.03, -0.02, 0.01)


@dataclass
class Recorded:
    """What a logger keeps: times of samples, their means, temperature, the table's readings, and who stands."""

    time: np.ndarray
    rate: np.ndarray
    force: np.ndarray
    temperature: np.ndarray
    angles: np.ndarray
    standing: np.ndarray


def commanded(legs: list[Leg], start, t: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Angles and rates `(n, L)` of the axes at times, and the number of the leg."""
    edges = np.concatenate([[0.0], np.cumsum([leg.duration for leg in legs])])
    number = np.clip(np.searchsorted(edges, t, side="right") - 1, 0, len(legs) - 1)
    angles, rates = np.zeros((len(t), len(start))), np.zeros((len(t), len(start)))
    here = np.array(start, float)
    for k, leg in enumerate(legs):
        rows = slice(*np.searchsorted(number, [k, k + 1]))
        angles[rows] = here
        if leg.axis >= 0:
            since = t[rows] - edges[k]
            angles[rows, leg.axis] += turned(leg, since)
            rates[rows, leg.axis] = speed(leg, since)
            here[leg.axis] += leg.angle
    return angles, rates, number


def turned(leg: Leg, t: np.ndarray) -> np.ndarray:
    if leg.ramp == 0.0:  # a hand: a raised cosine, whatever the plan calls it
        lasts = leg.duration - 2.0 * leg.stands
        share = np.clip(t - leg.stands, 0.0, lasts) / lasts
        return leg.angle * (share - np.sin(2.0 * np.pi * share) / (2.0 * np.pi))

    def up(x):
        return 0.5 * leg.peak * (x - leg.ramp / np.pi * np.sin(np.pi * x / leg.ramp))

    middle = leg.peak * (t - 0.5 * leg.ramp)
    last = leg.angle - up(np.clip(leg.duration - t, 0.0, leg.ramp))
    return np.where(t < leg.ramp, up(np.clip(t, 0.0, leg.ramp)), np.where(t > leg.duration - leg.ramp, last, middle))


def speed(leg: Leg, t: np.ndarray) -> np.ndarray:
    if leg.ramp == 0.0:
        lasts = leg.duration - 2.0 * leg.stands
        return leg.angle / lasts * (1.0 - np.cos(2.0 * np.pi * np.clip(t - leg.stands, 0.0, lasts) / lasts))
    near = np.clip(np.minimum(t, leg.duration - t), 0.0, leg.ramp)
    return 0.5 * leg.peak * (1.0 - np.cos(np.pi * near / leg.ramp))


def record(
    bench: Bench,
    legs: list[Leg],
    start,
    truth: dict[str, float],
    temperature_of,
    rng: np.random.Generator,
    *,
    rate_hz: float = 50.0,
    noisy: bool = True,
    names: tuple[str, ...] = (),
    number: int = 1,
    table_rng: np.random.Generator | None = None,
    punctual: bool = False,
) -> Recorded:
    """A recording of one unit whose errors are `truth`, by the names of the calibration's coefficients (SI).

    `temperature_of(t)` °C. `names`: of the axes, for the installation's errors; `number`: of the mounting.
    `table_rng` draws the encoders' errors, in the place of `rng`: for several IMUs on one table. `punctual`: encoders
    are read when they are due, at both ends of a standstill too; otherwise in equal parts of it, the last of which ends
    with it.
    """
    whole = sum(leg.duration for leg in legs)
    count = int(whole * rate_hz)
    time = (np.arange(count + 1)) / rate_hz
    dt = 1.0 / rate_hz
    nodes = (time[:-1, None] + dt * _X).ravel()
    angles, rates, leg_of = commanded(legs, start, nodes)
    draws, readings = _encoders(bench, legs, start, time, (table_rng or rng) if noisy else None, punctual=punctual)
    # An axis stands beyond its encoder's angle by what repeats, and by the draw of its standstill.
    true, pace = angles.copy(), rates.copy()
    for l in range(len(bench.axes)):
        for key, value in truth.items():
            head, _, wave = key.rpartition("_")
            if names and head == f"angle_{names[l]}":
                order = int(wave[3:])
                f, g = (np.cos, lambda x: -np.sin(x)) if wave.startswith("cos") else (np.sin, np.cos)
                true[:, l] += value * f(order * angles[:, l])
                pace[:, l] += value * order * g(order * angles[:, l]) * rates[:, l]
        extra, slope = _slow(draws[l], legs, l, leg_of, angles[:, l], rates[:, l], start)
        true[:, l] += extra
        pace[:, l] += slope
    of_vector = Rotation.from_rotvec
    stage, outward = of_vector([truth.get(k, 0.0) for k in ("tilt_east", "tilt_north", "azimuth")]), []
    for l, axis in enumerate(bench.axes):
        outward.append(stage)
        stage = stage * of_vector(true[:, l, None] * axis)
        if l + 1 < len(bench.axes) and names:
            delta = truth.get(f"orthogonality_{names[l]}_{names[l + 1]}", 0.0)
            stage = stage * of_vector(delta * np.cross(bench.axes[l + 1], axis))
    stage = stage * Rotation.from_matrix(bench.mounting)
    into_body = (stage * of_vector([truth.get(f"mounting{number}_{a}", 0.0) for a in "xyz"])).inv()
    omega = into_body.apply(OMEGA * np.array([0.0, np.cos(bench.latitude), np.sin(bench.latitude)]))
    for l, axis in enumerate(bench.axes):
        omega = omega + (into_body * outward[l]).apply(axis) * pace[:, l : l + 1]
    force = into_body.apply([0.0, 0.0, bench.gravity + truth.get("gravity", 0.0)])
    lever = np.array(bench.lever)
    force = force + np.cross(omega, np.cross(omega, lever)) + np.cross(np.gradient(omega, nodes, axis=0), lever)
    warm = (temperature_of(nodes) - bench.centre) / bench.scale
    clock = 1.0 + truth.get("sample_clock", 0.0)
    mean = lambda x: (x.reshape(count, 3) @ _W) * clock  # noqa: E731
    rate, felt = (
        np.stack([mean(said_by(truth, kind, a, vector, force, warm, bench.pace)) for a in range(3)], axis=1)
        for kind, vector in (("gyro", omega), ("accelerometer", force))
    )
    if noisy:
        for values, kind in ((rate, "gyro"), (felt, "accelerometer")):
            sigma, tau = bench.drift[kind]
            values += bench.white[kind] / np.sqrt(dt) * rng.standard_normal(values.shape)
            values += _markov(sigma, tau, dt, values.shape, rng)
    _, moving, _ = commanded(legs, start, time[1:] - 0.5 * dt)
    return Recorded(time[1:], rate, felt, temperature_of(time[1:]), readings, ~np.any(moving != 0.0, axis=1))


def _along(truth, name: str, axis: int, vector, warm) -> np.ndarray:
    """The component of rate or force along the sensor's own axis, which leans towards the others."""
    leans = np.zeros_like(vector)
    leans[:, axis] = 1.0
    for other in range(3):
        for key, value in truth.items():
            if other != axis and key.startswith(f"{name}m_{'xyz'[other]}"):
                leans[:, other] += value * warm ** int(key.removeprefix(f"{name}m_")[1:] or 0)
    return np.sum(leans * vector, axis=1)


def said_by(truth, kind: str, axis: int, vector, force, warm, pace: float) -> np.ndarray:
    """What a gyro or an accelerometer says of the rate or the force `vector`, by the names of the coefficients."""
    name = f"{kind}_{'xyz'[axis]}."
    own = _along(truth, name, axis, vector, warm)
    said = own.copy()
    for key, value in truth.items():
        symbol = key.removeprefix(name)
        if symbol == key or symbol.startswith("m_"):
            continue
        if symbol[0] == "a":
            said += value * warm ** int(symbol[1:])
        elif symbol[0] == "b":
            said += value * (own / pace) ** int(symbol[1]) * warm ** int(symbol[2]) * own
        elif symbol[0] == "s":
            said += value * warm ** int(symbol[1:] or 0) * own
        elif symbol.startswith("g_"):
            said += value * warm ** int(symbol[3:] or 0) * force[:, "xyz".index(symbol[2])]
        elif symbol == "k2":
            said += value * own**2
        else:
            raise KeyError(key)
    return said


def _markov(sigma: float, tau: float, dt: float, shape, rng) -> np.ndarray:
    """Stationary first-order Gauss–Markov samples."""
    keep = np.exp(-dt / tau)
    kicks = sigma * np.sqrt(1.0 - keep**2) * rng.standard_normal(shape)
    kicks[0] = sigma * rng.standard_normal(shape[1:])
    return lfilter([1.0], [1.0, -keep], kicks, axis=0)


def _spans(legs: list[Leg], axis: int) -> list[tuple[float, float]]:
    """When an axis stands, whatever others do."""
    edges = np.concatenate([[0.0], np.cumsum([leg.duration for leg in legs])])
    own = [k for k, leg in enumerate(legs) if leg.axis == axis]
    return list(zip([0.0, *edges[[k + 1 for k in own]]], [*edges[own], edges[-1]], strict=True))


def _encoders(bench: Bench, legs, start, time, rng, *, punctual: bool):
    """Of every axis: how far beyond its mean reading it stands in each standstill; and the readings at each sample."""
    angles, _, _ = commanded(legs, start, time[1:])
    draws = []
    for l in range(len(bench.axes)):
        own = []
        for begin, end in _spans(legs, l):
            offset = 0.0 if rng is None else bench.offset[l] * rng.standard_normal()
            own.append(offset)
            rows = slice(*np.searchsorted(time[1:], [begin - 1e-9, end + 1e-9]))
            count = int(np.floor((end - begin) / bench.every[l] + 1e-9)) + 1
            if rng is not None and rows.stop > rows.start:
                # One reading each `every`, held until the next, as slow encoders are logged.
                noise = bench.reading[l] * rng.standard_normal(count)
                part = bench.every[l] if punctual else (end - begin) / count
                held = np.floor((time[1:][rows] - begin) / part + 1e-9).astype(int)
                held[-1] = count - 1 if punctual else held[-1]
                angles[rows, l] += noise[np.clip(held, 0, count - 1)]
        draws.append(own)
    return draws, angles


def _slow(draws, legs, axis: int, number, angle, rate, start):
    """The draw of the standstill, going over to the next in proportion to the angle turned; and its rate."""
    extra, slope = np.zeros(len(angle)), np.zeros(len(angle))
    passed, here = 0, float(start[axis])
    for k, leg in enumerate(legs):
        rows = slice(*np.searchsorted(number, [k, k + 1]))
        extra[rows] = draws[passed]
        if leg.axis == axis:
            change = (draws[passed + 1] - draws[passed]) / leg.angle
            extra[rows] += change * (angle[rows] - here)
            slope[rows] = change * rate[rows]
            here += leg.angle
            passed += 1
    return extra, slope


# --- recordings of a spec's plan --------------------------------------------------------------------------------------


def legs_of(steps, cycles: int) -> list[Leg]:
    """The legs of a plan's cycle (`files.spec.motion_plan`), so many times."""
    once = []
    for step in steps:
        move = step.move
        ramp, stands = (0.0, move.ramp) if move.shape == "hand" else (move.ramp, 0.0)
        turns = Leg(step.axis, move.duration, move.angle, move.peak_rate or 0.0, ramp or 0.0, stands)
        once += [turns if step.axis >= 0 else Leg(-1, move.duration)]
    return once * cycles


def bench_of(spec, mounting: int = 0) -> Bench:
    """The table and noise of a unit's spec, as numbers."""
    table, sensor = spec.rig.table, spec.sensor
    white, drift = {"gyro": 0.0, "accelerometer": 0.0}, {"gyro": (0.0, 1.0), "accelerometer": (0.0, 1.0)}
    for kind, key in (("gyro", "angle_random_walk"), ("accelerometer", "velocity_random_walk")):
        if (triad := getattr(sensor, kind)) is not None:
            white[kind] = float(getattr(triad, key))
            assert len(triad.drift) < 2
            for process in triad.drift:
                drift[kind] = float(process.standard_deviation), float(process.correlation_time)
    angles = [axis.angle for axis in table.axis]
    scale = None if sensor.gyro is None else sensor.gyro.scale_factor
    return Bench(
        tuple(np.array(axis.unit_vector) for axis in table.axis),
        np.array(table.mounting[mounting].columns).T,
        float(spec.rig.site.latitude),
        float(spec.rig.site.gravity),
        white,
        drift,
        tuple(float(a.standstill_offset) for a in angles),
        tuple(float(a.reading_noise) for a in angles),
        tuple(float(a.read_every) for a in angles),
        pace=1.0 if scale is None else float(scale.rate.scale),
    )


def recordings(spec, truth: dict[str, float], rng: np.random.Generator, *, lever=None, **options) -> list[Recorded]:
    """What a logger keeps of a spec's plan: one recording for each stretch of used data, so for each mounting. `lever`
    (m): how far off the axes the unit is, in the place of the bench's own.
    """
    schedule, found = spec.schedule, []
    segments = schedule.segments
    times = [segments[0].start, *(s.start + s.duration for s in segments)]
    course = [segments[0].temperature_start, *(s.temperature_end for s in segments)]
    names = tuple(axis.name for axis in spec.rig.table.axis)
    for k, stretch in enumerate(schedule.stretches):
        mounting = min(k, len(spec.rig.table.mounting) - 1)
        legs = legs_of(schedule.steps, stretch.cycles)
        if stretch.leftover > 0.0:
            legs = [*legs, Leg(-1, stretch.leftover)]
        bench = bench_of(spec, mounting)
        found.append(
            record(
                bench if lever is None else replace(bench, lever=lever), legs, schedule.start, truth,
                lambda t, begin=stretch.start: np.interp(begin + t, times, course),
                rng, names=names, number=mounting + 1, **options,
            )
        )  # fmt: skip
    return found
