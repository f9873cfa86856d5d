"""The timeline of a spec: segments, readings and the sensor's model, as the contracts gradcal-timeline/2 of one gyro
and gradcal-unit-timeline/1 of an IMU."""

from collections.abc import Iterable
from typing import Any, Literal, cast

import numpy as np

from gradcal_jax import model
from gradcal_jax.api.build import Assembled, assemble, shapes_of
from gradcal_jax.api.imu_build import BuiltImu, build_imu
from gradcal_jax.api.turn_plan import gyro_of
from gradcal_jax.api.verdicts import finite, section_of
from gradcal_jax.files import Timeline
from gradcal_jax.files import imu_timeline as imu_rows
from gradcal_jax.files.bases import RateBasis, TemperatureBasis
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
from gradcal_jax.files.memory import too_large
from gradcal_jax.files.motion_plan import PlanSchedule, PlanStep
from gradcal_jax.files.moves import Axis, ResolvedMove
from gradcal_jax.files.plan import StandardPlan
from gradcal_jax.files.schedule import StandardSchedule
from gradcal_jax.files.sensor import AccelerometerTriad, Bias, GyroTriad, ScaleFactor, ScaleFactorDiscrepancy, Sensor
from gradcal_jax.files.spec import expect_spec, goes_on
from gradcal_jax.files.spec_sections import Spec
from gradcal_jax.information import segments_of
from gradcal_jax.model import (
    AXIS_NAMES,
    Channel,
    Hysteresis,
    Map,
    OwnTerm,
    PathTerm,
    SignalMap,
    TemperatureDifference,
    TurnOnTransient,
)
from gradcal_jax.trajectory import Move, frames

_CONSTANT = BasisRow(basis="polynomial", degree=0, centre=0.0, scale=1.0, prior_functions="monomial")


def timeline(spec: Spec) -> Timeline | imu_rows.ImuTimeline:
    """Every segment and reading of a spec's plan in SI; temperatures (°C) are the chamber's.

    Another program can compute the covariance from it alone. Of one gyro that the only axis of a table turns: contract
    gradcal-timeline/2, with every reading of the angle; else gradcal-unit-timeline/1, with the angles of all axes and
    attitudes. Errors: `ValueError` for a spec with [[done]].
    """
    if expect_spec(spec).done:
        raise goes_on("a timeline")
    if too := too_large(spec):
        raise MemoryError(too)
    return _of_channel(spec) if spec.turns_one_gyro else _of_imu(spec)


def _of_channel(spec: Spec) -> Timeline:
    built = assemble(spec)
    channel = cast("Axis", gyro_of(spec).axes[0])
    if isinstance(spec.schedule, StandardSchedule):
        segments, readings = _standard_rows(built, spec.schedule, channel)
    else:
        segments, readings = _gradient_rows(built, channel)
    standard = spec.plan if isinstance(spec.plan, StandardPlan) else None
    return Timeline(
        title=spec.title,
        estimator="best linear" if standard is None else standard.estimator,
        points=None if standard is None else standard.points,
        sensor=_sensor_row(spec.sensor, gyro_of(spec)),
        harmonics=_harmonic_rows(spec.rig.table.axis[0].angle),
        segments=tuple(segments),
        readings=tuple(readings),
    )


def _gradient_rows(built: Assembled, channel: Axis) -> tuple[list[SegmentRow], list[ReadingRow]]:
    line, schedule = built.trajectory(), built.schedule
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
        segments.append(SegmentRow(axis=channel, **row, **_temperatures_between(times, chamber, begin, finish)))

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
            own = _shape_row(move, float(turned[pieces].sum()))
            standstill += 1
        readings += [reading(float(end[k]), standstill if line.at_rest[k] else None) for k in pieces if line.read[k]]
        # A gap in which the chamber bends has several pieces, but the angle is read once, at its end.
        unused = bool(line.gap[last])
        if unused:
            readings.append(reading(float(end[last]), standstill, origin=True))
        add(
            float(start[first]),
            float(end[last]),
            table_axis=None if move is None or move.shape == "rest" else channel,
            standstill_id=None if line.moving[first] else standstill,
            read=unused or bool(np.any(line.read[pieces])),
            used=not unused,
            **own,
        )
    return segments, readings


def _standard_rows(
    built: Assembled, plan: StandardSchedule, channel: Axis
) -> tuple[list[SegmentRow], list[ReadingRow]]:
    accuracy = float(built.model.reference.rate_accuracy)
    soak, integration = plan.soak_each, plan.integration
    segments: list[SegmentRow] = []
    readings: list[ReadingRow] = []
    clock, point = 0.0, 0
    for temperature in plan.temperatures:
        at: dict = {"temperature_start": float(temperature), "temperature_end": float(temperature)}
        segments.append(
            SegmentRow(axis=channel, start=clock, duration=soak, shape="rest", read=False, used=False, **at)
        )
        clock += soak
        for rate in plan.rates:
            both: dict = {"axis": channel, "standstill_id": point, "duration": integration}
            turned = {
                "peak_rate": float(rate),
                "angle": float(rate) * integration,
                "table_axis": channel if rate else None,
            }
            shape = "constant" if rate else "rest"
            segments.append(SegmentRow(read=True, start=clock, shape=shape, **both, **turned, **at))
            clock += integration
            error: dict = {"white_std": 0.0, "offset_std": accuracy * abs(float(rate))}
            readings.append(ReadingRow(time=clock, kind="rate", rate=float(rate), **both, **error))
            point += 1
    return segments, readings


def _sensor_row(sensor: Sensor, gyro: GyroTriad) -> SensorRow:
    return SensorRow(
        arw=gyro.angle_random_walk,
        rate_random_walk=gyro.rate_random_walk or 0.0,
        turn_on_bias=gyro.turn_on_bias,
        drift=_process_rows(gyro.drift),
        scale_factor_instability=_process_rows(gyro.scale_factor_instability),
        thermal_lag=sensor.lag,
        sample_clock_error=sensor.clock_error or None,
        starts=_starts_row(sensor, gyro),
        **_of_temperature(gyro),
        bias=None if gyro.bias is None else _map_row(gyro.bias, gyro.axes[0]),
        scale_factor=None if gyro.scale_factor is None else _map_row(gyro.scale_factor, gyro.axes[0]),
    )


def _of_temperature(sensor: GyroTriad | AccelerometerTriad) -> dict[str, Any]:
    """The rows of a channel's errors by temperature and its slope."""
    error, gradient = sensor.thermometer_noise, sensor.gradient_sensitivity
    return {
        "temperature_error": None
        if error is None
        else TemperatureErrorRow(
            sigma=error.standard_deviation,
            tau=error.correlation_time,
            bias_slope=error.bias_slope,
            scale_factor_slope=error.scale_factor_slope,
        ),
        "bias_temperature_gradient": None if gradient is None else GradientSensitivityRow(prior=gradient.prior),
    }


def _starts_row(sensor: Sensor, gyro: GyroTriad) -> StartsRow:
    error = gyro.thermometer_noise
    return StartsRow(
        drift="stationary" if gyro.drift else None,
        rate_random_walk="zero" if gyro.rate_random_walk else None,
        scale_factor_instability="stationary" if gyro.scale_factor_instability else None,
        temperature_error=None if error is None else "stationary" if error.correlation_time else "constant",
        sample_clock_error="constant" if sensor.clock_error else None,
        turn_on_bias=None if not gyro.turn_on_bias else "constant" if gyro.bias is None else "prior",
    )


# --- an IMU -----------------------------------------------------------------------------------------------------------


def _of_imu(spec: Spec) -> imu_rows.ImuTimeline:
    """Every segment with attitudes, the terms of each channel, and all priors."""
    built, plan = build_imu(spec), spec.plain_schedule
    geometry, sensor, table = built.motion.geometry, spec.sensor, spec.rig.table
    return imu_rows.ImuTimeline(
        title=spec.title,
        frame="table axes" if sensor.frame is None else sensor.frame.fixed_by,
        site=imu_rows.SiteRow(
            latitude=float(geometry.latitude),
            gravity=float(geometry.gravity),
            earth_rate=_vector(geometry.earth_rate()),
        ),
        table=tuple(
            imu_rows.TableAxisRow(
                name=axis.name,
                direction=_vector(axis.unit_vector),
                reading_noise=axis.angle.reading_noise,
                standstill_offset=axis.angle.standstill_offset,
                read_every=finite(float(axis.angle.read_every)),
                harmonics=_harmonic_rows(axis.angle),
            )
            for axis in table.axis
        ),
        standing=table.standing,
        mountings=tuple(
            imu_rows.MountingRow(name=m.name, rotation=_matrix(rotation))
            for m, rotation in zip(table.mounting, np.asarray(geometry.mountings), strict=True)
        ),
        thermal_lag=sensor.lag,
        channels=tuple(
            _channel_row(c, sensor.gyro if c.kind == "gyro" else sensor.accelerometer) for c in built.model.channels
        ),
        installation=tuple(_installation_row(term) for term in built.model.installation),
        segments=tuple(_imu_rows(built, plan)),
    )


def _vector(values) -> imu_rows.Vector3:
    return cast("imu_rows.Vector3", tuple(float(v) for v in values))


def _matrix(values) -> imu_rows.Matrix3:
    return cast("imu_rows.Matrix3", tuple(_vector(row) for row in values))


def _channel_row(channel: Channel, triad: GyroTriad | AccelerometerTriad | None) -> imu_rows.ChannelRow:
    assert triad is not None
    own: dict[str, Any] = {
        "white": float(channel.model.angle_random_walk),
        "drift": _process_rows(triad.drift),
        "scale_factor_instability": _process_rows(triad.scale_factor_instability),
        "turn_on_bias": triad.turn_on_bias or None,
        **_of_temperature(triad),
    }
    if isinstance(triad, GyroTriad):
        own["rate_random_walk"] = triad.rate_random_walk or 0.0
    if outside := [term.name for term in channel.model.terms if isinstance(term, OwnTerm)]:
        raise ValueError(f"a timeline cannot contain an error term of your own, such as {outside[0]}: leave it out")
    terms = [_term_row(channel, term, triad) for term in channel.model.terms if isinstance(term, Map | SignalMap)]
    own["path"] = tuple(_path_row(channel, term) for term in channel.model.terms if isinstance(term, PathTerm))
    axis = AXIS_NAMES[channel.axis]
    return imu_rows.ChannelRow(name=channel.name, kind=channel.kind, axis=cast("Any", axis), terms=tuple(terms), **own)


def _path_row(channel: Channel, term: PathTerm) -> imu_rows.PathTermRow:
    kind: Any = "temperature gradient"
    own: dict[str, float] = {}
    if isinstance(term, Hysteresis):
        kind, own = "hysteresis", {"width": float(term.width)}
    elif isinstance(term, TurnOnTransient):
        kind, own = "transient", {"time_constant": float(term.time_constant)}
    elif isinstance(term, TemperatureDifference):
        kind, own = "temperature difference", {"time_constant": term.other.lag, "gain": term.gain}
    names = tuple(f"{channel.name}.{name}" for name in term.names())
    stds = tuple((1.0 / np.diagonal(term.prior_rows())).tolist())
    return imu_rows.PathTermRow(kind=kind, signals=term.signals, parameters=names, stds=stds, unit=term.unit, **own)


def _term_row(channel: Channel, term: Map | SignalMap, triad: GyroTriad | AccelerometerTriad) -> imu_rows.ImuTermRow:
    section = getattr(triad, section_of(triad, term.name))
    if isinstance(section, Bias | ScaleFactor):
        row = _map_row(section, AXIS_NAMES[channel.axis])
        signals = () if isinstance(section, Bias) else (f"rate {AXIS_NAMES[channel.axis]}",)
    else:
        assert isinstance(term, SignalMap)
        of = getattr(section, "temperature", None)
        over = _CONSTANT if of is None else _basis_row(of, smooth=False)
        shapes = _shape_rows(section, AXIS_NAMES[channel.axis])
        row, signals = MapRow(temperature=over, prior=section.prior, shapes=shapes), term.signals
    names = tuple(f"{channel.name}.{name}" for name in term.names())
    fields = {name: getattr(row, name) for name in MapRow.model_fields}
    fields["lag"] = None if term.late is None else term.late.lag
    return imu_rows.ImuTermRow(name=term.name, signals=signals, parameters=names, unit=term.unit, **fields)


_KINDS = {
    model.BaseTilt: "base",
    model.NonOrthogonality: "orthogonality",
    model.AxisHarmonics: "harmonics",
    model.MountingError: "mounting",
}


def _installation_row(term: model.InstallationTerm) -> imu_rows.InstallationRow:
    harmonics = isinstance(term, model.AxisHarmonics)
    return imu_rows.InstallationRow(
        kind=cast("Any", term.of if isinstance(term, model.CommonScale) else _KINDS[type(term)]),
        parameters=tuple(term.names()),
        stds=tuple(float(s) for s in term.stds),
        unit=term.unit,
        axis=term.axis_name if harmonics else None,
        orders=term.orders if harmonics else None,
        forces=term.forces if isinstance(term, model.CommonScale) and term.of == "sample_clock" else None,
    )


def _imu_rows(built: BuiltImu, plan: PlanSchedule) -> list[imu_rows.ImuSegmentRow]:
    motion = built.motion
    line, at = motion.line, segments_of(motion, built.model)
    before, after = (np.asarray(a) for a in motion.angles())
    attitude = np.asarray(frames(motion.geometry, before[at.first], motion.mounting[at.first]).attitude)
    begin, lasting = np.asarray(line.start)[at.first], at.sums(np.asarray(line.duration))
    ends = [s.start for s in plan.segments] + [plan.duration]
    chamber = [s.temperature_start for s in plan.segments] + [plan.segments[-1].temperature_end]
    steps = [step for step in plan.steps for _ in range(step.move.repeat)]
    axes = [axis.name for axis in built.spec.rig.table.axis]
    rows: list[imu_rows.ImuSegmentRow] = []
    stands = [0] * len(axes)

    def add(start: float, duration: float, step: PlanStep | None, k: int | None, **more: Any) -> None:
        moving = -1 if step is None else step.axis
        shape = {"shape": "rest"} if step is None or moving < 0 else _shape_row(step.move, float(step.move.angle))
        if moving >= 0:
            stands[moving] += 1
        first = at.first[0] if k is None else at.first[k]
        last = first if k is None else at.last[k]
        rows.append(
            imu_rows.ImuSegmentRow(
                start=start,
                duration=duration,
                axis=None if moving < 0 else axes[moving],
                angles_before=tuple(float(a) for a in before[first]),
                angles_after=tuple(float(a) for a in (before[first] if k is None else after[last])),
                attitude=_matrix(attitude[0 if k is None else k]),
                mounting=int(motion.mounting[first]),
                standstill_ids=tuple(None if l == moving else n for l, n in enumerate(stands)),
                **_temperatures_between(ends, chamber, start, start + duration),
                **shape,
                **more,
            )
        )

    if begin[0] > 0.0:
        add(0.0, float(begin[0]), None, None, read=(), used=False)
    number, stretch, move = 0, 0, np.asarray(line.segment)[at.first]
    step: PlanStep | None = None
    names = [c.name for c in built.model.channels]
    for k in range(len(at.first)):
        read = tuple(names[c] for c in at.row_channel[(at.row_segment == k) & at.used])
        gap = bool(line.gap[at.first[k]])
        if gap:
            step, number, stretch = None, 0, stretch + 1
        elif k == 0 or move[k] != move[k - 1]:
            inside = number < plan.stretches[stretch].cycles * len(steps)
            step, number = steps[number % len(steps)] if inside else None, number + 1
        add(float(begin[k]), float(lasting[k]), step, k, read=read, used=not gap)
    return rows


# --- rows of both -----------------------------------------------------------------------------------------------------


def _shape_row(move: Move | ResolvedMove, angle: float) -> dict[str, Any]:
    """The shape of a move and its parameters, by their names in the contract."""
    row: dict[str, Any] = {"shape": move.shape, "peak_rate": float(move.peak_rate), "angle": angle}
    if move.shape in ("cosine ramps", "linear ramps"):
        row["ramp"] = float(move.ramp)
    elif move.shape == "hand":
        row["unevenness"] = float(move.unevenness)
        row |= {"ramp": float(move.ramp)} if move.ramp else {}
    return row


def _map_row(section: Bias | ScaleFactor, axis: str) -> MapRow:
    """A gyro's bias or scale factor as a row of the contracts."""
    beyond, smooth = section.discrepancy, section.smoothness is not None
    bases: dict[Literal["temperature", "rate"], TemperatureBasis | RateBasis] = {"temperature": section.temperature}
    if isinstance(section, ScaleFactor):
        bases["rate"] = section.rate
    rows = {along: _basis_row(basis, smooth) for along, basis in bases.items()}
    return MapRow(
        temperature=rows["temperature"],
        rate=rows.get("rate"),
        prior=section.prior,
        shapes=_shape_rows(section, axis),
        smoothness=section.smoothness,
        # The coefficients of a polynomial have no neighbours.
        smoothness_along=tuple(along for along, basis in bases.items() if smooth and basis.basis != "polynomial"),
        discrepancy=None
        if beyond is None
        else DiscrepancyRow(
            sigma=beyond.standard_deviation,
            functions="legendre",
            temperature_degree=beyond.temperature_degree,
            rate_degree=beyond.rate_degree if isinstance(beyond, ScaleFactorDiscrepancy) else None,
        ),
    )


def _shape_rows(section: Any, axis: str) -> tuple[tuple[float, ...], ...] | None:
    shapes = shapes_of(section, axis)
    return None if shapes is None else tuple(map(tuple, shapes.T.tolist()))


def _basis_row(section: TemperatureBasis | RateBasis, smooth: bool) -> BasisRow:
    """A basis as a row. `smooth`: whether the map's (reported) coefficients have a smoothness prior."""
    functions: Functions = "monomial" if section.basis == "polynomial" else section.basis
    own: dict[str, Any] = {name: value for name, value in section if name in BasisRow.model_fields}
    return BasisRow(prior_functions=functions, smoothness_functions=functions if smooth else None, **own)


def _process_rows(sections: Iterable[Any]) -> tuple[ProcessRow, ...]:
    """Drifts, or instabilities of the scale factor."""
    return tuple(ProcessRow(sigma=r.standard_deviation, tau=r.correlation_time) for r in sections)


def _temperatures_between(times: Any, chamber: Any, begin: float, end: float) -> dict[str, Any]:
    """The chamber's temperature (°C) at both ends of a segment (s), and its bends between them."""
    bends = [(float(t), float(c)) for t, c in zip(times, chamber, strict=True) if begin + 1e-6 < t < end - 1e-6]
    first, last = (float(c) for c in np.interp([begin, end], times, chamber))
    return {"temperature_start": first, "temperature_end": last, "temperature_bends": tuple(bends) or None}


def _harmonic_rows(angle) -> tuple[HarmonicRow, ...]:
    return tuple(HarmonicRow(order=h.order, sigma=h.amplitude) for h in angle.harmonics)
