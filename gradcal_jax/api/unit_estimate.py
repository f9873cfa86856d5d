"""The estimate of a whole unit from its log and spec: parameters of unit and table, tests, verdicts, a calibration.

The spec describes the noise, the table and the terms; the executed motion is read from the log.
"""

import itertools
import math
from collections.abc import Callable, Sequence
from dataclasses import replace
from typing import Any, NamedTuple

import numpy as np

from gradcal_jax import estimation, trajectory
from gradcal_jax.api.build import move_of
from gradcal_jax.api.calibration import excess_of, noise_sentences, not_valid
from gradcal_jax.api.contract_rows import (
    coefficient_rows,
    judged_by_data,
    requirement_fields,
)
from gradcal_jax.api.contradictions import (
    beyond_the_data,
    diagnosis_sentences,
    omitted_sentences,
    refuse_implausible,
    refuse_misaligned,
    refuse_other_units,
)
from gradcal_jax.api.estimate_options import Options
from gradcal_jax.api.estimated_calibration import calibrated_channels, calibration_of, tests_by_name
from gradcal_jax.api.executed_part import lacks_of
from gradcal_jax.api.fitted_lag import Lag, fitted_lag
from gradcal_jax.api.log_rows import with_options
from gradcal_jax.api.path_dependence import (
    HEATING_AGAINST_COOLING,
    BiasCurve,
    PathDependence,
    bias_curves,
    path_dependence,
)
from gradcal_jax.api.prediction import requirement_row
from gradcal_jax.api.record_faults import RecordFaults, without_bad_rows
from gradcal_jax.api.recorded_rows import read_by_events, unit_rows
from gradcal_jax.api.structure_tests import structure_in_words, structure_tests
from gradcal_jax.api.systematic import (
    EstimatedRun,
    budget_of_unit_estimate,
    omitted_noise_of_unit,
    ramp_of_record,
    unseen_errors,
)
from gradcal_jax.api.unit_build import AssembledUnit, assemble_unit, course_before
from gradcal_jax.api.unit_channel import counting_less
from gradcal_jax.api.unit_residual import internal_misalignments
from gradcal_jax.api.unit_sentences import one_way_sentences, prior_deviations
from gradcal_jax.display import summary
from gradcal_jax.estimation import (
    Consistency,
    ExecutedUnit,
    PlannedMove,
    Plateaus,
    StructureTest,
    Test,
    UnitEstimate,
    UnitReadings,
    UnitRows,
)
from gradcal_jax.files.absent import branch_sentences
from gradcal_jax.files.calibration import (
    Calibration,
)
from gradcal_jax.files.calibration.correction import correct_triads, followed
from gradcal_jax.files.contracts import RequirementRow
from gradcal_jax.files.log import Log, LogError
from gradcal_jax.files.plan import StandardPlan
from gradcal_jax.files.quantity import Quantity
from gradcal_jax.files.requirement_table import narrow_table
from gradcal_jax.files.schedule import StandardSchedule
from gradcal_jax.files.unit_spec import UnitSpec
from gradcal_jax.formulas import EARTH_RATE
from gradcal_jax.information import Posterior, segments_of
from gradcal_jax.model import (
    KINDS,
)

# Assumed time between two recordings of one unit in different mountings, s: far longer than any drift lasts.
_REHUNG_S = 6 * 3600.0
# Residuals of this many times the noise come from a wrong table, order of axes, or sign.
_ABSURD = 100.0
# Temperatures (°C) and rates (rad/s) of a calibration that is used at those of its own data alone.
_EVERYWHERE = (-273.0, 1000.0), (-1e4, 1e4)
# Parts of a planned move's time at which its angle is tabulated.
_PROFILE = 512
# Change of temperature from the begin to the end of a record, as a share of its range, beyond which it goes one way.
_ONE_WAY = 0.8
# Fewer moves are not divided into odd and even ones.
_FEWEST_MOVES = 4
# An error of the table of more than this many times its standard deviation by the spec is reported.
_CONTRADICTED = 4.0


class InternalMisalignment(NamedTuple):
    """A misalignment that no rotation of the unit changes, rad: between two axes, or between the triads."""

    name: str
    value: float
    std: float


class UnitReport(NamedTuple):
    """The estimate of one unit, in SI except `requirements`. `channels`: tests of χ² and whiteness of each channel's
    rows; `gravity`: rms of |f| − g over the rests, m/s², before the calibration and after it."""

    unit: str
    built: AssembledUnit
    executed: ExecutedUnit
    solution: UnitEstimate
    calibration: Calibration
    requirements: tuple[RequirementRow, ...]
    consistency: Consistency
    channels: dict[str, tuple[Test, Test]]
    internal: tuple[InternalMisalignment, ...]
    gravity: tuple[float, float] | None
    messages: tuple[str, ...]
    path: PathDependence | None = None
    """Where heating and cooling disagree, what they differ by, and the play that explains it."""
    structure: tuple[tuple[str, StructureTest], ...] = ()
    """Of each gyro (by name), a test of every polynomial map for more structure."""
    curves: tuple[BiasCurve, ...] = ()
    """The bias of every channel over the path of the temperature."""

    __repr__ = summary

    def _shown(self) -> list[str]:
        rows, one = self.requirements, self.calibration
        return [
            f"Estimate of {self.unit}" + (", SIMULATED" if one.simulated else ""),
            one.valid_range,
            *([f"contradicted: {', '.join(one.contradicted)}"] if one.contradicted else []),
            *([f"not observable: {', '.join(one.unobservable)}"] if one.unobservable else []),
            *(f"note: {message}" for message in self.messages[:2]),
            narrow_table(rows),
        ]

    @property
    def as_wished(self) -> bool:
        """Whether every target is met, every parameter observable and every test passed."""
        met = all(row.verdict in (None, "met") for row in self.requirements)
        return met and not self.calibration.unobservable and not self.calibration.contradicted


def estimate_units(
    spec: UnitSpec,
    logs: Sequence[Log],
    *,
    units: Sequence[str] = (),
    options: Options | None = None,
    sources: dict[str, str] | None = None,
) -> list[UnitReport]:
    """The calibration of every unit in `units` (default: all) in a log; with several mountings, one log for each.

    `options`: `api.estimate_options.Options`, of which a unit takes `lag` (s), `clock` and `temperature_c`; `sources`:
    names of files, for the provenance. Returns a report for each unit: `calibration` (SI), `requirements` in people's
    units, tests of the fit by channel, internal misalignments (rad), and `messages`. Gauss-Newton through the finite
    geometry with the whitened Jacobian of the prediction (`gradcal_jax.estimation.unit_solve`).

    Errors: `LogError` and `ValueError` where the logs lack what the estimate needs.
    """
    options = options or Options()
    mountings = len(spec.rig.table.mounting)
    if len(logs) != mountings and (len(logs) > 1 or logs[0].mounting is None):
        raise LogError(
            f"the spec hangs the unit in {mountings} mounting(s), one after the other, and there are {len(logs)} "
            "log(s): give one log for each, in the spec's order"
        )
    names = list(units) or [name for name in logs[0].units if all(name in log.units for log in logs)]
    if not names:
        raise LogError("no unit is in all of the logs")
    lacks = lacks_of(spec, logs)
    if options.earth_rate is not None:
        spec = _with_earth(spec, options.earth_rate)
    spec, options, said = with_options(spec, logs, options)
    for log, name in itertools.product(logs, names):
        if log.temperature_c is not None:
            refuse_other_units(spec, log.temperature_c[log.unit_index(name)], name)
    built = assemble_unit(spec)
    logs, faults = without_bad_rows(spec, logs, [c.name.replace("_", " ") for c in built.model.channels])
    noise = omitted_noise_of_unit(built)
    reports = list[UnitReport]()
    for name in names:
        try:
            report = _report(built, logs, name, options, sources or {}, noise, faults[name])
        except LogError as error:
            raise LogError(f"{error}{faults[name].also}") from None
        if lacks is not None:
            report = report._replace(calibration=report.calibration.model_copy(update={"lacks": lacks}))
        messages = *([lacks] if lacks else []), *said, *faults[name].sentences, *report.messages
        reports.append(report._replace(messages=messages))
    return reports


def _with_earth(spec: UnitSpec, earth_rate: float) -> UnitSpec:
    """The spec of a gyro along its table's only axis, at the latitude at which an axis that points up has that rate of
    the Earth (rad/s). Raises `ValueError` for other specs, whose rate of the Earth changes with the table's angles."""
    gyro, hung = spec.sensor.gyro, spec.rig.table.mounting[0]
    along = "" if gyro is None or not spec.is_one_axis else str(getattr(hung, gyro.axes[0]))
    if along not in ("+z", "-z"):
        raise ValueError(
            "--earth-rate and --latitude are for one gyro along a table's only axis that points up: for others the "
            "spec has [rig.site] latitude"
        )
    up = earth_rate if along == "+z" else -earth_rate
    latitude = math.asin(max(-1.0, min(up / EARTH_RATE, 1.0)))
    site = spec.rig.site.model_copy(update={"latitude": Quantity.of(latitude, "deg")})
    return spec.model_copy(update={"rig": spec.rig.model_copy(update={"site": site})})


def _report(
    built: AssembledUnit,
    logs: Sequence[Log],
    name: str,
    options: Options,
    sources: dict[str, str],
    noise: dict[str, np.ndarray],
    shown: RecordFaults,
) -> UnitReport:
    rows, messages = unit_rows(built, logs, name, options)
    starts = np.flatnonzero(~rows.usable & (np.diff(rows.time_s, prepend=-np.inf) > 0.0))
    model = built.model
    temperature_of = lambda lag: followed(rows.temperature_c, rows.time_s, np.union1d([0], starts), lag)  # noqa: E731
    refuse_misaligned(name, estimation.coarse_fits(rows, built.motion.geometry), model.channels)
    threshold = options.threshold if options.robust else None
    lag = _lag_of(built, name, rows, temperature_of) if options.lag == "fit" else Lag(float(options.lag))
    temperature = temperature_of(lag.seconds)
    done, readings, solution = fitted_twice(built, name, rows, temperature, threshold)
    if isinstance(built.spec.plan, StandardPlan):
        messages = *messages, *points_of(built, rows).sentences
    at = segments_of(done.motion, model)
    half = 0.5 * (rows.time_s[0] + rows.time_s[-1])
    of_segment = rows.time_s[done.rows[at.first + 1]]
    began = temperature[done.rows[at.first]]
    heating = temperature[done.rows[at.last + 1]] > began
    used = solution.used
    subsets = {
        HEATING_AGAINST_COOLING: heating[at.row_segment][used],
        "first against second half": (of_segment < half)[at.row_segment][used],
    }
    turned = np.concatenate([[0], np.cumsum(done.motion.axis >= 0)])
    moved = (turned[at.last + 1] > turned[at.first])[at.row_segment][used]
    moves = np.cumsum(np.diff(moved, prepend=False) & moved)
    if moves.max(initial=0) >= _FEWEST_MOVES:
        subsets["odd moves against even ones"] = moves % 2 == 1
    few = {key: value for key, value in subsets.items() if 0.1 < np.mean(value) < 0.9}
    tests = estimation.consistency(solution.estimate, solution.white, 0, few, model.to_reported, solution.taken)
    channels: dict[str, tuple[Test, Test]] = {}
    for i, c in enumerate(model.channels):
        left, taken = solution.residuals_of(i), solution.taken[solution.channel == i]
        free = round(len(left) - float(np.sum(taken**2)))
        channels[c.name] = estimation.chi_squared_test(float(left @ left), free), estimation.whiteness(left, taken)
    known = Posterior(solution.known.spread * excess_of(tests), solution.known.hidden)
    covered = _covered(done, rows, temperature)
    record = slice(int(done.rows[0]), int(done.rows[-1]) + 1)
    ramp = ramp_of_record(rows.time_s[record], temperature[record])
    one_way = abs(temperature[record][-1] - temperature[record][0]) > _ONE_WAY * np.ptp(temperature[record])
    run = EstimatedRun(solution.parameters, covered[0], ramp, one_way=bool(one_way))
    budget = budget_of_unit_estimate(built, known, run, noise)
    structure = () if options.robust else tuple(structure_tests(built.spec, readings, solution))
    beyond_maps = {f"{channel}: structure of the {t.quantity.replace('_', ' ')}": t.test for channel, t in structure}
    contradicted = (*shown.not_valid, *estimation.contradictions(tests_by_name(tests, channels) | beyond_maps))
    requirements, beyond = [], list[str]()
    for requirement in built.spec.requirement:
        if sentence := beyond_the_data(requirement, *covered):
            beyond.append(sentence)
        row = judged_by_data(requirement_row(built, budget, requirement), sentence, contradicted)
        requirements.append(row)
    requirements = tuple(requirements)
    calibration = calibration_of(built, logs, name, solution, tests, channels, requirements, covered, lag, sources)
    if contradicted:
        calibration = calibration.model_copy(update={"contradicted": contradicted})
    own = calibration.values()
    kept = [k for k, n in enumerate(model.names()) if n in own]
    unseen = unseen_errors(budget, [model.names()[k] for k in kept], model.to_reported[kept])
    if unseen:
        calibration = calibration.model_copy(update={"unseen": unseen})
    seen = tuple(_internal(built, solution, covered[0])), _gravity(readings, calibration, temperature)
    path = None
    if HEATING_AGAINST_COOLING in contradicted:
        warm = temperature[done.rows[at.first]][at.row_segment][used]
        path = path_dependence(built.spec, readings, solution, warm, subsets[HEATING_AGAINST_COOLING])
    beside_tests = path, structure, bias_curves(readings, solution)
    report = UnitReport(
        name, built, done, solution, calibration, requirements, tests, channels, *seen, (), *beside_tests
    )
    names = [model.channels[k].name.replace("_", " ") for k in at.row_channel[used]]
    lesser = counting_less(solution.weights, of_segment[at.row_segment][used], names)
    of_path = () if path is None else path.sentences
    of_path = *of_path, *one_way_sentences(built, solution.known, done.motion.line), *branch_sentences(built.spec)
    beside = *of_path, *omitted_sentences(built.spec, temperature[record], lag.std is not None), *beyond
    looks = diagnosis_sentences(solution.estimate.residuals[0], of_segment[at.row_segment][used], moved)
    told = _words(report, solution), looks if contradicted else []
    hidden = (f"{channel.replace('_', ' ')}: {structure_in_words(test)}" for channel, test in structure if test.noticed)
    return report._replace(messages=(*messages, *lag.sentences, *lesser, *hidden, *itertools.chain(*told), *beside))


def _refuse_the_implausible(built: AssembledUnit, name: str, solution: UnitEstimate) -> None:
    """Raise `LogError` for the first channel with coefficients that no device has."""
    model, priors = built.model, prior_deviations(built)
    values, begin = model.to_reported @ solution.parameters, 0
    for c in model.channels:
        own = slice(begin, begin + c.model.size)
        begin = own.stop
        refuse_implausible(f"{name}, {c.name.replace('_', ' ')}", c.model.names(), values[own], priors[own])


def _lag_of(built: AssembledUnit, name: str, rows: UnitRows, temperature_of: Callable[[float], np.ndarray]) -> Lag:
    """The lag of the maps of all channels, at the motion that is found without one."""
    _, readings, solution = fitted_twice(built, name, rows, temperature_of(0.0))

    def chi_squared(lag: float) -> float:
        of = readings._replace(temperature_c=temperature_of(lag))
        return float(estimation.estimate_unit(of, solution.parameters).estimate.chi_squared[0])

    return fitted_lag(chi_squared)


def fitted_twice(
    built: AssembledUnit, name: str, rows: UnitRows, temperature: np.ndarray, threshold: float | None = None
) -> tuple[ExecutedUnit, UnitReadings, UnitEstimate]:
    """The executed motion, the readings of it and the estimate, with a `temperature` (degC) for each row.

    The rates within a move are first the gyros' own, then corrected by the first estimate: a rate-dependent scale
    factor of a per cent would otherwise be estimated at wrong rates.
    """
    first = _read(built, name, rows, rows, temperature, threshold)[2]
    held = tuple(calibrated_channels(built, built.model.to_reported @ first.parameters, _EVERYWHERE))
    rates, felt = correct_triads(held, rows.rates, rows.force, temperature)
    return _read(built, name, rows, rows._replace(rates=rates), temperature, threshold, felt, first.parameters)


def _read(
    built: AssembledUnit,
    name: str,
    rows: UnitRows,
    seen: UnitRows,
    temperature: np.ndarray,
    threshold: float | None,
    felt: np.ndarray | None = None,
    about: np.ndarray | None = None,
) -> tuple[ExecutedUnit, UnitReadings, UnitEstimate]:
    """The executed motion by the rates of `seen`, the unit's readings with the specific forces `felt`, and the
    estimate, linearised about `about`."""
    try:
        done = _executed(built, seen)
        done = done._replace(motion=replace(done.motion, history=course_before(built.spec)))
    except ValueError as error:
        raise LogError(f"{name}: {error}") from None
    readings = estimation.readings_of(built.model, done, rows, temperature, 0 if built.rough else built.points, felt)
    plan = built.spec.plan
    if isinstance(plan, StandardPlan) and plan.estimator == "least squares":
        solution = estimation.estimate_unweighted(readings)
    else:
        solution = estimation.estimate_unit(readings, about, threshold=threshold)
    _refuse_the_implausible(built, name, solution)
    scale = float(np.sqrt(solution.estimate.chi_squared[0] / max(int(solution.estimate.degrees[0]), 1)))
    if scale > _ABSURD:
        raise LogError(
            f"{name}: the unit's readings differ from the table's by {scale:.3g} times what noise explains: are the "
            "mounting, the unit's axes and signs and the table's angles those of the spec?"
        )
    return done, readings, solution


def _executed(built: AssembledUnit, seen: UnitRows) -> ExecutedUnit:
    """The executed motion by the rates of `seen`. Raises `ValueError`."""
    encoder, geometry = built.model.encoder, built.motion.geometry
    if isinstance(built.spec.plan, StandardPlan):
        return estimation.motion_at_points(points_of(built, seen).done, seen, geometry)
    if read_by_events(built.spec):
        return estimation.motion_by_readings(seen, geometry)
    spacing = {} if encoder.held else {"read_every": float(encoder.every[0])}
    return estimation.executed_unit(seen, geometry, planned=planned_moves(built), **spacing)


def points_of(built: AssembledUnit, rows: UnitRows) -> Plateaus:
    """The points of the standard method in a log's rows. Raises `ValueError` where there are none."""
    plan = built.spec.schedule
    assert isinstance(plan, StandardSchedule)
    assert rows.table_rate is not None
    planned = np.array(plan.temperatures), np.array(plan.rates)
    reference = rows.temperature_c, rows.table_rate, rows.usable
    return estimation.plateaus(rows.time_s, *reference, *planned, plan.integration, points=plan.shared)


def planned_moves(built: AssembledUnit) -> list[list[PlannedMove]]:
    """The moves of a plan's cycle between its rests."""
    groups: list[list[PlannedMove]] = [[]]
    places = np.linspace(0.0, 1.0, _PROFILE + 1)
    for step in built.spec.gradient_schedule.steps:
        for _ in range(step.move.repeat):
            if step.axis < 0:
                groups.append([])
                continue
            turn = move_of(replace(step.move, axis="x"), None, np.inf)
            line = trajectory.gradient_plan(trajectory.programme(0.0, [(turn.duration, 0.0)]), (turn,)).trajectory()
            begun = np.cumsum(line.turned()) - line.turned()
            piece = np.clip(np.searchsorted(line.start, places * turn.duration, side="right") - 1, 0, len(begun) - 1)
            within = (places * turn.duration - line.start[piece]) / line.duration[piece]
            angle = begun[piece] + line.angle(within[:, None], piece)[:, 0]
            groups[-1].append(PlannedMove(step.axis, turn.angle, turn.duration, angle / angle[-1]))
    # The cycle begins anew where it ends.
    groups[0] = [*groups.pop(), *groups[0]] if len(groups) > 1 else groups[0]
    return [group for group in groups if group]


def _covered(done, rows: UnitRows, temperature: np.ndarray) -> tuple[tuple[float, float], tuple[float, float]]:
    """The ranges of temperature (°C) and rate (rad/s) of the rows used."""
    inside = slice(int(done.rows[0]), int(done.rows[-1]) + 1)
    rates = np.abs(np.where(rows.usable[:, None], rows.rates, np.nan)[inside])
    fastest = float(np.nanmax(rates, initial=0.0)) if np.isfinite(rates).any() else 0.0
    at, fastest = temperature[inside], np.radians(np.ceil(np.degrees(fastest) * 10.0) / 10.0)
    # Outwards to a tenth: the ends of the first and the last standstill are not counted.
    return (np.floor(at.min() * 10.0) / 10.0, np.ceil(at.max() * 10.0) / 10.0), (-float(fastest), float(fastest))


# --- findings --------------------------------------------------------------------------------------------------------


def _internal(built: AssembledUnit, solution: UnitEstimate, covered: tuple[float, float]):
    """Internal misalignments at the middle of the temperatures."""
    middle = np.array([0.5 * (covered[0] + covered[1])])
    for kind in KINDS:
        triad = getattr(built.spec.sensor, kind)
        if triad is not None and triad.misalignment is not None and len(triad.axes) == 3:
            for label, row in internal_misalignments(built.model, kind, middle):
                value, std = float(row[0] @ solution.parameters), float(solution.known.deviations(row)[0])
                yield InternalMisalignment(f"{kind} {label}", value, std)


def _gravity(readings: UnitReadings, calibration: Calibration, temperature: np.ndarray) -> tuple[float, float] | None:
    """Rms of |f| − g over the rests: as measured, and corrected. None without three accelerometers."""
    done, rows, model = readings.done, readings.log, readings.model
    if sum(c.kind == "accelerometer" for c in model.channels) < 3:
        return None
    rests = np.flatnonzero((done.motion.axis < 0) & ~done.motion.line.gap & (done.motion.line.duration > 0.0))
    step = np.diff(rows.time_s, prepend=rows.time_s[0])
    first, last = done.rows[rests], done.rows[rests + 1]

    def mean(values: np.ndarray) -> np.ndarray:
        total = np.cumsum(np.nan_to_num(values) * step[:, None], axis=0)
        return (total[last] - total[first]) / (rows.time_s[last] - rows.time_s[first])[:, None]

    force, rate = mean(rows.force), mean(np.where(np.isfinite(rows.rates), rows.rates, 0.0))
    at = mean(temperature[:, None])[:, 0]
    corrected = correct_triads(calibration.channel, rate, force, at)[1]
    g = float(done.motion.geometry.gravity)
    before, after = (float(np.sqrt(np.mean((np.linalg.norm(f, axis=1) - g) ** 2))) for f in (force, corrected))
    return before, after


def _words(report: UnitReport, solution: UnitEstimate) -> list[str]:
    """Where the data contradict the model or do not observe it, in sentences."""
    tests, failed = report.consistency, report.calibration.contradicted
    sentences = not_valid([name.replace("_", " ") for name in failed])
    if solution.moved > 1e-2:
        sentences.append(
            f"the estimate has not converged: its last step is {solution.moved:.2g} of its standard deviations; "
            "the table differs from the spec by more than small angles"
        )
    sentences += noise_sentences(tests, "chi-squared of the fit" in failed, "unit")
    for name, (size, _) in report.channels.items():
        where = name.replace("_", " ")
        if f"{name}: chi-squared" in failed:
            scale = np.sqrt(size.statistic / max(size.degrees, 1))
            sentences.append(f"{where}: its residuals are {scale:.3g} times what the spec's noise says")
        if f"{name}: whiteness" in failed:
            sentences.append(
                f"{where}: its residuals are not white: the spec's noise does not explain their correlation"
            )
    for split in tests.splits:
        if split.name in failed:
            sentences.append(f"{split.name}: the parts disagree (chance {split.agreement.probability:.1g})")
    for error in report.calibration.table:
        if abs(error.value) > _CONTRADICTED * error.prior:
            sentences.append(
                f"the table's {error.name.replace('_', ' ')} is {error.value / error.prior:+.1f} times its standard "
                "deviation by the spec: is the spec of the table right?"
            )
    if report.calibration.unobservable:
        sentences.append(f"the data say nothing of {', '.join(report.calibration.unobservable)}")
    return sentences


def unit_estimate_rows(report: UnitReport) -> dict[str, Any]:
    """All numbers of an estimate for `--json`, in SI unless they have a unit beside them."""
    calibration = report.calibration
    return {
        "unit": report.unit,
        "simulated": calibration.simulated,
        "parameters": coefficient_rows(calibration),
        "table": [row.model_dump(mode="json") for row in calibration.table],
        "requirements": [requirement_fields(row) for row in report.requirements],
        "internal_misalignment": [row._asdict() for row in report.internal],
        "gravity_rms_m_per_s2": report.gravity,
        "tests": [row.model_dump(mode="json") for row in calibration.fit],
        "structure": [
            {
                "channel": channel,
                "quantity": t.quantity,
                "test": t.test._asdict(),
                "noticed": t.noticed,
                "asked": t.asked,
            }
            for channel, t in report.structure
        ],
        "messages": list(report.messages),
        "path": None if report.path is None else _path_rows(report.path),
    }


def _path_rows(path: PathDependence) -> dict[str, Any]:
    """Half-differences of heating and cooling, and the play that explains them, for `--json`, SI."""
    differences = [
        d._replace(**{k: getattr(d, k).tolist() for k in ("temperature_c", "value", "std")}) for d in path.differences
    ]
    return {
        "half_differences": [d._asdict() for d in differences],
        "play": None if path.offer is None else path.offer._asdict(),
    }
