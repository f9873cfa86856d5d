"""The timeline of a spec as the contract gradcal-timeline/2: segments, readings and the sensor's model."""

from typing import Any, cast, overload

import numpy as np

from gradcal_jax.api.build import Assembled, assemble
from gradcal_jax.api.contract_rows import as_number, map_row, process_rows, shape_row, temperatures_between
from gradcal_jax.api.unit_timeline import unit_timeline
from gradcal_jax.files import Spec, Timeline
from gradcal_jax.files.contracts import (
    GradientSensitivityRow,
    HarmonicRow,
    ReadingRow,
    SegmentRow,
    SensorRow,
    StartsRow,
    TemperatureErrorRow,
)
from gradcal_jax.files.moves import Axis
from gradcal_jax.files.plan import StandardPlan
from gradcal_jax.files.schedule import StandardSchedule
from gradcal_jax.files.sensor import Sensor
from gradcal_jax.files.spec import expect_whole
from gradcal_jax.files.unit_spec import UnitSpec
from gradcal_jax.files.unit_timeline import UnitTimeline


@overload
def timeline(spec: Spec) -> Timeline: ...
@overload
def timeline(spec: UnitSpec) -> UnitTimeline: ...
def timeline(spec: Spec | UnitSpec) -> Timeline | UnitTimeline:
    """Every segment and reading of a spec's plan in SI, axes one after the other; temperatures (°C) are the chamber's.

    Another program can compute the covariance from it alone: contract gradcal-timeline/2 or, for a whole unit, with the
    angles of all axes and attitudes, gradcal-unit-timeline/1. Errors: `ValueError` for a spec with [[done]].
    """
    if isinstance(spec, UnitSpec):
        return unit_timeline(spec)
    expect_whole(spec, "a timeline")
    built = assemble(spec)
    segments: list[SegmentRow] = []
    readings: list[ReadingRow] = []
    for channel in built.channels:
        if isinstance(spec.schedule, StandardSchedule):
            rows = _standard_rows(built, spec.schedule)
        else:
            rows = _gradient_rows(built, channel)
        segments += rows[0]
        readings += rows[1]
    harmonics = tuple(HarmonicRow(order=h.order, sigma=float(h.amplitude)) for h in spec.rig.table.angle.harmonics)
    standard = spec.plan if isinstance(spec.plan, StandardPlan) else None
    return Timeline(
        title=spec.title,
        estimator="best linear" if standard is None else standard.estimator,
        points=None if standard is None else standard.points,
        sensor=_sensor_row(spec),
        harmonics=harmonics,
        segments=tuple(segments),
        readings=tuple(readings),
    )


def _gradient_rows(built: Assembled, channel: Axis) -> tuple[list[SegmentRow], list[ReadingRow]]:
    line, schedule = built.trajectory(channel), built.schedules[channel]
    times = schedule.programme.times()
    begins, ends = schedule.programme.chamber()
    chamber = np.append(begins, ends[-1])
    start, turned = line.start, line.turned()
    end = start + line.duration
    reference = built.model.reference
    white, offset = float(reference.reading_noise), float(reference.standstill_offset)
    timing = float(reference.timing_error)

    def reading(time: float, standstill: int | None, *, origin: bool = False) -> ReadingRow:
        stands = standstill is not None
        return ReadingRow(
            time=time,
            kind="angle",
            axis=channel,
            origin=origin,
            white_std=white,
            standstill_id=standstill,
            offset_std=offset if stands else 0.0,
            timing_std=0.0 if stands else timing,
        )

    def add(begin: float, finish: float, **own: Any) -> None:
        row = {"shape": "rest", "start": begin, "duration": finish - begin} | own
        segments.append(SegmentRow(axis=channel, **row, **temperatures_between(times, chamber, begin, finish)))

    segments: list[SegmentRow] = []
    readings = [reading(float(start[0]), 0, origin=True)]
    standstill = 0
    if start[0] > 0.0:
        add(0.0, float(start[0]), standstill_id=0, read=True, used=False)
    for pieces in np.split(np.arange(line.piece_count), np.flatnonzero(np.diff(line.segment)) + 1):
        first, last = pieces[0], pieces[-1]
        index = int(schedule.pieces.move[first])
        # After the moves of the spec the axis stands until the stretch ends.
        move, own = (built.moves[index] if index < len(built.moves) else None), {}
        if line.moving[first]:
            assert move is not None
            own = shape_row(move, float(turned[pieces].sum()))
            standstill += 1
        readings += [reading(float(end[k]), standstill if line.at_rest[k] else None) for k in pieces if line.read[k]]
        # A gap in which the chamber bends has several pieces, but the angle is read once, at its end.
        unused = bool(line.gap[last])
        if unused:
            readings.append(reading(float(end[last]), standstill, origin=True))
        add(
            float(start[first]),
            float(end[last]),
            table_axis=None if move is None or move.shape == "rest" else cast("Axis", move.axis),
            standstill_id=None if line.moving[first] else standstill,
            read=unused or bool(np.any(line.read[pieces])),
            used=not unused,
            **own,
        )
    return segments, readings


def _standard_rows(built: Assembled, plan: StandardSchedule) -> tuple[list[SegmentRow], list[ReadingRow]]:
    accuracy = float(built.model.reference.rate_accuracy)
    soak, integration = plan.soak_each, plan.integration
    segments: list[SegmentRow] = []
    readings: list[ReadingRow] = []
    clock, point = 0.0, 0
    for temperature in plan.temperatures:
        at: dict = {"temperature_start": float(temperature), "temperature_end": float(temperature)}
        segments.append(SegmentRow(axis="x", start=clock, duration=soak, shape="rest", read=False, used=False, **at))
        clock += soak
        for rate in plan.rates:
            both: dict = {"axis": "x", "standstill_id": point, "duration": integration}
            turned = {"peak_rate": float(rate), "angle": float(rate) * integration, "table_axis": "x" if rate else None}
            shape = "constant" if rate else "rest"
            segments.append(SegmentRow(read=True, start=clock, shape=shape, **both, **turned, **at))
            clock += integration
            error: dict = {"white_std": 0.0, "offset_std": accuracy * abs(float(rate))}
            readings.append(ReadingRow(time=clock, kind="rate", rate=float(rate), **both, **error))
            point += 1
    return segments, readings


def _sensor_row(spec: Spec) -> SensorRow:
    sensor = spec.sensor
    error, gradient = sensor.temperature_error, sensor.bias_temperature_gradient
    return SensorRow(
        arw=float(sensor.angle_random_walk),
        rate_random_walk=float(sensor.rate_random_walk or 0.0),
        turn_on_bias=as_number(sensor.turn_on_bias),
        drift=process_rows(sensor.drift),
        scale_factor_instability=process_rows(sensor.scale_factor_instability),
        thermal_lag=as_number(sensor.thermal_lag),
        sample_clock_error=as_number(sensor.sample_clock_error),
        starts=_starts_row(spec.sensor),
        temperature_error=None
        if error is None
        else TemperatureErrorRow(
            sigma=float(error.standard_deviation),
            tau=as_number(error.correlation_time),
            bias_slope=as_number(error.bias_slope),
            scale_factor_slope=as_number(error.scale_factor_slope),
        ),
        bias_temperature_gradient=None if gradient is None else GradientSensitivityRow(prior=as_number(gradient.prior)),
        bias=None if sensor.bias is None else map_row(sensor.bias),
        scale_factor=None if sensor.scale_factor is None else map_row(sensor.scale_factor),
    )


def _starts_row(sensor: Sensor) -> StartsRow:
    error = sensor.temperature_error
    return StartsRow(
        drift="stationary" if sensor.drift else None,
        rate_random_walk="zero" if sensor.rate_random_walk else None,
        scale_factor_instability="stationary" if sensor.scale_factor_instability else None,
        temperature_error=None if error is None else "stationary" if error.correlation_time else "constant",
        sample_clock_error="constant" if sensor.sample_clock_error else None,
        turn_on_bias=None if not sensor.turn_on_bias else "constant" if sensor.bias is None else "prior",
    )
