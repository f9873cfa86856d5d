"""The page of a whole unit's plan: residuals of every quantity, poses, moves."""

from collections.abc import Sequence
from typing import Any

from gradcal_jax import plots, units
from gradcal_jax.api.contract_rows import versions_of
from gradcal_jax.api.unit_build import assemble_unit, posterior_of_unit
from gradcal_jax.api.unit_residual import unit_residual
from gradcal_jax.files.calibration import Calibration
from gradcal_jax.files.contracts import Prediction
from gradcal_jax.files.schedule import StandardSchedule
from gradcal_jax.files.sensor import AccelerometerTriad, GyroTriad
from gradcal_jax.files.unit_spec import UnitSpec
from gradcal_jax.pages.coefficients import ParameterFact, parameters, predicted_deviations
from gradcal_jax.pages.figures import Picture, picture, picture_key
from gradcal_jax.pages.numbers import figures
from gradcal_jax.pages.plain_text import times_text
from gradcal_jax.pages.provenance import omitted_rows
from gradcal_jax.pages.requirements import SUMMED, RequirementFact, fact_of
from gradcal_jax.units import time_text

_MOST_ROWS = 80
BASIS = (
    "a: bias; b with the powers of rate and temperature, or s: scale factor; m: misalignment towards an axis; g: drift "
    "for a specific force along an axis; k2: second order. Digits at the end count powers of temperature."
)


def unit_requirements(prediction: Prediction, calibration: Calibration | None) -> list[RequirementFact]:
    """The requirements as predicted, and as achieved where there is a calibration."""
    results = {} if calibration is None else {row.name: row for row in calibration.result}
    unjudged = {} if calibration is None else {"verdict": None}
    return [
        fact_of(
            row,
            result := results.get(row.name),
            statistic=f"{row.statistic}, {SUMMED.get(row.axis or '', f'axis {row.axis}')}",
            **(unjudged if result is None else {}),
        )
        for row in prediction.requirements
    ]


def versions_row() -> tuple[str, str]:
    """The versions of the programs behind a page that no recipe names them for."""
    return "versions", ", ".join(map(" ".join, versions_of(("gradcal_jax", "numpy", "scipy", "jax")).items()))


def parameter_table(prediction: Prediction) -> list[tuple[str, ...]]:
    """The standard deviations of a unit's coefficients: a row for each, a column for each axis, after a head."""
    return parameter_rows(parameters(predicted_deviations(None, prediction), None, {}))


def parameter_rows(facts: Sequence[ParameterFact]) -> list[tuple[str, ...]]:
    """As `parameter_table`, from facts."""
    table: dict[tuple[str, str, str], dict[str, str]] = {}
    for row in facts:
        value = "not observable" if row.predicted_std is None else f"{row.predicted_std:.4g}"
        if row.value is not None:
            value = "not observed" if row.std is None else f"{row.value:.5g} ± {row.std:.2g}"
        table.setdefault((row.kind, row.name, row.unit), {})[row.axis] = value
    estimated = any(row.value is not None for row in facts)
    return [
        ("parameter ± 1σ" if estimated else "parameter, 1σ", "x", "y", "z", "unit"),
        *(
            (f"{kind} {symbol}", *(values.get(axis, "") for axis in "xyz"), unit)
            for (kind, symbol, unit), values in table.items()
        ),
    ]


def assumed_of_unit(spec: UnitSpec) -> list[tuple[str, str]]:
    """The figures of noise and installation behind the numbers."""
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
    installation: list[tuple[str, Any]] = [
        ("thermal lag", spec.sensor.thermal_lag),
        ("sample clock error", spec.sensor.clock_text),
        ("accuracy of gravity", site.gravity_accuracy or None),
        ("tilt of the base", table.tilt or None),
        ("azimuth of the base", table.azimuth or None),
    ]
    for axis in table.axis:
        installation += [
            (f"{axis.name}: reading noise", axis.angle.reading_noise or None),
            (f"{axis.name}: standstill offset", axis.angle.standstill_offset or None),
            (f"{axis.name}: angle to the next axis", axis.orthogonality or None),
        ]
        installation += [(f"{axis.name}: encoder error, {h.order} a turn", h.amplitude) for h in axis.angle.harmonics]
    installation += [(f"mounting {k + 1}", m.accuracy or None) for k, m in enumerate(table.mounting)]
    return [*rows, *((name, str(value)) for name, value in installation if value is not None), *omitted_rows(spec)]


def plan_words(spec: UnitSpec) -> dict[str, Any]:
    """The plan in words and rows, for the template."""
    schedule = spec.schedule
    lasts = times_text(schedule.duration, schedule.soak, schedule.motion)
    if isinstance(schedule, StandardSchedule):
        return {"times": f"{lasts}. {len(schedule.points)} points.", "moves": [], "more": ""}
    cycles = sum(stretch.cycles for stretch in schedule.stretches)
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
    return {
        "times": f"{lasts}. A cycle of {time_text(schedule.period)}, made {cycles} times"
        + (f", in {len(spec.rig.table.mounting)} mountings." if len(spec.rig.table.mounting) > 1 else "."),
        "moves": rows,
        "more": f"… and {left} more moves: gradcal timeline prints all." if left > 0 else "",
    }


def unit_pictures(spec: UnitSpec) -> tuple[list[list[Picture]], list[Picture]]:
    """The residuals of each requirement's quantity, and the vertical in the unit's frame at every rest."""
    built = assemble_unit(spec)
    known = posterior_of_unit(built)
    left: list[Picture] = []
    for requirement in spec.requirement:
        residual = unit_residual(built, known, requirement)
        words = f"{requirement.name}: residual of each element as predicted, one standard deviation."
        draw = lambda ax, r=requirement, f=residual: plots.draw_unit_residual(r, f, ax=ax)  # noqa: E731
        left.append(picture(picture_key(requirement.name), words, draw, 3.4))
    words = "Which way is up, seen from the unit, at every rest; the colour is the time, the size how long it rests."
    poses = picture("poses", words, lambda ax: plots.draw_poses(spec, ax=ax), 3.2, projection="mollweide")
    return ([left] if left else []), [poses]
