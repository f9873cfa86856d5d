"""A simulated log of a spec's plan: raw samples of any number of units on one table, with the truth that made them.

What the spec's model says is drawn sample by sample: random walk, every process, the table's readings with their
noise, offsets and harmonics. The log says `simulated`.
"""

from typing import NamedTuple

import numpy as np
from scipy.signal import lfilter

from gradcal_jax.model import BIAS, HARMONICS, SCALE_FACTOR, TEMPERATURE_GRADIENT, SensorModel
from gradcal_jax.model.build import assemble
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
    """Sensors of a model and what they say; all is drawn from one generator."""

    def __init__(self, model: SensorModel, units: int, hz: float, rng: np.random.Generator, *, noiseless: bool) -> None:
        self.model, self.units, self.hz, self.rng, self.noiseless = model, units, hz, rng, noiseless
        self.truth = np.zeros((units, model.size))

    def draw_truth(self) -> None:
        """Reported parameters from their priors (typical sizes where a prior is flat), discrepancies zero."""
        model, std = self.model, np.zeros(self.model.size)
        for of in (model.bias, model.scale):
            if of is not None:
                std[model.where(of.name)] = float(of.prior_std) if np.isfinite(of.prior_std) else _USUAL[of.name]
        gradient = model.term(TEMPERATURE_GRADIENT)
        if gradient is not None and gradient.has_prior:
            std[model.where(TEMPERATURE_GRADIENT)] = float(gradient.std)
        if model.harmonics is not None:
            std[model.where(HARMONICS)] = np.repeat(model.harmonics.amplitudes, 2)
        reported = std * self.rng.standard_normal((self.units, model.size))
        self.truth = np.linalg.solve(model.to_reported, reported.T).T

    def errors(self, rate: np.ndarray, temperature: np.ndarray, slope: np.ndarray) -> np.ndarray:
        """Of the maps, rad/s `(U, n)`."""
        model, beta = self.model, self.truth
        error = np.zeros((self.units, len(rate)))
        if model.bias is not None:
            error += beta[:, model.where(BIAS)] @ model.bias.temperature(temperature).T
        moving = rate != 0.0
        if model.scale is not None and moving.any():
            values = model.scale.values(temperature[moving], rate[moving])
            error[:, moving] += (beta[:, model.where(SCALE_FACTOR)] @ values.T) * rate[moving]
        if model.term(TEMPERATURE_GRADIENT) is not None:
            error += beta[:, model.where(TEMPERATURE_GRADIENT)] * slope[None]
        return error

    def noise(self, rate: np.ndarray) -> np.ndarray:
        """Of samples one after another, rad/s `(U, n)`."""
        shape = (self.units, len(rate))
        if self.noiseless:
            return np.zeros(shape)
        error = float(self.model.angle_random_walk) * np.sqrt(self.hz) * self.rng.standard_normal(shape)
        p = self.model.processes
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
        reference = self.model.reference
        offsets = float(reference.standstill_offset) * self.rng.standard_normal(int(number.max()) + 1)
        error = float(reference.reading_noise) * self.rng.standard_normal(len(angle))
        error += np.where(at_rest, offsets[number], 0.0)
        waves = self.truth[0, self.model.where(HARMONICS)].reshape(-1, 2)
        orders = () if self.model.harmonics is None else self.model.harmonics.orders
        for order, (cosine, sine) in zip(orders, waves, strict=True):
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
    truth: dict[str, np.ndarray] | None = None,
    noiseless: bool = False,
    readings: bool = False,
) -> SimulatedLog:
    """Samples of every channel of a gradient plan, or the plateaus of a standard one.

    `truth`: the engine's parameters `(U, p)` by channel. `noiseless` leaves out all noise: what is left is sampling
    alone. `readings`: the log has the plan's readings as events, those between two moves among them, instead of the
    angle at every row.
    """
    built = assemble(spec)
    assert spec.sensor.gyro is not None
    axis = spec.sensor.gyro.axes[0]
    simulator = _Simulator(built.model, units, sample_rate_hz, np.random.default_rng(seed), noiseless=noiseless)
    if truth is None:
        simulator.draw_truth()
    else:
        simulator.truth = truth[axis].copy()
    # The table's, not the units'.
    harmonics = built.model.where(HARMONICS)
    simulator.truth[:, harmonics] = simulator.truth[:1, harmonics]
    if isinstance(spec.schedule, StandardSchedule):
        return _standard(simulator, spec.schedule, axis)
    return _gradient(simulator, built.trajectory(), axis, readings=readings)


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
    offset = float(simulator.model.reference.standstill_offset)
    values = angle[rows] + np.where(between, offset * simulator.rng.standard_normal(len(rows)), 0.0)
    whole, kind = np.zeros(len(rows), int), np.full(len(rows), int(ReadingKind.PLANNED))
    return AngleReadings.in_order([AngleReadings(time[rows], rows, whole, values, np.full(len(rows), np.nan), kind)])


def _standard(simulator: _Simulator, plan: StandardSchedule, axis: str) -> SimulatedLog:
    """Plateau after plateau; the noise goes on through the soaks, which are then left out as gaps, or begins anew. A
    point begins at a row that stands for no time."""
    hz = simulator.hz
    soak, per_point = round(plan.soak_each * hz), max(2, round(plan.integration * hz)) + 1
    points = [(t, rate, k > 0) for t in plan.temperatures for k, rate in enumerate((0.0, *plan.rates))]
    counts = [per_point if used else soak for _, _, used in points]
    temperature, rate, keep = (np.repeat(column, counts) for column in zip(*points, strict=True))
    accuracy = 0.0 if simulator.noiseless else float(simulator.model.reference.rate_accuracy)
    reference = rate * (1.0 + np.repeat(accuracy * simulator.rng.standard_normal(len(points)), counts))
    said = rate + simulator.errors(rate, temperature, np.zeros(len(rate)))
    parts = np.split(np.arange(len(rate)), np.cumsum(counts)[:-1])
    for part in parts if plan.shared == "independent" else [np.arange(len(rate))]:
        said[:, part] += simulator.noise(rate[part])
    starts = np.cumsum([0] + [per_point for _, _, used in points if used])[:-1]
    table = {"table_rate_rad_per_s": reference[keep][:, None], "stretch_starts": starts.astype(np.int64)}
    return simulator.log(said[:, keep], np.arange(len(rate))[keep] / hz, temperature[keep], axis, **table)
