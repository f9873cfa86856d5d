"""A spec in the core's terms: its error model and its plan."""

from typing import NamedTuple, cast

import numpy as np

from gradcal_jax import errormodel, plans
from gradcal_jax.errormodel import GyroModel, Map, Processes
from gradcal_jax.files import Spec
from gradcal_jax.files.bases import RatePolynomial, RateSpline, TemperaturePolynomial, TemperatureSpline
from gradcal_jax.files.moves import Axis, ResolvedMove
from gradcal_jax.files.schedule import StandardSchedule
from gradcal_jax.files.sensor import Bias, ScaleFactor, Sensor

# A varying rate is integrated on the nodes of a piece, against exponentials of at most this many correlation times.
_CORRELATION_TIMES_A_PIECE = 3.0


class Assembled(NamedTuple):
    """A spec in the core's terms. `sources`: what the model's noise consists of, by the names that people use."""

    spec: Spec
    model: GyroModel
    plan: plans.Plan
    thermal_lag: float | None
    sources: dict[str, tuple[int, ...]]

    @property
    def channels(self) -> tuple[Axis, ...]:
        """Sensor axes whose calibration the plan is for."""
        return cast("tuple[Axis, ...]", self.plan.channels)


def assemble(spec: Spec) -> Assembled:
    """Error model and plan of a spec."""
    processes, sources = _processes(spec.sensor)
    return Assembled(spec, _model(spec, processes), _plan(spec), _number(spec.sensor.thermal_lag), sources)


def error_model(spec: Spec) -> GyroModel:
    """The error model alone, for whoever has the plan already."""
    return _model(spec, _processes(spec.sensor)[0])


def _processes(sensor: Sensor) -> tuple[Processes, dict[str, tuple[int, ...]]]:
    """All noise processes of a sensor, and which of them belong to which source."""
    parts: list[tuple[str, Processes]] = [
        ("bias instability", errormodel.gauss_markov(float(d.standard_deviation), float(d.correlation_time)))
        for d in sensor.drift
    ]
    if sensor.rate_random_walk:
        parts.append(("rate random walk", errormodel.rate_random_walk(float(sensor.rate_random_walk))))
    for d in sensor.scale_factor_instability:
        process = errormodel.gauss_markov(
            float(d.standard_deviation), float(d.correlation_time), bias_gain=0.0, rate_gain=1.0
        )
        parts.append(("scale-factor instability", process))
    if (error := sensor.temperature_error) is not None:
        gains = {"bias_gain": float(error.bias_slope or 0.0), "rate_gain": float(error.scale_factor_slope or 0.0)}
        deviation = float(error.standard_deviation)
        if error.correlation_time is None:
            parts.append(("temperature measurement", errormodel.constant(deviation, **gains)))
        else:
            process = errormodel.gauss_markov(deviation, float(error.correlation_time), **gains)
            parts.append(("temperature measurement", process))
    if sensor.sample_clock_error:
        parts.append(("sample clock", errormodel.constant(float(sensor.sample_clock_error), rate_gain=1.0)))
    if sensor.turn_on_bias and sensor.bias is None:
        parts.append(("turn-on bias", errormodel.constant(float(sensor.turn_on_bias), bias_gain=1.0)))
    total = errormodel.no_processes()
    sources: dict[str, tuple[int, ...]] = {}
    for name, part in parts:
        sources[name] = (*sources.get(name, ()), total.count)
        total = total + part
    return total, sources


def _model(spec: Spec, processes: Processes) -> GyroModel:
    sensor, table = spec.sensor, spec.rig.table
    gradient = sensor.bias_temperature_gradient
    angle = table.angle
    reference = errormodel.angle_reference(
        float(angle.reading_noise),
        float(angle.standstill_offset),
        float(angle.timing_error),
        float(table.rate_accuracy or 0.0),
        {h.order: float(h.amplitude) for h in angle.harmonics},
    )
    return GyroModel(
        None if sensor.bias is None else bias_map(sensor.bias),
        None if sensor.scale_factor is None else scale_factor_map(sensor.scale_factor),
        np.asarray(float(sensor.angle_random_walk)),
        processes,
        reference,
        np.asarray(float(sensor.turn_on_bias or 0.0)),
        np.asarray(np.inf if gradient is None or gradient.prior is None else float(gradient.prior)),
        has_gradient=gradient is not None,
        has_gradient_prior=gradient is not None and gradient.prior is not None,
    )


def basis(section) -> errormodel.Basis:
    """A basis of the core from its section of a spec."""
    if isinstance(section, TemperaturePolynomial | RatePolynomial):
        return errormodel.Polynomial(section.degree, float(section.centre), float(section.scale), section.internal)
    if isinstance(section, TemperatureSpline | RateSpline):
        return errormodel.BSpline(tuple(float(k) for k in section.knots), section.degree)
    return errormodel.Bins(tuple(float(e) for e in section.edges))


def bias_map(section: Bias) -> Map:
    """`B(T)` with its priors, from a spec."""
    beyond = section.discrepancy
    return errormodel.make_map(
        basis(section.temperature),
        prior_std=_or_infinite(section.prior),
        smoothness_std=_or_infinite(section.smoothness),
        discrepancy=None if beyond is None else (float(beyond.standard_deviation), beyond.temperature_degree, 0),
    )


def scale_factor_map(section: ScaleFactor) -> Map:
    """`M(T, ω)` with its priors, from a spec."""
    beyond = section.discrepancy
    return errormodel.make_map(
        basis(section.temperature),
        basis(section.rate),
        prior_std=_or_infinite(section.prior),
        smoothness_std=_or_infinite(section.smoothness),
        discrepancy=None
        if beyond is None
        else (float(beyond.standard_deviation), beyond.temperature_degree, beyond.rate_degree),
    )


def _or_infinite(value: float | None) -> float:
    return np.inf if value is None else float(value)


def _number(value: float | None) -> float | None:
    return None if value is None else float(value)


def _plan(spec: Spec) -> plans.Plan:
    schedule = spec.schedule
    if isinstance(schedule, StandardSchedule):
        return plans.standard_plan(schedule.temperatures, schedule.soak_each, schedule.integration, schedule.rates)
    programme = plans.programme(
        schedule.segments[0].temperature_start, [(segment.duration, segment.slope) for segment in schedule.segments]
    )
    ends = [segment.start for segment in schedule.segments] + [schedule.duration]
    nearest = lambda time: int(np.argmin(np.abs(np.array(ends) - time)))  # noqa: E731
    used = tuple((nearest(s.start), nearest(s.start + s.duration)) for s in schedule.stretches)
    cycle = schedule.cycle
    if cycle is None:
        return plans.gradient_plan(programme, used=used, read_every=schedule.read_every)
    longest = _CORRELATION_TIMES_A_PIECE * shortest_correlation_time(spec.sensor)
    moves = tuple(move_of(move, cycle.other_read_every, longest) for move in cycle.moves for _ in range(move.repeat))
    after = []
    if cycle.other > 0.0:
        after.append(plans.rest(cycle.other, cycle.other_read_every))
    if cycle.idle > 0.0:
        after.append(plans.rest(cycle.idle))
    return plans.gradient_plan(programme, moves, tuple(after), used=used, read_every=cycle.other_read_every)


def shortest_correlation_time(sensor: Sensor) -> float:
    """Of the processes that the rate drives (s); `inf` without any."""
    times = [float(d.correlation_time) for d in sensor.scale_factor_instability]
    if sensor.temperature_error is not None and sensor.temperature_error.correlation_time is not None:
        times.append(float(sensor.temperature_error.correlation_time))
    return min(times, default=np.inf)


def move_of(move: ResolvedMove, others_read_every: float | None, longest_piece: float) -> plans.Move:
    """A move of a spec as the core has it; times in s."""
    if move.is_rest:
        return plans.rest(move.duration, move.read_every, read_at_end=move.read_end)
    return plans.turn(
        move.shape,
        move.peak_rate,
        move.duration,
        ramp=move.ramp,
        axis=move.axis,
        cycles=move.cycles,
        controls=move.controls,
        unevenness=move.unevenness,
        read_at_end=move.read_end,
        read_every=move.read_every,
        others_read_every=others_read_every,
        longest_piece=longest_piece,
    )
