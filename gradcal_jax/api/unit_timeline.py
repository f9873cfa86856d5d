"""The timeline of a whole unit's spec, as the contract gradcal-unit-timeline/1."""

from typing import Any, cast

import numpy as np

from gradcal_jax import model
from gradcal_jax.api.contract_rows import (
    as_number,
    basis_row,
    map_row,
    process_rows,
    section_of,
    shape_row,
    temperatures_between,
)
from gradcal_jax.api.unit_build import AssembledUnit, assemble_unit
from gradcal_jax.files import unit_timeline as contract
from gradcal_jax.files.contracts import BasisRow, HarmonicRow, MapRow
from gradcal_jax.files.sensor import AccelerometerTriad, Bias, GyroTriad, ScaleFactor
from gradcal_jax.files.spec import goes_on
from gradcal_jax.files.unit_plan import UnitStep
from gradcal_jax.files.unit_spec import UnitSpec
from gradcal_jax.information import segments_of
from gradcal_jax.model import AXIS_NAMES, Channel, Map, SignalMap
from gradcal_jax.trajectory import frames

_CONSTANT = BasisRow(basis="polynomial", degree=0, centre=0.0, scale=1.0, prior_functions="monomial")


def unit_timeline(spec: UnitSpec) -> contract.UnitTimeline:
    """Every segment of a unit's plan with attitudes, the terms of each channel, and all priors. Errors: `ValueError`
    for a spec with [[done]]."""
    if spec.done:
        raise goes_on("a timeline")
    built = assemble_unit(spec)
    geometry, sensor, table = built.motion.geometry, spec.sensor, spec.rig.table
    return contract.UnitTimeline(
        title=spec.title,
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
                reading_noise=float(axis.angle.reading_noise),
                standstill_offset=float(axis.angle.standstill_offset),
                read_every=float(axis.angle.read_every),
                harmonics=tuple(HarmonicRow(order=h.order, sigma=float(h.amplitude)) for h in axis.angle.harmonics),
            )
            for axis in table.axis
        ),
        standing=table.standing,
        mountings=tuple(
            contract.MountingRow(name=m.name, rotation=_matrix(rotation))
            for m, rotation in zip(table.mounting, np.asarray(geometry.mountings), strict=True)
        ),
        thermal_lag=as_number(sensor.thermal_lag),
        channels=tuple(
            _channel(c, sensor.gyro if c.kind == "gyro" else sensor.accelerometer) for c in built.model.channels
        ),
        installation=tuple(_installation(term) for term in built.model.installation),
        segments=tuple(_segments(built)),
    )


def _vector(values) -> contract.Vector3:
    return cast("contract.Vector3", tuple(float(v) for v in values))


def _matrix(values) -> contract.Matrix3:
    return cast("contract.Matrix3", tuple(_vector(row) for row in values))


def _channel(channel: Channel, triad: GyroTriad | AccelerometerTriad | None) -> contract.ChannelRow:
    assert triad is not None
    own: dict[str, Any] = {"white": float(channel.model.angle_random_walk), "drift": process_rows(triad.drift)}
    if isinstance(triad, GyroTriad):
        own["rate_random_walk"] = float(triad.rate_random_walk or 0.0)
        own["scale_factor_instability"] = process_rows(triad.scale_factor_instability)
    terms = [_term(channel, term, triad) for term in channel.model.terms if isinstance(term, Map | SignalMap)]
    axis = AXIS_NAMES[channel.axis]
    return contract.ChannelRow(name=channel.name, kind=channel.kind, axis=cast("Any", axis), terms=tuple(terms), **own)


def _term(channel: Channel, term: Map | SignalMap, triad: GyroTriad | AccelerometerTriad) -> contract.UnitTermRow:
    section = getattr(triad, section_of(triad, term.name))
    if isinstance(section, Bias | ScaleFactor):
        row = map_row(section)
        signals = () if isinstance(section, Bias) else (f"rate {AXIS_NAMES[channel.axis]}",)
    else:
        assert isinstance(term, SignalMap)
        of = getattr(section, "temperature", None)
        over = _CONSTANT if of is None else basis_row(of, smooth=False)
        row, signals = MapRow(temperature=over, prior=as_number(section.prior)), term.signals
    names = tuple(f"{channel.name}.{name}" for name in term.names())
    fields = {name: getattr(row, name) for name in MapRow.model_fields}
    return contract.UnitTermRow(name=term.name, signals=signals, parameters=names, unit=term.unit, **fields)


_KINDS = {
    model.BaseTilt: "base",
    model.NonOrthogonality: "orthogonality",
    model.AxisHarmonics: "harmonics",
    model.MountingError: "mounting",
}


def _installation(term: model.InstallationTerm) -> contract.InstallationRow:
    harmonics = isinstance(term, model.AxisHarmonics)
    return contract.InstallationRow(
        kind=cast("Any", term.of if isinstance(term, model.CommonScale) else _KINDS[type(term)]),
        parameters=tuple(term.names()),
        stds=tuple(float(s) for s in term.stds),
        unit=term.unit,
        axis=term.axis_name if harmonics else None,
        orders=term.orders if harmonics else None,
    )


def _segments(built: AssembledUnit) -> list[contract.UnitSegmentRow]:
    motion, plan = built.motion, built.spec.schedule
    line, at = motion.line, segments_of(motion, built.model)
    before, after = (np.asarray(a) for a in motion.angles())
    attitude = np.asarray(frames(motion.geometry, before[at.first], motion.mounting[at.first]).attitude)
    begin, lasting = np.asarray(line.start)[at.first], at.sums(np.asarray(line.duration))
    ends = [s.start for s in plan.segments] + [plan.duration]
    chamber = [s.temperature_start for s in plan.segments] + [plan.segments[-1].temperature_end]
    steps = [step for step in plan.steps for _ in range(step.move.repeat)]
    axes = [axis.name for axis in built.spec.rig.table.axis]
    rows: list[contract.UnitSegmentRow] = []
    stands = [0] * len(axes)

    def add(start: float, duration: float, step: UnitStep | None, k: int | None, **more: Any) -> None:
        moving = -1 if step is None else step.axis
        shape = {"shape": "rest"} if step is None or moving < 0 else shape_row(step.move, float(step.move.angle))
        if moving >= 0:
            stands[moving] += 1
        first = at.first[0] if k is None else at.first[k]
        last = first if k is None else at.last[k]
        rows.append(
            contract.UnitSegmentRow(
                start=start,
                duration=duration,
                axis=None if moving < 0 else axes[moving],
                angles_before=tuple(float(a) for a in before[first]),
                angles_after=tuple(float(a) for a in (before[first] if k is None else after[last])),
                attitude=_matrix(attitude[0 if k is None else k]),
                mounting=int(motion.mounting[first]),
                standstill_ids=tuple(None if l == moving else n for l, n in enumerate(stands)),
                **temperatures_between(ends, chamber, start, start + duration),
                **shape,
                **more,
            )
        )

    if begin[0] > 0.0:
        add(0.0, float(begin[0]), None, None, read=(), used=False)
    number, stretch, move = 0, 0, np.asarray(line.segment)[at.first]
    step: UnitStep | None = None
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
