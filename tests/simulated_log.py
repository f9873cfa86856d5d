"""A simulated log of a spec's plan: raw samples of any number of units on one table, with the truth that made them.

What the spec's model says is drawn sample by sample: random walk, every process, the table's readings with their
noise, offsets and harmonics. It is for trying things out and for tests; the log says `simulated`.
"""

from typing import NamedTuple

import numpy as np
from scipy.signal import lfilter

from gradcal_jax import formulas
from gradcal_jax.model import BIAS, HARMONICS, SCALE_FACTOR, TEMPERATURE_GRADIENT, SensorModel
from gradcal_jax.model.build import Assembled, assemble
from gradcal_jax.motion import Trajectory
from gradcal_jax.records.log import AngleReadings, Log, ReadingKind
from gradcal_jax.spec.schedule import StandardSchedule
from gradcal_jax.spec.spec import Spec

# Of coefficients without a prior: typical of MEMS gyros.
_USUAL_SCALE_FACTOR = 1e-3
_USUAL_BIAS = np.radians(50.0) / 3600.0


class SimulatedLog(NamedTuple):
    """`truth` `(U, p)`: the engine's parameters of each unit, by channel."""

    log: Log
    truth: dict[str, np.ndarray]


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

    `truth`: the engine's parameters `(U, p)` by channel; without it they are drawn from the priors (typical sizes
    where a prior is flat). `noiseless` leaves out all noise: what is left is sampling alone. `readings`: the log
    has the plan's readings as events, those between two moves among them, instead of the angle at every row. Errors:
    `ValueError` for fewer than one unit, or a sample rate that is not positive.
    """
    if units < 1 or not sample_rate_hz > 0.0:
        raise ValueError("a simulated log needs at least one unit and a positive sample rate")
    built = assemble(spec)
    rng = np.random.default_rng(seed)
    if isinstance(spec.schedule, StandardSchedule):
        return _standard(built, spec.schedule, units, sample_rate_hz, rng, truth, noiseless)
    assert spec.sensor.gyro is not None
    lines = {spec.sensor.gyro.axes[0]: built.trajectory()}
    first = next(iter(lines.values()))
    begin = float(first.start[0])
    end = float(first.start[-1] + first.duration[-1])
    time = begin + np.arange(int((end - begin) * sample_rate_hz) + 1) / sample_rate_hz
    step = np.diff(time, prepend=time[0])
    rates, angles, drawn = [], [], {}
    standing = np.ones(len(time), bool)
    temperature = np.zeros(len(time))
    for channel, line in lines.items():
        motion = _Motion(line)
        angle, at_rest, temperature, number = motion.at(time)
        mean_rate = np.zeros(len(time))
        mean_rate[1:] = np.diff(angle) * sample_rate_hz
        middle = np.concatenate([temperature[:1], 0.5 * (temperature[1:] + temperature[:-1])])
        beta = _truth(built.model, units, rng) if truth is None else truth[channel].copy()
        beta[:, built.model.where(HARMONICS)] = beta[:1, built.model.where(HARMONICS)]  # the table's, not the units'
        drawn[channel] = beta
        error = _maps(built.model, beta, mean_rate, middle, motion.slope(time))
        if not noiseless:
            error += _noise(built.model, mean_rate, step, units, rng)
        rates.append(mean_rate + error)
        angles.append(angle if noiseless else angle + _table_error(built.model, beta[0], angle, number, at_rest, rng))
        standing &= at_rest
    standstill = _numbers(standing)
    events = [
        _readings(line, k, angles[k], time, sample_rate_hz, float(built.model.reference.standstill_offset), rng)
        for k, line in enumerate(lines.values())
    ]
    log = Log(
        time_s=time,
        rate_rad_per_s=np.stack(rates, axis=-1),
        units=tuple(f"simulated-{k + 1}" for k in range(units)),
        axes=tuple(lines),
        temperature_c=np.broadcast_to(temperature, (units, len(time))).copy(),
        table_axes=tuple(lines),
        table_angle_rad=None if readings else np.stack(angles, axis=-1),
        readings=AngleReadings.in_order(events) if readings else None,
        standstill=standstill,
        simulated=True,
        provenance={"source": f"simulated from the spec, seed {seed}"},
    )
    return SimulatedLog(log, drawn)


def _readings(
    line: Trajectory, axis: int, angle: np.ndarray, time: np.ndarray, hz: float, offset: float, rng
) -> AngleReadings:
    """The readings of a plan's standing axis, of the table's `angle` at the rows nearest to their times."""
    read, stands = np.asarray(line.read), np.asarray(line.at_rest)
    at = (np.asarray(line.start) + np.asarray(line.duration))[read & stands]
    rows = np.unique(np.concatenate([[0], np.minimum(np.rint((at - time[0]) * hz), len(time) - 1)])).astype(np.int64)
    ends = np.unique(np.rint((np.asarray(line.start + line.duration)[read & stands & line.moving] - time[0]) * hz))
    between = np.isin(rows, ends) & np.isin(rows, np.rint((np.asarray(line.start)[line.moving] - time[0]) * hz))
    values = angle[rows] + np.where(between, offset * rng.standard_normal(len(rows)), 0.0)
    whole, none = np.full(len(rows), axis), np.full(len(rows), np.nan)
    return AngleReadings(time[rows], rows, whole, values, none, np.full(len(rows), int(ReadingKind.PLANNED)))


class _Motion:
    """A timeline at any instants: angle (rad), whether the axis stands, temperature (°C), number of the standstill."""

    def __init__(self, line: Trajectory) -> None:
        self.start, self.duration = np.asarray(line.start), np.asarray(line.duration)
        self.u0, self.u1 = np.asarray(line.u_start), np.asarray(line.u_end)
        self.terms = np.asarray(line.terms)
        self.moving = np.asarray(line.moving)
        self.trail, self.ramp, self.excess = (np.asarray(f) for f in (line.level, line.slope, line.excess))
        self.lag_rate = float(line.lag_rate)
        turned = np.asarray(line.turned())
        self.angle_at_start = np.concatenate([[0.0], np.cumsum(turned)[:-1]])
        # Joints of pieces by their order, so that rounding in a start does not open holes.
        self.number = np.cumsum(np.diff(self.moving, prepend=False) & self.moving)

    def _piece(self, time: np.ndarray) -> np.ndarray:
        return np.clip(np.searchsorted(self.start, time + 1e-9, side="right") - 1, 0, len(self.start) - 1)

    def at(self, time: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray]:
        k = self._piece(time)
        into = np.clip(time - self.start[k], 0.0, self.duration[k])
        share = into / np.where(self.duration[k] > 0, self.duration[k], 1.0)
        width = self.u1[k] - self.u0[k]
        u = self.u0[k] + width * share
        family = formulas.motion_angle(u) - formulas.motion_angle(self.u0[k])
        whole = np.where(width > 0, self.duration[k] / np.where(width > 0, width, 1.0), 0.0)
        angle = self.angle_at_start[k] + np.einsum("nm,nm->n", family, self.terms[k]) * whole
        temperature = formulas.lagged_temperature(into, self.trail[k], self.ramp[k], self.excess[k], self.lag_rate)
        return angle, ~self.moving[k], temperature, self.number[k]

    def slope(self, time: np.ndarray) -> np.ndarray:
        """dT/dt, K/s."""
        k = self._piece(time)
        into = np.clip(time - self.start[k], 0.0, self.duration[k])
        return self.ramp[k] - self.lag_rate * self.excess[k] * np.exp(-self.lag_rate * into)


def _truth(model: SensorModel, units: int, rng: np.random.Generator) -> np.ndarray:
    """Engine's parameters `(U, p)`: reported ones drawn from their priors, discrepancies zero."""
    std = np.zeros(model.size)
    for of, usual in ((model.bias, _USUAL_BIAS), (model.scale, _USUAL_SCALE_FACTOR)):
        if of is not None:
            std[model.where(of.name)] = float(of.prior_std) if np.isfinite(of.prior_std) else usual
    gradient = model.term(TEMPERATURE_GRADIENT)
    if gradient is not None and gradient.has_prior:
        std[model.where(TEMPERATURE_GRADIENT)] = float(gradient.std)
    if model.harmonics is not None:
        std[model.where(HARMONICS)] = np.repeat(model.harmonics.amplitudes, 2)
    reported = std * rng.standard_normal((units, model.size))
    return np.linalg.solve(model.to_reported, reported.T).T


def _maps(
    model: SensorModel, beta: np.ndarray, rate: np.ndarray, temperature: np.ndarray, slope: np.ndarray
) -> np.ndarray:
    """Errors `(U, n)` of the maps, rad/s."""
    error = np.zeros((len(beta), len(rate)))
    if model.bias is not None:
        error += beta[:, model.where(BIAS)] @ model.bias.temperature(temperature).T
    moving = rate != 0.0
    if model.scale is not None and moving.any():
        values = model.scale.values(temperature[moving], rate[moving])
        error[:, moving] += (beta[:, model.where(SCALE_FACTOR)] @ values.T) * rate[moving]
    if model.term(TEMPERATURE_GRADIENT) is not None:
        error += beta[:, model.where(TEMPERATURE_GRADIENT)] * slope[None]
    return error


def _noise(model: SensorModel, rate: np.ndarray, step: np.ndarray, units: int, rng: np.random.Generator) -> np.ndarray:
    interval = float(np.median(step))
    count = len(rate)
    error = float(model.angle_random_walk) / np.sqrt(interval) * rng.standard_normal((units, count))
    p = model.processes
    for k in range(p.count):
        decay, diffusion = float(p.decay[k]), float(p.diffusion[k])
        keep = np.exp(-decay * interval)
        if decay > 0.0:
            shock = diffusion * np.sqrt(-np.expm1(-2.0 * decay * interval) / (2.0 * decay))
        else:
            shock = diffusion * np.sqrt(interval)
        drive = shock * rng.standard_normal((units, count))
        drive[:, 0] = float(p.initial_std[k]) * rng.standard_normal(units)
        error += lfilter([1.0], [1.0, -keep], drive, axis=1) * (
            float(p.bias_gain[k]) + float(p.rate_gain[k]) * rate[None]
        )
    return error


def _table_error(
    model: SensorModel,
    beta: np.ndarray,
    angle: np.ndarray,
    number: np.ndarray,
    at_rest: np.ndarray,
    rng: np.random.Generator,
) -> np.ndarray:
    """What the table says less what is true, at every row, rad."""
    reference = model.reference
    offsets = float(reference.standstill_offset) * rng.standard_normal(int(number.max()) + 1)
    error = float(reference.reading_noise) * rng.standard_normal(len(angle)) + np.where(at_rest, offsets[number], 0.0)
    waves = beta[model.where(HARMONICS)].reshape(-1, 2)
    orders = () if model.harmonics is None else model.harmonics.orders
    for order, (cosine, sine) in zip(orders, waves, strict=True):
        error += cosine * (np.cos(order * angle) - 1.0) + sine * np.sin(order * angle)
    return error


def _numbers(standing: np.ndarray) -> np.ndarray:
    begins = standing & ~np.concatenate([[False], standing[:-1]])
    return np.where(standing, np.cumsum(begins) - 1, -1).astype(np.int64)


def _standard(
    built: Assembled,
    plan: StandardSchedule,
    units: int,
    sample_rate_hz: float,
    rng: np.random.Generator,
    truth: dict[str, np.ndarray] | None,
    noiseless: bool,
) -> SimulatedLog:
    """Plateau after plateau; the noise goes on through the soaks, which are then left out as gaps, or begins anew."""
    model = built.model
    interval = 1.0 / sample_rate_hz
    soak, per_point = round(plan.soak_each * sample_rate_hz), max(2, round(plan.integration * sample_rate_hz))
    beta = _truth(model, units, rng) if truth is None else truth["x"]
    truly, held, at, kept, starts = [], [], [], [], []
    for temperature in plan.temperatures:
        for k, rate in enumerate((0.0, *plan.rates)):
            count = soak if k == 0 else per_point + 1
            error = 0.0 if noiseless else float(model.reference.rate_accuracy) * rng.standard_normal()
            truly.append(np.full(count, rate))
            held.append(np.full(count, rate * (1.0 + error)))
            at.append(np.full(count, temperature))
            kept.append(np.full(count, k > 0))
            starts.append(k > 0)
    rate, reference, temperature, keep = (np.concatenate(v) for v in (truly, held, at, kept))
    error = _maps(model, beta, rate, temperature, np.zeros(len(rate)))
    if not noiseless:
        # A point begins at a row that stands for no time.
        own = plan.shared == "independent"
        parts = np.split(np.arange(len(rate)), np.cumsum([len(v) for v in truly])[:-1]) if own else [slice(None)]
        for part in parts:
            error[:, part] += _noise(model, rate[part], np.full(len(rate[part]), interval), units, rng)
    time = interval * np.arange(len(rate))
    lengths = np.array([len(v) for v, used in zip(truly, starts, strict=True) if used])
    log = Log(
        time_s=time[keep],
        rate_rad_per_s=(rate + error)[:, keep, None],
        units=tuple(f"simulated-{k + 1}" for k in range(units)),
        axes=("x",),
        temperature_c=np.broadcast_to(temperature[keep], (units, int(keep.sum()))).copy(),
        table_axes=("x",),
        table_rate_rad_per_s=reference[keep][:, None],
        stretch_starts=(np.cumsum(lengths) - lengths).astype(np.int64),
        simulated=True,
        provenance={"source": "simulated from the spec"},
    )
    return SimulatedLog(log, {"x": beta})
