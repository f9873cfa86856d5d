"""A spec in the core's terms: its error model and its plan."""

from collections.abc import Sequence
from dataclasses import replace
from typing import NamedTuple

import numpy as np

from gradcal_jax import model
from gradcal_jax import motion as trajectory
from gradcal_jax.information.gears import gears_of
from gradcal_jax.model import Map, OtherTemperature, OwnTerm, PathTerm, Processes, Reference, SensorModel, SignalMap
from gradcal_jax.motion import Move, Schedule
from gradcal_jax.spec.bases import PolynomialKeys
from gradcal_jax.spec.motion_plan import PlanSchedule
from gradcal_jax.spec.moves import ResolvedMove
from gradcal_jax.spec.schedule import StandardSchedule
from gradcal_jax.spec.sensor import AccelerometerTriad, Bias, GyroTriad, ScaleFactor
from gradcal_jax.spec.spec import expect_spec
from gradcal_jax.spec.spec_sections import Spec
from gradcal_jax.tables.section import Section

# A varying rate is integrated on the nodes of a piece, against exponentials of at most this many correlation times.
_CORRELATION_TIMES_A_PIECE = 3.0


class Assembled(NamedTuple):
    """A spec of one gyro along the only axis of a table in the core's terms.

    `sources`: the indices of the model's noise processes by the name of their error source.
    """

    spec: Spec
    model: SensorModel
    schedule: Schedule
    thermal_lag: float | None
    sources: dict[str, tuple[int, ...]]

    def trajectory(self) -> trajectory.Trajectory:
        """The motion of the plan."""
        return self.schedule.trajectory(self.thermal_lag)


def assemble(spec: Spec) -> Assembled:
    """Sensor model and schedule of a spec of one gyro along the only axis of a table.

    Errors: `TypeError` for anything but a spec, `ValueError` for one of several sensors or axes of the table.
    """
    gyro, site = expect_spec(spec).sensor.gyro, spec.rig.site
    if gyro is None or not spec.turns_one_gyro:
        raise ValueError(
            "expected a spec with a single gyro along the only axis of a level table, with readings at rest "
            '([rig.table] standing = "read"), and without terms that depend on past temperatures'
        )
    parts = named_processes(gyro, clock=spec.sensor.clock_error, earth_is_unknown=site.is_unknown)
    processes, sources = processes_of(parts)
    table, angle = spec.rig.table, spec.rig.table.axis[0].angle
    reference = model.angle_reference(
        float(angle.reading_noise),
        float(angle.standstill_offset),
        float(angle.timing_error),
        float(table.rate_accuracy or 0.0),
    )
    harmonics = {h.order: float(h.amplitude) for h in angle.harmonics}
    backlash = float(sum(lash for _, lash in gears_of(spec)))
    channel = gyro_channel(gyro, gyro.axes[0], processes, reference, harmonics=harmonics, backlash=backlash)
    lag = spec.sensor.lag
    schedule = table_schedule(spec.schedule, spec)
    return Assembled(spec, channel, schedule, lag, sources)


def table_schedule(plan: PlanSchedule | StandardSchedule, spec: Spec) -> Schedule:
    """The schedule of a plan as a channel sees it that every axis turns."""
    if isinstance(plan, StandardSchedule):
        return held_rates(plan)
    table, gyro = spec.rig.table, spec.sensor.gyro
    course, used = chamber_programme(plan)
    every = float(table.axis[0].angle.read_every) if table.standing == "read" else None
    longest = np.inf if gyro is None else longest_piece(gyro)

    def move(of: ResolvedMove) -> Move:
        spacing = every if of.reads_as_table else of.read_every
        return move_of(replace(of, read_every=spacing), longest)

    # (Steps behind the cycle are made once.)
    moves, after = (tuple(move(s.move) for s in part) for part in (plan.every_step, plan.after))
    # What no cycle fills is read once at its end, but by an operator, who types angles after turns only.
    left = None if every is None or (np.isinf(every) and not table.typed) else every
    return trajectory.gradient_plan(course, moves, after, used=used, read_every=left)


def processes_of(parts: list[tuple[str, Processes]]) -> tuple[Processes, dict[str, tuple[int, ...]]]:
    """All noise processes of a channel, and their indices by error source."""
    total = model.no_processes()
    sources: dict[str, tuple[int, ...]] = {}
    for name, part in parts:
        sources[name] = (*sources.get(name, ()), total.count)
        total = total + part
    return total, sources


def named_processes(
    sensor: GyroTriad | AccelerometerTriad, *, clock: float = 0.0, earth_is_unknown: bool = False
) -> list[tuple[str, Processes]]:
    """The noise processes of a channel with the names of their error sources: its own, the `clock` (a ratio) where it
    is no common parameter of all channels, and the Earth's rate where no bias is estimated that includes it."""
    figures = lambda d: (float(d.standard_deviation), float(d.correlation_time))  # noqa: E731
    parts = [("bias instability", model.gauss_markov(*figures(d))) for d in sensor.drift]
    if not isinstance(sensor, AccelerometerTriad) and sensor.rate_random_walk:
        parts.append(("rate random walk", model.rate_random_walk(float(sensor.rate_random_walk))))
    for d in sensor.scale_factor_instability:
        process = model.gauss_markov(*figures(d), bias_gain=0.0, rate_gain=1.0)
        parts.append(("scale-factor instability", process))
    if (error := sensor.thermometer_noise) is not None:
        # All channels share a thermometer, but the signs of their slopes are unknown: their errors are uncorrelated.
        gains = {"bias_gain": float(error.bias_slope or 0.0), "rate_gain": float(error.scale_factor_slope or 0.0)}
        deviation = float(error.standard_deviation)
        process = model.constant(deviation, **gains)
        if error.correlation_time is not None:
            process = model.gauss_markov(deviation, float(error.correlation_time), **gains)
        parts.append(("temperature measurement", process))
    if clock:
        parts.append(("sample clock", model.constant(clock, rate_gain=1.0)))
    if sensor.turn_on_bias and sensor.bias is None:
        parts.append(("turn-on bias", model.constant(float(sensor.turn_on_bias), bias_gain=1.0)))
    if earth_is_unknown and sensor.bias is None:
        # Rectangular within the whole rate.
        parts.append(("Earth's rate", model.constant(trajectory.EARTH_RATE / 3.0**0.5, bias_gain=1.0)))
    return parts


def gyro_channel(
    sensor: GyroTriad,
    axis: str,
    processes: Processes,
    reference: Reference | None = None,
    *,
    harmonics: dict[int, float] | None = None,
    backlash: float = 0.0,
    signals: Sequence[SignalMap] = (),
    path: Sequence[PathTerm | OwnTerm] = (),
) -> SensorModel:
    """The model of the gyro along an axis of the body: its maps, the terms of its other `signals` and of the `path`
    of temperature, and its noise."""
    gradient = sensor.gradient_sensitivity
    return model.gyro_model(
        None if sensor.bias is None else section_map(sensor.bias, float(sensor.turn_on_bias or 0.0)),
        None if sensor.scale_factor is None else section_map(sensor.scale_factor),
        float(sensor.angle_random_walk),
        processes,
        reference,
        temperature_gradient_std=None if gradient is None else or_infinite(gradient.prior),
        harmonics=harmonics,
        backlash=backlash,
        signals=signals,
        path=path,
    )


def basis(section) -> model.Basis:
    """A basis of the core from its section of a spec."""
    if isinstance(section, PolynomialKeys):
        return model.Polynomial(section.degree, float(section.centre), float(section.scale))
    knots = tuple(float(k) for k in section.knots)
    return model.BSpline(knots, section.degree) if section.degree else model.Bins(knots)


def section_map(section: Bias | ScaleFactor, turn_on_std: float = 0.0) -> Map:
    """`B(T)` or `M(T, ω)` with its priors, from a spec. The constant of a bias *is* this run's turn-on bias, so their
    priors add."""
    beyond, rate, degree = section.discrepancy, None, 0
    if isinstance(section, ScaleFactor):
        rate, degree = basis(section.rate), 0 if section.discrepancy is None else section.discrepancy.rate_degree
    return model.make_map(
        basis(section.temperature),
        rate,
        prior_std=or_infinite(section.prior),
        smoothness_std=or_infinite(section.smoothness),
        common_std=turn_on_std,
        discrepancy=None if beyond is None else (float(beyond.standard_deviation), beyond.temperature_degree, degree),
        late=late_of(section),
    )


def late_of(section: Section) -> OtherTemperature | None:
    """The temperature that a section's map follows; None: the sensor's own."""
    lag = getattr(section, "lag", None)
    return OtherTemperature.late(float(lag)) if lag else None


def or_infinite(value: float | tuple[float, ...] | None) -> np.ndarray:
    """The prior's standard deviation, or that of each coefficient; infinite (a flat prior) where it is absent."""
    return np.asarray(np.inf if value is None else value, dtype=float)


def held_rates(schedule: StandardSchedule) -> Schedule:
    """The plan of the standard method in the core's terms."""
    points = (schedule.temperatures, schedule.soak_each, schedule.integration, schedule.rates)
    return trajectory.standard_plan(*points, points=schedule.shared)


def chamber_programme(
    plan: PlanSchedule,
) -> tuple[trajectory.Programme, tuple[tuple[int, int], ...]]:
    """The chamber's programme, and the pairs of its knots between which data are used."""
    segments = plan.segments
    ends = np.array([segment.start for segment in segments] + [plan.duration])
    nearest = lambda time: int(np.argmin(np.abs(ends - time)))  # noqa: E731
    used = tuple((nearest(s.start), nearest(s.start + s.duration)) for s in plan.stretches)
    return trajectory.programme(segments[0].temperature_start, [(s.duration, s.slope) for s in segments]), used


def longest_piece(sensor: GyroTriad) -> float:
    """Duration (s) of the longest piece of a varying rate: a few of the shortest correlation time of what it drives."""
    times = [float(d.correlation_time) for d in sensor.scale_factor_instability]
    if (error := sensor.thermometer_noise) is not None and error.correlation_time is not None:
        times.append(float(error.correlation_time))
    return _CORRELATION_TIMES_A_PIECE * min(times, default=np.inf)


def move_of(move: ResolvedMove, longest_piece: float = np.inf) -> Move:
    """A move of a spec in the core's terms; times in s."""
    if move.is_rest:
        return trajectory.rest(move.duration, move.read_every, read_at_end=bool(move.read_end))
    return trajectory.turn(
        move.shape,
        move.peak_rate,
        move.duration,
        ramp=move.ramp,
        unevenness=move.unevenness,
        read_at_end=move.read_end,
        read_every=move.read_every,
        longest_piece=longest_piece,
    )
