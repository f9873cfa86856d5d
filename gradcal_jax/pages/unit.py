"""A page of a whole unit: residuals of every quantity, poses, run and calibration."""

from typing import Any

from gradcal_jax import api, plots, units
from gradcal_jax.api.contract_rows import coefficient_rows, versions_of
from gradcal_jax.api.unit_build import assemble_unit, posterior_of_unit
from gradcal_jax.api.unit_residual import UNITS_OF_TERMS, unit_residual
from gradcal_jax.files.contracts import Prediction, RequirementRow
from gradcal_jax.files.schedule import StandardSchedule
from gradcal_jax.files.sensor import AccelerometerTriad, GyroTriad
from gradcal_jax.files.unit_calibration import UnitCalibration, UnitResult
from gradcal_jax.files.unit_spec import UnitSpec
from gradcal_jax.pages.applying import exports_of
from gradcal_jax.pages.coefficients import ParameterFact, agreement, parameter_fact
from gradcal_jax.pages.figures import Picture, picture, picture_key
from gradcal_jax.pages.numbers import figures
from gradcal_jax.pages.plain_text import times_text
from gradcal_jax.pages.provenance import omitted_rows, provenance_rows
from gradcal_jax.pages.report_data import AxisFact, ReportData, axis_fact
from gradcal_jax.pages.requirements import RequirementFact, fact_of, result_alone
from gradcal_jax.pages.run_history import history_of
from gradcal_jax.pages.sources import Sources
from gradcal_jax.plots.unit_calibration import draw_unit_term, panels_of
from gradcal_jax.units import time_text

_SUMMED = {"worst": "worst axis", "all": "all axes together"}
_MOST_ROWS = 80


def unit_report_data(sources: Sources) -> ReportData:
    """All numbers of a page of a unit: of its plan, its calibration, or both. Raises `ValueError` for a run that never
    began."""
    spec, calibration, run = sources.unit, sources.unit_calibration, sources.run
    prediction = None if spec is None else api.predict(spec)
    history = None if run is None else history_of(run)
    hidden = _hidden(sources)
    notes = [*sources.notes, *(() if prediction is None else prediction.warnings)]
    axes: tuple[AxisFact, ...] = ()
    if calibration is not None:
        values = {row["name"]: row["value"] for row in coefficient_rows(calibration)}
        agreed = agreement(values, calibration.covariance, hidden)
        axes = (axis_fact(calibration, calibration.serial_number, (), agreed),)
        if calibration.lacks is not None:
            notes.append(calibration.lacks)
        if calibration.unobservable:
            notes.append(f"the data say nothing of {', '.join(calibration.unobservable)}")
    simulated = any(source is not None and source.simulated for source in (history, calibration))
    versions = versions_of(("gradcal_jax", "numpy", "scipy", "jax")).items()
    title = (None if spec is None else spec.title) or (None if calibration is None else calibration.title)
    return ReportData(
        title=title or "Calibration of a unit",
        simulated=simulated,
        before_is="",
        requirements=tuple(_requirements(prediction, calibration)),
        parameters=tuple(_parameters(prediction, calibration, hidden)),
        axes=axes,
        examples=(),
        exports=() if calibration is None else tuple(exports_of(calibration, sources.calibration_name)),
        assumed=() if spec is None else tuple(_assumed(spec)),
        history=history,
        provenance=(*provenance_rows(sources), ("versions", ", ".join(map(" ".join, versions)))),
        notes=tuple(notes),
        maps=(),
    )


def _hidden(sources: Sources) -> dict[str, float]:
    """The true values of a simulated unit and table, by name."""
    truth, calibration = sources.hidden_truth, sources.unit_calibration
    if truth is None or calibration is None:
        return {}
    return truth.get("installation", {}) | truth.get("units", {}).get(calibration.serial_number, {})


def _requirements(prediction: Prediction | None, calibration: UnitCalibration | None) -> list[RequirementFact]:
    """The requirements as predicted, and as achieved where there is a calibration."""
    results = {} if calibration is None else {row.name: row for row in calibration.result}
    if prediction is not None:
        verdict = {} if calibration is None else {"verdict": None}
        return [
            fact_of(row, result, statistic=_summed(row), **(verdict if result is None else {}))
            for row in prediction.requirements
            for result in (results.get(row.name),)
        ]
    return [result_alone(row, _summed(row)) for row in results.values()]


def _summed(row: RequirementRow | UnitResult) -> str:
    return f"{row.statistic}, {_SUMMED.get(row.axis, f'axis {row.axis}')}"


def _parameters(
    prediction: Prediction | None, calibration: UnitCalibration | None, hidden: dict[str, float]
) -> list[ParameterFact]:
    predicted = {} if prediction is None else {row.name: row for row in prediction.parameters}
    if calibration is None:
        return [_parameter(row.name, row.unit, None, None, row.std, None) for row in predicted.values()]
    return [
        _parameter(name, row["unit"], row["value"], row["std"], known and known.std, hidden.get(name))
        for row in coefficient_rows(calibration)
        for name, known in ((row["name"], predicted.get(row["name"])),)
    ]


def _parameter(name: str, si: str, *numbers: float | None) -> ParameterFact:
    channel, _, symbol = name.partition(".")
    kind, _, axis = channel.rpartition("_")
    return parameter_fact(symbol, axis, kind, *UNITS_OF_TERMS.get(si, (si, 1.0)), *numbers)


def parameter_table(prediction: Prediction) -> list[tuple[str, ...]]:
    """The standard deviations of a unit's coefficients: a row for each, a column for each axis, after a head."""
    return parameter_rows(_parameters(prediction, None, {}))


def parameter_rows(parameters: "list[ParameterFact] | tuple[ParameterFact, ...]") -> list[tuple[str, ...]]:
    """As `parameter_table`, from facts whose `multiplies` is the kind of channel."""
    table: dict[tuple[str, str, str], dict[str, str]] = {}
    for row in parameters:
        value = "not observable" if row.predicted_std is None else f"{row.predicted_std:.4g}"
        if row.value is not None:
            value = "not observed" if row.std is None else f"{row.value:.5g} ± {row.std:.2g}"
        table.setdefault((row.multiplies, row.name, row.unit), {})[row.axis] = value
    estimated = any(row.value is not None for row in parameters)
    return [
        ("parameter ± 1σ" if estimated else "parameter, 1σ", "x", "y", "z", "unit"),
        *(
            (f"{kind} {symbol}", *(values.get(axis, "") for axis in "xyz"), unit)
            for (kind, symbol, unit), values in table.items()
        ),
    ]


def _assumed(spec: UnitSpec) -> list[tuple[str, str]]:
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


def unit_words(sources: Sources, data: ReportData) -> dict[str, Any]:
    """Further texts and tables on the page of a unit, for the template."""
    head, *parameters = parameter_rows(data.parameters)
    return {
        **_plan_words(sources.unit),
        "table": _table_errors(sources),
        "order": "" if sources.unit_calibration is None else sources.unit_calibration.order,
        "parameter_head": list(head),
        "parameter_rows": parameters,
        "parameter_numbers": (1, 2, 3),
        "basis": "a: bias; b with the powers of rate and temperature, or s: scale factor; m: misalignment towards an "
        "axis; g: drift for a specific force along an axis; k2: second order. Digits at the end count powers of "
        "temperature.",
    }


def _plan_words(spec: UnitSpec | None) -> dict[str, Any]:
    if spec is None:
        return {"times": "", "moves": [], "more": ""}
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


def _table_errors(sources: Sources) -> dict[str, Any] | None:
    """The estimated errors of the table, beside the spec's uncertainty and a simulation's true values."""
    calibration = sources.unit_calibration
    if calibration is None or not calibration.table:
        return None
    hidden = _hidden(sources)
    rows: list[tuple[str, ...]] = []
    for error in calibration.table:
        unit, factor = UNITS_OF_TERMS.get(error.unit, (error.unit, 1.0))
        numbers = (error.value, error.standard_deviation, error.prior, *([hidden[error.name]] if hidden else []))
        rows.append((error.name.replace("_", " "), *(figures(n * factor) for n in numbers), unit))
    head = ["error of the table", "estimate", "1σ", "known to", *(["hidden truth"] if hidden else []), "unit"]
    return {"head": head, "rows": rows, "numbers": tuple(range(1, len(head) - 1))}


def unit_pictures(sources: Sources) -> tuple[list[list[Picture]], list[Picture]]:
    """The residuals of each requirement's quantity, and the vertical in the unit's frame at every rest."""
    spec = sources.unit
    if spec is None:
        return [], []
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


def unit_calibration_pictures(calibration: UnitCalibration) -> list[Picture]:
    """The maps of a unit's calibration."""
    return [
        picture(
            picture_key(f"found {title}"),
            f"{title[:1].upper()}{title[1:]} as estimated; the bands are one standard deviation.",
            lambda ax, k=kind, n=name: draw_unit_term(calibration, k, n, ax=ax),
            3.4,
        )
        for kind, name, title in panels_of(calibration)
    ]
