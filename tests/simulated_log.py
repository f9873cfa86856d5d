"""A simulated log of a spec's plan: raw samples of any number of units on one table, with the truth that made them.

What the spec's model says is drawn sample by sample: random walk, every process, the table's readings with their
noise, offsets and harmonics. The log says `simulated`.
"""

from typing import NamedTuple

import numpy as np
from scipy.signal import lfilter

from gradcal_jax.model import BIAS, SCALE_FACTOR, TEMPERATURE_GRADIENT, CommonScale, ImuModel
from gradcal_jax.model.build import build_imu
from gradcal_jax.motion import Trajectory
from gradcal_jax.records.log import AngleReadings, Log, ReadingKind
from gradcal_jax.spec.schedule import StandardSchedule
from gradcal_jax.spec.spec import Spec

# Of coefficients without a prior: typical of MEMS gyros.
_USUAL = {SCALE_FACTOR: 1e-3, BIAS: np.radians(50.0) / 3600.0}


class SimulatedLog(NamedTuple):
    """`truth` `(U, p)`: the engine's parameters of each unit, by channel."""

    log: Log
    truth: dict[str, np.ndarray]


class _Simulator:
    """Gyros of a model and what they say; all is drawn from one generator. `table`: the parameters of the installation,
    which are common to all."""

    def __init__(self, model: ImuModel, units: int, hz: float, rng: np.random.Generator, *, noiseless: bool) -> None:
        (self.channel,), self.encoder, self.installation = model.channels, model.encoder, model.installation
        self.units, self.hz, self.rng, self.noiseless = units, hz, rng, noiseless
        self.table = [term.stds * rng.standard_normal(term.size) * (not noiseless) for term in model.installation]
        self.truth = self._drawn_truth()

    def _drawn_truth(self) -> np.ndarray:
        """Reported parameters from their priors (typical sizes where a prior is flat), discrepancies zero."""
        channel, std, to_reported = self.channel, np.zeros(self.channel.size), np.eye(self.channel.size)
        for term in channel.terms:
            own = channel.where(term.name)
            to_reported[own, own] = term.to_reported
            if term.name in _USUAL:
                std[own] = float(term.prior_std) if np.isfinite(term.prior_std) else _USUAL[term.name]
            elif term.name == TEMPERATURE_GRADIENT and np.isfinite(term.std):
                std[own] = float(term.std)
        reported = std * self.rng.standard_normal((self.units, channel.size))
        return np.linalg.solve(to_reported, reported.T).T

    def errors(self, rate: np.ndarray, temperature: np.ndarray, slope: np.ndarray) -> np.ndarray:
        """Of the maps and the clock, rad/s `(U, n)`."""
        channel, beta = self.channel, self.truth
        error, moving = np.zeros((self.units, len(rate))), rate != 0.0
        if (bias := channel.map(BIAS)) is not None:
            error += beta[:, channel.where(BIAS)] @ bias.temperature(temperature).T
        if (scale := channel.map(SCALE_FACTOR)) is not None and moving.any():
            values = scale.values(temperature[moving], rate[moving])
            error[:, moving] += (beta[:, channel.where(SCALE_FACTOR)] @ values.T) * rate[moving]
        if channel.term(TEMPERATURE_GRADIENT) is not None:
            error += beta[:, channel.where(TEMPERATURE_GRADIENT)] * slope[None]
        clock = [own[0] for term, own in zip(self.installation, self.table, strict=True) if type(term) is CommonScale]
        return error + sum(clock) * rate[None]

    def noise(self, rate: np.ndarray) -> np.ndarray:
        """Of samples one after another, rad/s `(U, n)`."""
        shape = (self.units, len(rate))
        if self.noiseless:
            return np.zeros(shape)
        error = float(self.channel.angle_random_walk) * np.sqrt(self.hz) * self.rng.standard_normal(shape)
        p = self.channel.processes
        for k in range(p.count):
            decay = float(p.decay[k])
            growth = -np.expm1(-2.0 * decay / self.hz) / (2.0 * decay) if decay > 0.0 else 1.0 / self.hz
            drive = float(p.diffusion[k]) * np.sqrt(growth) * self.rng.standard_normal(shape)
            drive[:, 0] = float(p.initial_std[k]) * self.rng.standard_normal(self.units)
            gain = float(p.bias_gain[k]) + float(p.rate_gain[k]) * rate[None]
            error += lfilter([1.0], [1.0, -np.exp(-decay / self.hz)], drive, axis=1) * gain
        return error

    def table_error(self, angle: np.ndarray, number: np.ndarray, at_rest: np.ndarray) -> np.ndarray:
        """What the table says less what is true, at every row, rad; `number`: of the standstill."""
        if self.noiseless:
            return np.zeros(len(angle))
        offset, reading = float(self.encoder.offset[0]), float(self.encoder.reading[0])
        error = reading * self.rng.standard_normal(len(angle))
        error += np.where(at_rest, offset * self.rng.standard_normal(int(number.max()) + 1)[number], 0.0)
        for term, own in zip(self.installation, self.table, strict=True):
            for order, (cosine, sine) in zip(getattr(term, "orders", ()), own.reshape(-1, 2), strict=False):
                error += cosine * (np.cos(order * angle) - 1.0) + sine * np.sin(order * angle)
        return error

    def log(self, rate: np.ndarray, time: np.ndarray, temperature: np.ndarray, axis: str, **table) -> SimulatedLog:
        log = Log(
            time_s=time,
            rate_rad_per_s=rate[:, :, None],
            units=tuple(f"simulated-{k + 1}" for k in range(self.units)),
            axes=(axis,),
            temperature_c=np.broadcast_to(temperature, (self.units, len(time))).copy(),
            table_axes=(axis,),
            simulated=True,
            provenance={"source": "simulated from the spec"},
            **table,
        )
        return SimulatedLog(log, {axis: self.truth})


def simulate_log(
    spec: Spec,
    *,
    units: int = 1,
    sample_rate_hz: float = 50.0,
    seed: int = 0,
    noiseless: bool = False,
    readings: bool = False,
) -> SimulatedLog:
    """Samples of every channel of a gradient plan, or the plateaus of a standard one.

    `noiseless` leaves out all noise: what is left is sampling
    alone. `readings`: the log has the plan's readings as events, those between two moves among them, instead of the
    angle at every row.
    """
    built = build_imu(spec)
    assert spec.sensor.gyro is not None
    axis = spec.sensor.gyro.axes[0]
    simulator = _Simulator(built.model, units, sample_rate_hz, np.random.default_rng(seed), noiseless=noiseless)
    if isinstance(spec.schedule, StandardSchedule):
        return _standard(simulator, spec.schedule, axis)
    return _gradient(simulator, built.motion.line, axis, readings=readings)


def _gradient(simulator: _Simulator, line: Trajectory, axis: str, *, readings: bool) -> SimulatedLog:
    hz, start, duration = simulator.hz, np.asarray(line.start), np.asarray(line.duration)
    time = start[0] + np.arange(int((start[-1] + duration[-1] - start[0]) * hz) + 1) / hz
    # Joints of pieces by their order, so that rounding in a start does not open holes.
    k = np.clip(np.searchsorted(start, time + 1e-9, side="right") - 1, 0, len(start) - 1)
    since = np.clip(time - start[k], 0.0, duration[k])
    v = (since / np.where(duration[k] > 0, duration[k], 1.0))[:, None]
    at_start = np.concatenate([[0.0], np.cumsum(line.turned())[:-1]])
    angle = at_start[k] + np.asarray(line.angle(v, k))[:, 0]
    temperature = np.asarray(line.temperature(v, k))[:, 0]
    moving = np.asarray(line.moving)
    number, at_rest = np.cumsum(np.diff(moving, prepend=False) & moving)[k], ~moving[k]
    rate = np.diff(angle, prepend=angle[0]) * hz
    middle = np.concatenate([temperature[:1], 0.5 * (temperature[1:] + temperature[:-1])])
    slope = np.asarray(line.temperature_slope(since[:, None], k))[:, 0]
    said = rate + simulator.errors(rate, middle, slope) + simulator.noise(rate)
    angle = angle + simulator.table_error(angle, number, at_rest)
    begins = at_rest & ~np.concatenate([[False], at_rest[:-1]])
    table = {
        "table_angle_rad": None if readings else angle[:, None],
        "readings": _readings(simulator, line, angle, time) if readings else None,
        "standstill": np.where(at_rest, np.cumsum(begins) - 1, -1).astype(np.int64),
    }
    return simulator.log(said, time, temperature, axis, **table)


def _readings(simulator: _Simulator, line: Trajectory, angle: np.ndarray, time: np.ndarray) -> AngleReadings:
    """The readings of a plan's standing axis, of the table's `angle` at the rows nearest to their times."""
    read, start = np.asarray(line.read) & np.asarray(line.at_rest), np.asarray(line.start)
    moving, ends = np.asarray(line.moving), start + np.asarray(line.duration)

    def row(at: np.ndarray) -> np.ndarray:
        return np.rint((at - time[0]) * simulator.hz)

    rows = np.unique(np.concatenate([[0], np.minimum(row(ends[read]), len(time) - 1)])).astype(np.int64)
    between = np.isin(rows, row(ends[read & moving])) & np.isin(rows, row(start[moving]))
    offset = float(simulator.encoder.offset[0])
    values = angle[rows] + np.where(between, offset * simulator.rng.standard_normal(len(rows)), 0.0)
    whole, kind = np.zeros(len(rows), int), np.full(len(rows), int(ReadingKind.PLANNED))
    return AngleReadings(time[rows], rows, whole, values, np.full(len(rows), np.nan), kind)


def _standard(simulator: _Simulator, plan: StandardSchedule, axis: str) -> SimulatedLog:
    """Plateau after plateau; the noise goes on through the soaks, which are then left out as gaps, or begins anew. A
    point begins at a row that stands for no time."""
    hz = simulator.hz
    soak, per_point = round(plan.soak_each * hz), max(2, round(plan.integration * hz)) + 1
    points = [(t, rate, k > 0) for t in plan.temperatures for k, rate in enumerate((0.0, *plan.rates))]
    counts = [per_point if used else soak for _, _, used in points]
    temperature, rate, keep = (np.repeat(column, counts) for column in zip(*points, strict=True))
    accuracy = 0.0 if simulator.noiseless else float(simulator.encoder.rate)
    reference = rate * (1.0 + np.repeat(accuracy * simulator.rng.standard_normal(len(points)), counts))
    said = rate + simulator.errors(rate, temperature, np.zeros(len(rate)))
    parts = np.split(np.arange(len(rate)), np.cumsum(counts)[:-1])
    for part in parts if plan.shared == "independent" else [np.arange(len(rate))]:
        said[:, part] += simulator.noise(rate[part])
    starts = np.cumsum([0] + [per_point for _, _, used in points if used])[:-1]
    table = {"table_rate_rad_per_s": reference[keep][:, None], "stretch_starts": starts.astype(np.int64)}
    return simulator.log(said[:, keep], np.arange(len(rate))[keep] / hz, temperature[keep], axis, **table)
