"""The contract gradcal-timeline/2, filled from a spec: segments, readings and the sensor's model."""

from typing import cast

import numpy as np

from gradcal_jax import plans
from gradcal_jax.assemble.build import Assembled, assemble
from gradcal_jax.assemble.knowledge import timeline_of
from gradcal_jax.files import Spec, Timeline
from gradcal_jax.files.bases import (
    RateBasis,
    RatePolynomial,
    RateSpline,
    TemperatureBasis,
    TemperaturePolynomial,
    TemperatureSpline,
)
from gradcal_jax.files.contracts import (
    BasisRow,
    DiscrepancyRow,
    Functions,
    GradientSensitivityRow,
    HarmonicRow,
    MapRow,
    ProcessRow,
    ReadingRow,
    SegmentRow,
    SensorRow,
    StartsRow,
    TemperatureErrorRow,
)
from gradcal_jax.files.moves import Axis
from gradcal_jax.files.plan import StandardPlan
from gradcal_jax.files.sensor import Bias, ScaleFactor, ScaleFactorDiscrepancy, Sensor


def timeline(spec: Spec) -> Timeline:
    """Every segment and reading of a spec's plan in SI, axes one after the other; temperatures (°C) are the chamber's.

    Enough for another program to work out the covariance alone: contract gradcal-timeline/2. Errors: none.
    """
    built = assemble(spec)
    segments: list[SegmentRow] = []
    readings: list[ReadingRow] = []
    for channel in built.channels:
        if isinstance(built.plan, plans.StandardPlan):
            rows = _standard_rows(built, built.plan)
        else:
            rows = _gradient_rows(built, built.plan, channel)
        segments += rows[0]
        readings += rows[1]
    harmonics = tuple(HarmonicRow(order=h.order, sigma=float(h.amplitude)) for h in spec.rig.table.angle.harmonics)
    standard = spec.plan if isinstance(spec.plan, StandardPlan) else None
    return Timeline(
        title=spec.title,
        estimator="best linear" if standard is None else standard.estimator,
        points=None if standard is None else "independent",
        sensor=_sensor_row(spec),
        harmonics=harmonics,
        segments=tuple(segments),
        readings=tuple(readings),
    )


def _gradient_rows(
    built: Assembled, plan: plans.GradientPlan, channel: Axis
) -> tuple[list[SegmentRow], list[ReadingRow]]:
    line = timeline_of(built, channel)
    times, chamber = (np.asarray(x) for x in plan.programme.knots())
    start, duration, turned = np.asarray(line.start), np.asarray(line.duration), np.asarray(line.turned())
    end = start + duration
    segment, moving = np.asarray(line.segment), np.asarray(line.moving)
    read, at_rest = np.asarray(line.read), np.asarray(line.at_rest)
    gaps = set(line.gap_pieces.values.tolist())
    moves = plan.moves + plan.after
    reference = built.model.reference
    white, offset = float(reference.reading_noise), float(reference.standstill_offset)
    timing = float(reference.timing_error)

    def between(a: float, b: float) -> dict:
        bends = [(float(t), float(c)) for t, c in zip(times, chamber, strict=True) if a + 1e-6 < t < b - 1e-6]
        ends = np.interp([a, b], times, chamber)
        return {
            "temperature_start": float(ends[0]),
            "temperature_end": float(ends[1]),
            "temperature_bends": tuple(bends) or None,
        }

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

    segments: list[SegmentRow] = []
    readings = [reading(float(start[0]), 0, origin=True)]
    standstill = 0
    if start[0] > 0.0:
        segments.append(
            SegmentRow(
                axis=channel,
                start=0.0,
                duration=float(start[0]),
                shape="rest",
                standstill_id=0,
                read=True,
                used=False,
                **between(0.0, float(start[0])),
            )
        )
    bounds = np.flatnonzero(np.diff(segment)) + 1
    for pieces in np.split(np.arange(len(segment)), bounds):
        first, last = pieces[0], pieces[-1]
        index = line.segment_moves[segment[first]]
        move, own = (None if index < 0 else moves[index]), {}
        if moving[first]:
            own = _shape(moves[index], float(turned[pieces].sum()))
            standstill += 1
        readings += [reading(float(end[k]), standstill if at_rest[k] else None) for k in pieces if read[k]]
        # A gap in which the chamber bends has several pieces, but the angle is read once, at its end.
        unused = last in gaps
        if unused:
            readings.append(reading(float(end[last]), standstill, origin=True))
        segments.append(
            SegmentRow(
                axis=channel,
                table_axis=None if move is None or move.shape == "rest" else cast("Axis", move.axis),
                start=float(start[first]),
                duration=float(end[last] - start[first]),
                standstill_id=None if moving[first] else standstill,
                read=unused or bool(np.any(read[pieces])),
                used=not unused,
                **({"shape": "rest"} | own),
                **between(float(start[first]), float(end[last])),
            )
        )
    return segments, readings


def _shape(move: plans.Move, angle: float) -> dict:
    """The shape's own parameters of a move, as the contract names them."""
    row: dict = {"shape": move.shape, "peak_rate": float(move.peak_rate), "angle": angle}
    if move.shape in ("cosine ramps", "linear ramps"):
        row["ramp"] = float(move.ramp)
    elif move.shape == "sinusoid":
        row["cycles"] = move.cycles
    elif move.shape == "spline":
        row["controls"] = tuple(float(c) for c in move.controls)
    elif move.shape == "hand":
        row["unevenness"] = float(move.unevenness)
    return row


def _standard_rows(built: Assembled, plan: plans.StandardPlan) -> tuple[list[SegmentRow], list[ReadingRow]]:
    accuracy = float(built.model.reference.rate_accuracy)
    soak, integration = float(plan.soak), float(plan.integration)
    segments: list[SegmentRow] = []
    readings: list[ReadingRow] = []
    clock, point = 0.0, 0
    for temperature in np.asarray(plan.temperatures):
        at: dict = {"temperature_start": float(temperature), "temperature_end": float(temperature)}
        segments.append(SegmentRow(axis="x", start=clock, duration=soak, shape="rest", read=False, used=False, **at))
        clock += soak
        for rate in np.asarray(plan.rates):
            segments.append(
                SegmentRow(
                    axis="x",
                    table_axis="x" if rate else None,
                    read=True,
                    start=clock,
                    duration=integration,
                    shape="constant" if rate else "rest",
                    peak_rate=float(rate),
                    angle=float(rate) * integration,
                    standstill_id=point,
                    **at,
                )
            )
            clock += integration
            readings.append(
                ReadingRow(
                    time=clock,
                    kind="rate",
                    axis="x",
                    white_std=0.0,
                    standstill_id=point,
                    offset_std=accuracy * abs(float(rate)),
                    duration=integration,
                    rate=float(rate),
                )
            )
            point += 1
    return segments, readings


def _sensor_row(spec: Spec) -> SensorRow:
    sensor = spec.sensor
    error, gradient = sensor.temperature_error, sensor.bias_temperature_gradient
    processes = lambda rows: tuple(  # noqa: E731
        ProcessRow(sigma=float(r.standard_deviation), tau=float(r.correlation_time)) for r in rows
    )
    return SensorRow(
        arw=float(sensor.angle_random_walk),
        rate_random_walk=float(sensor.rate_random_walk or 0.0),
        turn_on_bias=_plain(sensor.turn_on_bias),
        drift=processes(sensor.drift),
        scale_factor_instability=processes(sensor.scale_factor_instability),
        thermal_lag=_plain(sensor.thermal_lag),
        sample_clock_error=_plain(sensor.sample_clock_error),
        starts=_starts_row(spec.sensor),
        temperature_error=None
        if error is None
        else TemperatureErrorRow(
            sigma=float(error.standard_deviation),
            tau=_plain(error.correlation_time),
            bias_slope=_plain(error.bias_slope),
            scale_factor_slope=_plain(error.scale_factor_slope),
        ),
        bias_temperature_gradient=None if gradient is None else GradientSensitivityRow(prior=_plain(gradient.prior)),
        bias=None if sensor.bias is None else _map_row(sensor.bias),
        scale_factor=None if sensor.scale_factor is None else _map_row(sensor.scale_factor),
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


def _map_row(section: Bias | ScaleFactor) -> MapRow:
    beyond, smooth = section.discrepancy, section.smoothness is not None
    by_rate = isinstance(section, ScaleFactor)
    return MapRow(
        temperature=_basis_row(section.temperature, smooth),
        rate=_basis_row(section.rate, smooth) if by_rate else None,
        prior=_plain(section.prior),
        smoothness=_plain(section.smoothness),
        smoothness_along=() if not smooth else ("temperature", "rate") if by_rate else ("temperature",),
        discrepancy=None
        if beyond is None
        else DiscrepancyRow(
            sigma=float(beyond.standard_deviation),
            functions="legendre",
            temperature_degree=beyond.temperature_degree,
            rate_degree=beyond.rate_degree if isinstance(beyond, ScaleFactorDiscrepancy) else None,
        ),
    )


def _basis_row(section: TemperatureBasis | RateBasis, smooth: bool) -> BasisRow:
    """`smooth`: whether a smoothness prior is on the coefficients; it is on those that the engine computes in."""
    if isinstance(section, TemperaturePolynomial | RatePolynomial):
        return BasisRow(
            basis="polynomial",
            degree=section.degree,
            centre=float(section.centre),
            scale=float(section.scale),
            prior_functions="monomial",
            smoothness_functions=section.internal if smooth else None,
        )
    own: Functions = section.basis
    alike: dict = {"basis": own, "prior_functions": own, "smoothness_functions": own if smooth else None}
    if isinstance(section, TemperatureSpline | RateSpline):
        return BasisRow(degree=section.degree, knots=tuple(float(k) for k in section.knots), **alike)
    return BasisRow(edges=tuple(float(e) for e in section.edges), **alike)


def _plain(value: float | None) -> float | None:
    return None if value is None else float(value)
