"""The timeline of a spec: segments, readings and the channels' models, as the contract gradcal-timeline/3."""

from collections.abc import Iterable
from typing import Any, Literal, cast

import numpy as np

from gradcal_jax import model
from gradcal_jax.information import segments_of
from gradcal_jax.information.error_budget import UNKNOWN_EARTH_RATE
from gradcal_jax.information.verdicts import finite, section_of
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
from gradcal_jax.model.build import shapes_of
from gradcal_jax.model.imu_build import BuiltImu, build_imu, has_common_clock
from gradcal_jax.motion import frames
from gradcal_jax.spec.bases import RateBasis, TemperatureBasis
from gradcal_jax.spec.motion_plan import PlanSchedule
from gradcal_jax.spec.moves import ResolvedMove
from gradcal_jax.spec.plan import StandardPlan
from gradcal_jax.spec.schedule import StandardSchedule
from gradcal_jax.spec.sensor import AccelerometerTriad, Bias, GyroTriad, ScaleFactor, ScaleFactorDiscrepancy
from gradcal_jax.spec.spec import expect_spec, goes_on
from gradcal_jax.spec.spec_sections import Spec
from gradcal_jax.tables import timeline as contract
from gradcal_jax.tables.contracts import (
    BasisRow,
    DiscrepancyRow,
    Functions,
    GradientSensitivityRow,
    HarmonicRow,
    MapRow,
    ProcessRow,
    TemperatureErrorRow,
)
from gradcal_jax.tables.timeline import Timeline

_CONSTANT = BasisRow(basis="polynomial", degree=0, centre=0.0, scale=1.0, prior_functions="monomial")


def timeline(spec: Spec) -> Timeline:
    """Every segment and reading of a spec's plan in SI; temperatures (°C) are the chamber's.

    Another program can compute the covariance from it alone: contract gradcal-timeline/3. Errors: `ValueError` for a
    spec with [[done]] or with an error term from outside the package.
    """
    if expect_spec(spec).done:
        raise goes_on("a timeline")
    built = build_imu(spec)
    geometry, sensor, table = built.motion.geometry, spec.sensor, spec.rig.table
    standard = spec.plan if isinstance(spec.plan, StandardPlan) else None
    return Timeline(
        title=spec.title,
        estimator="best linear" if standard is None else standard.estimator,
        points=None if standard is None else standard.points,
        frame="table axes" if sensor.frame is None else sensor.frame.fixed_by,
        site=contract.SiteRow(
            latitude=float(geometry.latitude),
            gravity=float(geometry.gravity),
            earth_rate=_vector(geometry.earth_rate()),
        ),
        table=tuple(
            contract.TableAxisRow(
                name=axis.name,
                direction=_vector(axis.unit_vector),
                reading_noise=axis.angle.reading_noise,
                standstill_offset=axis.angle.standstill_offset,
                timing_error=axis.angle.timing_error,
                read_every=finite(float(axis.angle.read_every)),
                harmonics=tuple(HarmonicRow(order=h.order, sigma=h.amplitude) for h in axis.angle.harmonics),
            )
            for axis in table.axis
        ),
        standing=table.standing,
        rate_accuracy=float(built.model.encoder.rate),
        mountings=tuple(
            contract.MountingRow(name=m.name, rotation=_matrix(rotation))
            for m, rotation in zip(table.mounting, np.asarray(geometry.mountings), strict=True)
        ),
        thermal_lag=sensor.lag,
        channels=tuple(_channel_row(spec, c) for c in built.model.channels),
        installation=tuple(_installation_row(term) for term in built.model.installation),
        **_rows_of_plan(built),
    )


def _vector(values) -> contract.Vector3:
    return cast("contract.Vector3", tuple(float(v) for v in values))


def _matrix(values) -> contract.Matrix3:
    return cast("contract.Matrix3", tuple(_vector(row) for row in values))


def _channel_row(spec: Spec, channel: Channel) -> contract.ChannelRow:
    triad: GyroTriad | AccelerometerTriad = getattr(spec.sensor, channel.kind)
    error, gradient = triad.thermometer_noise, triad.gradient_sensitivity
    own: dict[str, Any] = {
        "white": float(channel.model.angle_random_walk),
        "drift": _process_rows(triad.drift),
        "scale_factor_instability": _process_rows(triad.scale_factor_instability),
        "turn_on_bias": triad.turn_on_bias or None,
    }
    if error is not None:
        own["temperature_error"] = TemperatureErrorRow(
            sigma=error.standard_deviation,
            tau=error.correlation_time,
            bias_slope=error.bias_slope,
            scale_factor_slope=error.scale_factor_slope,
        )
    if gradient is not None:
        own["bias_temperature_gradient"] = GradientSensitivityRow(prior=gradient.prior)
    if isinstance(triad, GyroTriad):
        own["rate_random_walk"] = triad.rate_random_walk or 0.0
        own["sample_clock_error"] = None if has_common_clock(spec) else spec.sensor.clock_error or None
        unknown = spec.rig.site.is_unknown and triad.bias is None
        own["unknown_earth_rate"] = UNKNOWN_EARTH_RATE if unknown else None
    if outside := [term.name for term in channel.model.terms if isinstance(term, OwnTerm)]:
        raise ValueError(f"a timeline cannot contain an error term of your own, such as {outside[0]}: leave it out")
    terms = [_term_row(channel, term, triad) for term in channel.model.terms if isinstance(term, Map | SignalMap)]
    own["path"] = tuple(_path_row(channel, term) for term in channel.model.terms if isinstance(term, PathTerm))
    axis = AXIS_NAMES[channel.axis]
    return contract.ChannelRow(name=channel.name, kind=channel.kind, axis=cast("Any", axis), terms=tuple(terms), **own)


def _path_row(channel: Channel, term: PathTerm) -> contract.PathTermRow:
    kind: Any = "temperature gradient"
    own: dict[str, float] = {}
    if isinstance(term, Hysteresis):
        if term.over_temperature is not None:
            raise ValueError("a timeline cannot contain the over_temperature of a hysteresis: leave it out")
        kind, own = "hysteresis", {"width": float(term.width)}
    elif isinstance(term, TurnOnTransient):
        kind, own = "transient", {"time_constant": float(term.time_constant)}
    elif isinstance(term, TemperatureDifference):
        kind, own = "temperature difference", {"time_constant": term.other.lag, "gain": term.gain}
    names = tuple(f"{channel.name}.{name}" for name in term.names())
    stds = tuple((1.0 / np.diagonal(term.prior_rows())).tolist())
    return contract.PathTermRow(kind=kind, signals=term.signals, parameters=names, stds=stds, unit=term.unit, **own)


def _term_row(channel: Channel, term: Map | SignalMap, triad: GyroTriad | AccelerometerTriad) -> contract.TermRow:
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
    return contract.TermRow(name=term.name, signals=signals, parameters=names, unit=term.unit, **fields)


_KINDS = {
    model.BaseTilt: "base",
    model.NonOrthogonality: "orthogonality",
    model.AxisHarmonics: "harmonics",
    model.MountingError: "mounting",
}


def _installation_row(term: model.InstallationTerm) -> contract.InstallationRow:
    harmonics = isinstance(term, model.AxisHarmonics)
    return contract.InstallationRow(
        kind=cast("Any", term.of if isinstance(term, model.CommonScale) else _KINDS[type(term)]),
        parameters=tuple(term.names()),
        stds=tuple(float(s) for s in term.stds),
        unit=term.unit,
        axis=term.axis_name if harmonics else None,
        orders=term.orders if harmonics else None,
        forces=term.forces if isinstance(term, model.CommonScale) and term.of == "sample_clock" else None,
    )


class _Course:
    """What a plan does, segment by segment: the shape of the motion, and the chamber's temperature."""

    def __init__(self, plan: PlanSchedule | StandardSchedule) -> None:
        self._plan, self._number = plan, 0
        self._stretch = -1 if isinstance(plan, StandardSchedule) else 0

    def pause(self) -> None:
        """A segment that is not used begins."""
        self._number, self._stretch = 0, self._stretch + 1

    def move(self) -> tuple[int, dict[str, Any]]:
        """The axis (−1: none) that the next segment moves, and its shape."""
        plan, number = self._plan, self._number
        self._number += 1
        if isinstance(plan, StandardSchedule):
            rate = float(plan.rates[number])
            shape = {"shape": "constant", "peak_rate": rate, "angle": rate * plan.integration}
            return (0, shape) if rate else (-1, {"shape": "rest"})
        steps = (*plan.every_step, *plan.after)
        # After the moves of the spec the table stands until the stretch ends.
        if number >= plan.stretches[self._stretch].cycles * len(steps) - len(plan.after):
            return -1, {"shape": "rest"}
        step = steps[number % len(steps)]
        if step.axis < 0:
            return -1, {"shape": "rest"}
        return step.axis, _shape_row(step.move)

    def temperatures(self, begin: float, end: float) -> dict[str, Any]:
        """The chamber's temperature (°C) at both ends of a segment (s), and its bends between them."""
        if isinstance(self._plan, StandardSchedule):
            at = float(self._plan.temperatures[self._stretch])
            return {"temperature_start": at, "temperature_end": at}
        segments = self._plan.segments
        times = [s.start for s in segments] + [self._plan.duration]
        chamber = [s.temperature_start for s in segments] + [segments[-1].temperature_end]
        bends = [(t, c) for t, c in zip(times, chamber, strict=True) if begin + 1e-6 < t < end - 1e-6]
        first, last = (float(c) for c in np.interp([begin, end], times, chamber))
        return {"temperature_start": first, "temperature_end": last, "temperature_bends": tuple(bends) or None}


def _rows_of_plan(built: BuiltImu) -> dict[str, Any]:
    """The segments and the readings of a plan."""
    motion, line, course = built.motion, built.motion.line, _Course(built.spec.schedule)
    first = np.flatnonzero(np.diff(line.segment, prepend=line.segment[0] - 1))
    last = np.append(first[1:], line.piece_count) - 1
    before, after = (np.asarray(a) for a in motion.angles())
    attitude = np.asarray(frames(motion.geometry, before[first], motion.mounting[first]).attitude)
    start, end = np.asarray(line.start), np.asarray(line.start + line.duration)
    axes = [axis.name for axis in built.spec.rig.table.axis]
    segments: list[contract.SegmentRow] = []
    stands, after_segment = [0] * len(axes), list[tuple[int, ...]]()

    def add(k: int, begin: float, finish: float, moving: int, **more: Any) -> None:
        segments.append(
            contract.SegmentRow(
                start=begin,
                duration=finish - begin,
                axis=None if moving < 0 else axes[moving],
                angles_before=tuple(before[first[k]].tolist()),
                attitude=_matrix(attitude[k]),
                mounting=int(motion.mounting[first[k]]),
                standstill_ids=tuple(None if l == moving else n for l, n in enumerate(stands)),
                **course.temperatures(begin, finish),
                **more,
            )
        )

    if start[0] > 0.0:
        add(0, 0.0, float(start[0]), -1, shape="rest", angles_after=tuple(before[0].tolist()), used=False)
    for k, (a, b) in enumerate(zip(first, last, strict=True)):
        moving, shape = -1, {"shape": "rest"}
        if used := not line.gap[b]:
            moving, shape = course.move()
        else:
            course.pause()
        if moving >= 0:
            stands[moving] += 1
        after_segment.append(tuple(stands))
        add(k, float(start[a]), float(end[b]), moving, used=used, angles_after=tuple(after[b].tolist()), **shape)
    at, names = segments_of(motion, built.model), [c.name for c in built.model.channels]
    channels: dict[int, list[str]] = {}
    for row, segment in zip(at.row_channel[at.used].tolist(), at.row_segment[at.used].tolist(), strict=True):
        channels.setdefault(segment, []).append(names[row])
    readings: list[contract.ReadingRow] = []
    for k, own in channels.items():
        a, b = at.first[k], at.last[k]
        ids = after_segment[int(np.searchsorted(last, b))]
        on_the_move = [not line.at_rest[b] and l == motion.axis[b] for l in range(len(axes))]
        readings.append(
            contract.ReadingRow(
                start=float(start[a]),
                time=float(end[b]),
                channels=tuple(own),
                standstill_ids=tuple(None if moves else n for n, moves in zip(ids, on_the_move, strict=True)),
                rate=float(line.terms[b, 0]) if line.rates else None,
            )
        )
    return {"segments": tuple(segments), "readings": tuple(readings)}


def _shape_row(move: ResolvedMove) -> dict[str, Any]:
    """The shape of a move and its parameters, by their names in the contract."""
    row: dict[str, Any] = {"shape": move.shape, "peak_rate": float(move.peak_rate), "angle": float(move.angle)}
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
