"""A page of a whole unit's plan: what it leaves of every quantity, where the unit points, what cannot be observed."""

from typing import Any

from gradcal_jax import api, plots, units
from gradcal_jax.api.unit_build import assemble_unit
from gradcal_jax.api.unit_prediction import posterior_of_unit
from gradcal_jax.api.unit_residual import UNITS_OF_TERMS, unit_residual
from gradcal_jax.api.versions import versions_of
from gradcal_jax.files.contracts import Prediction, RequirementRow
from gradcal_jax.files.unit_sensor import AccelerometerTriad, GyroTriad
from gradcal_jax.files.unit_spec import UnitSpec
from gradcal_jax.pages.coefficients import ParameterFact
from gradcal_jax.pages.facts import Facts
from gradcal_jax.pages.figures import Picture, picture, picture_key
from gradcal_jax.pages.numbers import figures
from gradcal_jax.pages.requirements import RequirementFact
from gradcal_jax.pages.sources import Sources
from gradcal_jax.units import time_text

_SUMMED = {"worst": "worst axis", "all": "all axes together"}
_MOST_ROWS = 80


def unit_facts(sources: Sources) -> Facts:
    """Every number of a page of a unit's plan."""
    spec = sources.unit
    assert spec is not None
    found = api.predict(spec)
    return Facts(
        title=spec.title or "Calibration of a unit",
        simulated=False,
        before_is="",
        requirements=tuple(_requirement(row) for row in found.requirements),
        parameters=tuple(_parameters(found)),
        axes=(),
        examples=(),
        exports=(),
        assumed=tuple(_assumed(spec)),
        course=None,
        provenance=(*((f"SHA-256 of {name}", digest) for name, digest in sources.paths), ("versions", _versions())),
        notes=found.warnings,
        maps=(),
    )


def _versions() -> str:
    return ", ".join(
        f"{name} {number}" for name, number in versions_of(("gradcal_jax", "numpy", "scipy", "jax")).items()
    )


def _requirement(row: RequirementRow) -> RequirementFact:
    summed = _SUMMED.get(row.axis, f"axis {row.axis}")
    return RequirementFact(
        name=row.name,
        axis=row.axis,
        quantity=row.quantity,
        statistic=f"{row.statistic}, {summed}",
        unit=row.unit,
        temperature_c=row.temperature_c,
        rate_dps=row.rate_dps,
        before=None,
        predicted=row.decisive,
        achieved=None,
        target=row.target,
        verdict=row.verdict,
        limited_by=row.limited_by,
        limit=None,
    )


def _parameters(found: Prediction) -> list[ParameterFact]:
    rows: list[ParameterFact] = []
    for row in found.parameters:
        channel, _, symbol = row.name.partition(".")
        kind, _, axis = channel.rpartition("_")
        unit, factor = UNITS_OF_TERMS.get(row.unit, (row.unit, 1.0))
        std = None if row.std is None else row.std * factor
        rows.append(ParameterFact(symbol, axis, kind, unit, None, None, std, None, None))
    return rows


def parameter_table(found: Prediction) -> list[tuple[str, ...]]:
    """The standard deviations of a unit's coefficients: a row for each, with a column for each axis; heads first."""
    return parameter_rows(_parameters(found))


def parameter_rows(parameters: "list[ParameterFact] | tuple[ParameterFact, ...]") -> list[tuple[str, ...]]:
    """As `parameter_table`, of facts: `multiplies` is the kind of channel."""
    table: dict[tuple[str, str, str], dict[str, str]] = {}
    for row in parameters:
        value = "not observable" if row.predicted_std is None else f"{row.predicted_std:.4g}"
        table.setdefault((row.multiplies, row.name, row.unit), {})[row.axis] = value
    return [
        ("parameter, 1σ", "x", "y", "z", "unit"),
        *(
            (f"{kind} {symbol}", *(values.get(axis, "") for axis in "xyz"), unit)
            for (kind, symbol, unit), values in table.items()
        ),
    ]


def _assumed(spec: UnitSpec) -> list[tuple[str, str]]:
    """The figures of noise and installation that the numbers rest on."""
    rows: list[tuple[str, str]] = []
    for name, triad in (("gyro", spec.sensor.gyro), ("accelerometer", spec.sensor.accelerometer)):
        if isinstance(triad, GyroTriad):
            rows.append(("angle random walk", str(triad.angle_random_walk)))
            rows += [("rate random walk", str(triad.rate_random_walk))] if triad.rate_random_walk else []
            rows += [
                ("scale-factor instability", f"{i.standard_deviation}, correlation time {i.correlation_time}")
                for i in triad.scale_factor_instability
            ]
        elif isinstance(triad, AccelerometerTriad):
            rows.append(("velocity random walk", str(triad.velocity_random_walk)))
        if triad is not None:
            for drift in triad.drift:
                rows.append((f"{name} drift", f"{drift.standard_deviation}, correlation time {drift.correlation_time}"))
    table, site = spec.rig.table, spec.rig.site
    given: list[tuple[str, Any]] = [
        ("thermal lag", spec.sensor.thermal_lag),
        ("sample clock error", spec.sensor.sample_clock_error),
        ("accuracy of gravity", site.gravity_accuracy or None),
        ("tilt of the base", table.tilt or None),
        ("azimuth of the base", table.azimuth or None),
    ]
    for axis in table.axis:
        given += [
            (f"{axis.name}: reading noise", axis.angle.reading_noise or None),
            (f"{axis.name}: standstill offset", axis.angle.standstill_offset or None),
            (f"{axis.name}: angle to the next axis", axis.orthogonality or None),
        ]
        given += [(f"{axis.name}: encoder error, {h.order} a turn", h.amplitude) for h in axis.angle.harmonics]
    given += [(f"mounting {k + 1}", m.accuracy or None) for k, m in enumerate(table.mounting)]
    return rows + [(name, str(value)) for name, value in given if value is not None]


def unit_words(sources: Sources, facts: Facts) -> dict[str, Any]:
    """What a page of a unit says besides, for the template."""
    spec = sources.unit
    assert spec is not None
    schedule = spec.schedule
    parts = (time_text(t) for t in (schedule.duration, schedule.soak, schedule.motion))
    cycles = sum(stretch.cycles for stretch in schedule.stretches)
    times = "{} in all: soak {}, motion {}.".format(*parts)
    rows = [
        (
            spec.rig.table.axis[step.axis].name if step.axis >= 0 else "",
            step.move.shape,
            time_text(step.move.duration),
            f"{figures(step.move.angle * units.DEG_PER_S, 6)} deg" if step.axis >= 0 else "",
            f"{figures(step.move.fastest * units.DEG_PER_S)} deg/s" if step.axis >= 0 else "",
            str(step.move.repeat) if step.move.repeat > 1 else "",
        )
        for step in schedule.steps[:_MOST_ROWS]
    ]
    left = len(schedule.steps) - _MOST_ROWS
    head, *parameters = parameter_rows(facts.parameters)
    return {
        "times": f"{times} A cycle of {time_text(schedule.period)}, made {cycles} times"
        + (f", in {len(spec.rig.table.mounting)} mountings." if len(spec.rig.table.mounting) > 1 else "."),
        "moves": rows,
        "more": f"… and {left} more moves: gradcal timeline prints all." if left > 0 else "",
        "parameter_head": list(head),
        "parameter_rows": parameters,
        "parameter_numbers": (1, 2, 3),
        "basis": "a: bias; b with the powers of rate and temperature, or s: scale factor; m: misalignment towards an "
        "axis; g: drift for a specific force along an axis; k2: second order. Digits at the end count powers of "
        "temperature.",
    }


def unit_pictures(sources: Sources) -> tuple[list[list[Picture]], list[Picture]]:
    """What is left of each requirement's quantity, and where up is, seen from the unit, at every rest."""
    spec = sources.unit
    assert spec is not None
    built = assemble_unit(spec)
    known = posterior_of_unit(built)
    left: list[Picture] = []
    for requirement in spec.requirement:
        found = unit_residual(built, known, requirement)
        words = f"{requirement.name}: residual of each element, one standard deviation."
        left.append(
            picture(
                picture_key(requirement.name),
                words,
                lambda ax, r=requirement, f=found: plots.draw_unit_residual(r, f, ax=ax),
                3.4,
            )
        )
    words = "Which way is up, seen from the unit, at every rest; the colour is the time, the size how long it rests."
    poses = picture("poses", words, lambda ax: plots.draw_poses(spec, ax=ax), 3.2, projection="mollweide")
    return ([left] if left else []), [poses]
