"""The estimate of a whole unit from its log and spec: parameters of unit and table, tests, verdicts, a calibration.

The spec describes the noise, the table and the terms; the executed motion is read from the log.
"""

import itertools
from collections.abc import Iterator, Sequence
from dataclasses import replace
from typing import Any, NamedTuple

import numpy as np

from gradcal_jax import estimation, trajectory
from gradcal_jax.api.build import move_of
from gradcal_jax.api.calibration import excess_of, noise_sentences, not_valid
from gradcal_jax.api.contract_rows import (
    coefficient_rows,
    fit_rows,
    judged_by_data,
    provenance_of,
    random_walks,
    requirement_fields,
    result_of_requirement,
    section_of,
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
from gradcal_jax.api.executed_part import lacks_of
from gradcal_jax.api.log_rows import bridged_temperature, time_of, usable_rows, with_options
from gradcal_jax.api.path_dependence import (
    HEATING_AGAINST_COOLING,
    BiasCurve,
    PathDependence,
    bias_curves,
    path_dependence,
)
from gradcal_jax.api.prediction import unit_requirement_row
from gradcal_jax.api.record_faults import RecordFaults, without_bad_rows
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
from gradcal_jax.api.unit_sentences import one_way_sentences, prior_deviations, unobserved_parameters
from gradcal_jax.display import summary
from gradcal_jax.estimation import Consistency, ExecutedUnit, PlannedMove, Test, UnitEstimate, UnitReadings, UnitRows
from gradcal_jax.files.absent import branch_sentences
from gradcal_jax.files.calibration import (
    FORMAT,
    ORDER,
    CalibratedChannel,
    CalibratedTerm,
    Calibration,
    Covariance,
    Noise,
    PathCoefficient,
    TableError,
    build_term,
)
from gradcal_jax.files.calibration.correction import correct_triads, followed
from gradcal_jax.files.contracts import RequirementRow
from gradcal_jax.files.log import Log, LogError, ReadingKind
from gradcal_jax.files.quantity import Quantity
from gradcal_jax.files.requirement_table import narrow_table
from gradcal_jax.files.unit_spec import UnitSpec
from gradcal_jax.information import Posterior, segments_of
from gradcal_jax.model import (
    AXIS_NAMES,
    KINDS,
    Channel,
    Discrepancy,
    GradientOfBias,
    Hysteresis,
    Map,
    PathTerm,
    SignalMap,
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


def _tests_of(tests: Consistency, channels: dict[str, tuple[Test, Test]]) -> dict[str, Test]:
    """All tests of a fit, by the names that they have in the calibration file."""
    named = {"chi-squared of the fit": tests.fit}
    for channel, (size, white) in channels.items():
        named |= {f"{channel}: chi-squared": size, f"{channel}: whiteness": white}
    return named | {split.name: split.agreement for split in tests.splits}


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
    lag = options.lag
    if isinstance(lag, str):
        raise ValueError("the lag of a whole unit is not fitted: give a time, such as --lag 90s")
    temperature = followed(rows.temperature_c, rows.time_s, np.union1d([0], starts), lag)
    model = built.model
    refuse_misaligned(name, estimation.coarse_fits(rows, built.motion.geometry), model.channels)
    threshold = options.threshold if options.robust else None
    done, readings, solution = fitted_twice(built, name, rows, temperature, threshold)
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
    few = {key: value for key, value in subsets.items() if 0.1 < np.mean(value) < 0.9}
    tests = estimation.consistency(solution.estimate, solution.white, 0, few, model.to_reported, solution.taken)
    channels: dict[str, tuple[Test, Test]] = {}
    for i, c in enumerate(model.channels):
        own = at.row_channel[used] == i
        left, taken = solution.estimate.residuals[0][own], solution.taken[own]
        free = round(len(left) - float(np.sum(taken**2)))
        channels[c.name] = estimation.chi_squared_test(float(left @ left), free), estimation.whiteness(left, taken)
    known = Posterior(solution.known.spread * excess_of(tests), solution.known.hidden)
    covered = _covered(done, rows, temperature)
    record = slice(int(done.rows[0]), int(done.rows[-1]) + 1)
    ramp = ramp_of_record(rows.time_s[record], temperature[record])
    one_way = abs(temperature[record][-1] - temperature[record][0]) > _ONE_WAY * np.ptp(temperature[record])
    run = EstimatedRun(solution.parameters, covered[0], ramp, one_way=bool(one_way))
    budget = budget_of_unit_estimate(built, known, run, noise)
    contradicted = (*shown.not_valid, *estimation.contradictions(_tests_of(tests, channels)))
    requirements, beyond = [], list[str]()
    for requirement in built.spec.requirement:
        if sentence := beyond_the_data(requirement, *covered):
            beyond.append(sentence)
        row = judged_by_data(unit_requirement_row(built, budget, requirement), sentence, contradicted)
        requirements.append(row)
    requirements = tuple(requirements)
    calibration = _calibration(built, logs, name, solution, tests, channels, requirements, covered, options, sources)
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
    curves = bias_curves(readings, solution)
    report = UnitReport(
        name, built, done, solution, calibration, requirements, tests, channels, *seen, (), path, curves
    )
    names = [model.channels[k].name.replace("_", " ") for k in at.row_channel[used]]
    lesser = counting_less(solution.weights, of_segment[at.row_segment][used], names)
    shown_of_path = () if path is None else path.sentences
    shown_of_path = (
        *shown_of_path,
        *one_way_sentences(built, solution.known, done.motion.line),
        *branch_sentences(built.spec),
    )
    beside = *shown_of_path, *omitted_sentences(built.spec, temperature[record]), *beyond
    turned = np.concatenate([[0], np.cumsum(done.motion.axis >= 0)])
    moved = (turned[at.last + 1] > turned[at.first])[at.row_segment][used]
    looks = diagnosis_sentences(solution.estimate.residuals[0], of_segment[at.row_segment][used], moved)
    told = _words(report, solution), looks if contradicted else []
    return report._replace(messages=(*messages, *lesser, *itertools.chain(*told), *beside))


def _refuse_the_implausible(built: AssembledUnit, name: str, solution: UnitEstimate) -> None:
    """Raise `LogError` for the first channel with coefficients that no device has."""
    model, priors = built.model, prior_deviations(built)
    values, begin = model.to_reported @ solution.parameters, 0
    for c in model.channels:
        own = slice(begin, begin + c.model.size)
        begin = own.stop
        refuse_implausible(f"{name}, {c.name.replace('_', ' ')}", c.model.names(), values[own], priors[own])


def fitted_twice(
    built: AssembledUnit, name: str, rows: UnitRows, temperature: np.ndarray, threshold: float | None = None
) -> tuple[ExecutedUnit, UnitReadings, UnitEstimate]:
    """The executed motion, the readings of it and the estimate, with a `temperature` (degC) for each row.

    The rates within a move are first the gyros' own, then corrected by the first estimate: a rate-dependent scale
    factor of a per cent would otherwise be estimated at wrong rates.
    """
    first = _read(built, name, rows, rows, temperature, threshold)[2]
    held = tuple(_channels(built, built.model.to_reported @ first.parameters, _EVERYWHERE))
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
        encoder = built.model.encoder
        spacing = {} if encoder.held else {"read_every": float(encoder.every[0])}
        done = estimation.executed_unit(seen, built.motion.geometry, planned=planned_moves(built), **spacing)
        done = done._replace(motion=replace(done.motion, history=course_before(built.spec)))
    except ValueError as error:
        raise LogError(f"{name}: {error}") from None
    readings = estimation.readings_of(built.model, done, rows, temperature, 0 if built.rough else built.points, felt)
    solution = estimation.estimate_unit(readings, about, threshold=threshold)
    _refuse_the_implausible(built, name, solution)
    scale = float(np.sqrt(solution.estimate.chi_squared[0] / max(int(solution.estimate.degrees[0]), 1)))
    if scale > _ABSURD:
        raise LogError(
            f"{name}: the unit's readings differ from the table's by {scale:.3g} times what noise explains: are the "
            "mounting, the unit's axes and signs and the table's angles those of the spec?"
        )
    return done, readings, solution


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


def unit_rows(
    built: AssembledUnit, logs: Sequence[Log], name: str, options: Options
) -> tuple[UnitRows, tuple[str, ...]]:
    """The rows of one unit in all its logs, in order, and messages on what was inferred or left out."""
    parts, messages, end = [], [], None
    for k, log in enumerate(logs):
        part, notes = _rows_of_log(built, log, name, options)
        messages += notes
        begin = part.time_s[0] if end is None else end + _REHUNG_S
        shifted = part.time_s - part.time_s[0] + begin
        mounting = part.mounting if len(logs) == 1 else np.full(len(shifted), k)
        if (highest := int(mounting.max())) >= len(built.spec.rig.table.mounting):
            raise LogError(f"the log was recorded in mounting {highest + 1}, which the spec does not have")
        # A change of the mounting ends a standstill.
        part.standing[np.flatnonzero(np.diff(mounting, prepend=mounting[0] if k == 0 else -1))] = False
        parts.append(part._replace(time_s=shifted, mounting=mounting))
        end = shifted[-1]
    if len(logs) > 1 and any(isinstance(t, PathTerm) for c in built.model.channels for t in c.model.terms):
        messages.append(
            "between the logs the course of the temperature is not known: plays go straight from one to the next, and "
            "power-on is at the beginning of the first"
        )
    whole = UnitRows(*(np.concatenate([getattr(part, field) for part in parts]) for field in UnitRows._fields))
    return whole, tuple(dict.fromkeys(messages))


def _rows_of_log(built: AssembledUnit, log: Log, name: str, options: Options) -> tuple[UnitRows, list[str]]:
    number, (time, messages) = log.unit_index(name), time_of(log, options)
    rates, force = log.triads(number)
    usable, gyros, missing = usable_rows(log, number), np.zeros(3, bool), []
    for c in built.model.channels:
        values = (rates if c.kind == "gyro" else force)[:, c.axis]
        known = np.isfinite(values)
        if not known.any():
            missing.append(c.name.replace("_", " "))
        usable &= known
        gyros[c.axis] |= c.kind == "gyro"
    if missing:
        has = [f"gyro {a}" for a in log.axes] + [f"accelerometer {a}" for a in log.force_axes]
        raise LogError(
            f"the log has no {', '.join(missing)}, which the spec calibrates; it has {', '.join(has)}. Log axes are "
            "named x, y, z"
        )
    rates[:, ~gyros] = np.nan
    temperature = bridged_temperature(log, number, options.temperature_c)
    angles, at_a_stop = _table_angles(built, log)
    if log.standstill is not None:
        standing = log.standstill >= 0
        # One standstill directly follows another where a run was interrupted at rest and resumed at rest elsewhere.
        standing[1:] &= (np.diff(log.standstill) == 0) | ~standing[:-1]
    elif gyros.any():
        standstill = estimation.find_standstills(np.nan_to_num(rates[:, gyros]), log.sample_interval_s, valid=usable)
        standing = standstill >= 0
        messages.append(
            f"the log marks no standstills: {int(standstill.max()) + 1} were found where the rates are quiet"
        )
    else:
        raise LogError("a log without gyros must mark its standstills (a column standstill in the column map)")
    smooth = estimation.smoothed_temperature(time, temperature)
    mounting = np.zeros(len(time), int) if log.mounting is None else log.mounting
    return UnitRows(time, rates, force, smooth, angles, standing, usable, mounting, at_a_stop), messages


def _table_angles(built: AssembledUnit, log: Log) -> tuple[np.ndarray, np.ndarray]:
    """The table's angles `(n, L)` about the spec's axes, in its order, NaN where not read, and whether a row's are
    readings of standing axes."""
    names, count = [axis.name for axis in built.spec.rig.table.axis], len(log.time_s)
    if log.table_angle_rad is None and log.readings is None:
        raise LogError(f"the log has no angles of the table ({', '.join(names)}), which are the reference")
    if missing := [name for name in names if name not in log.table_axes]:
        if not len(names) == len(log.table_axes) == 1:
            raise LogError(
                f"the log has no table axis {', '.join(missing)}: it has {', '.join(log.table_axes) or 'none'}. Name "
                "the axes alike in the spec's [[rig.table.axis]] and in the log's column map"
            )
        names = list(log.table_axes)
    places = [log.table_axes.index(name) for name in names]
    if log.readings is None:
        assert log.table_angle_rad is not None
        return log.table_angle_rad[:, places], np.zeros(count, bool)
    angles = np.full((count, len(places)), np.nan)
    for k, place in enumerate(places):
        read = log.readings.of_axis(place, ReadingKind.PLANNED, ReadingKind.STANDING)
        # Where other axes may move an axis stops at the time of its reading, not where it has settled.
        stopped = np.clip(np.searchsorted(log.time_s, read.time_s), 1, count - 1)
        stopped -= read.time_s - log.time_s[stopped - 1] < log.time_s[stopped] - read.time_s
        alone = np.zeros(count, bool) if log.standstill is None else log.standstill >= 0
        rows, of_row = np.unique(np.where(alone[read.row], read.row, stopped), return_inverse=True)
        angles[rows, k] = np.bincount(of_row, read.angle_rad, len(rows)) / np.bincount(of_row, None, len(rows))
    return angles, np.isfinite(angles).sum(axis=1) > 0


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


# --- the file ---------------------------------------------------------------------------------------------------------


def _calibration(
    built: AssembledUnit,
    logs: Sequence[Log],
    name: str,
    solution: UnitEstimate,
    tests: Consistency,
    channels: dict[str, tuple[Test, Test]],
    requirements: tuple[RequirementRow, ...],
    covered: tuple[tuple[float, float], tuple[float, float]],
    options: Options,
    sources: dict[str, str],
) -> Calibration:
    model, spec, named = built.model, built.spec, _tests_of(tests, channels)
    reported = model.to_reported
    values, deviations = reported @ solution.parameters, solution.known.deviations(reported)
    names, units = model.names(), model.units()
    priors = prior_deviations(built)
    own = slice(0, model.calibrated)
    held = list(_channels(built, values, covered, options.lag))
    kept = {f"{c.name}.{n}" for c in held for term in c.term for n in term.coefficients}
    covariant = [k for k in range(model.calibrated) if np.isfinite(deviations[k]) and names[k] in kept]
    matrix = solution.known.covariance(reported[own])[np.ix_(covariant, covariant)]
    frame = spec.sensor.frame
    case = frame is not None and frame.fixed_by == "case"
    section: dict[str, Any] = {
        "format": FORMAT,
        "title": spec.title or spec.sensor.name or f"calibration of {name}",
        "serial_number": name,
        "simulated": any(one.simulated for one in logs),
        "frame": "the case, as far as its mounting is known"
        if case
        else "the table's axes at zero, through the nominal mounting",
        "order": ORDER,
        "channel": tuple(held),
        "path": tuple(_path_coefficients(built, values, deviations)),
        "covariance": Covariance(
            names=tuple(names[k] for k in covariant), matrix=tuple(map(tuple, matrix.tolist()))
        ),
        "table": tuple(
            TableError(
                name=names[k], value=float(values[k]), standard_deviation=float(deviations[k]), prior=float(priors[k]),
                unit=units[k],
            )
            for k in range(model.calibrated, model.size)
        ),
        "fit": fit_rows(named.items()),
        "unobservable": tuple(n for n in unobserved_parameters(built, solution.known) if n in kept),
        "noise": _noise(spec, logs[0]),
        "result": tuple(map(result_of_requirement, requirements)),
        "provenance": provenance_of(
            logs,
            name,
            sources,
            estimator=f"Gauss-Newton through the finite geometry, {solution.rounds} rounds",
            rows=str(int(np.count_nonzero(solution.used))),
        ),
    }  # fmt: skip
    return Calibration(**section)


def _channels(
    built: AssembledUnit, values: np.ndarray, covered: tuple[tuple[float, float], tuple[float, float]], lag: Any = None
) -> Iterator[CalibratedChannel]:
    """The calibrated channels, from all reported parameters `(p,)`; `covered`: temperatures (°C) and rates (rad/s)."""
    begin = 0
    shared: dict[str, Any] = {
        "valid_temperature": tuple(f"{t:.1f} degC" for t in covered[0]),
        "valid_rate": tuple(f"{np.degrees(r):.1f} deg/s" for r in covered[1]),
    }
    shared |= {"thermal_lag": Quantity.of(float(lag), "s")} if lag else {}
    for c in built.model.channels:
        terms = _terms(built.spec, c, values[begin : begin + c.model.size])
        yield CalibratedChannel(kind=c.kind, axis=AXIS_NAMES[c.axis], term=tuple(terms), **shared)
        begin += c.model.size


def _terms(spec: UnitSpec, channel: Channel, values: np.ndarray) -> Iterator[CalibratedTerm]:
    triad = getattr(spec.sensor, channel.kind)
    for term in channel.model.terms:
        # A sensitivity to dT/dt and what else depends on the path of temperature are estimated beside the calibration.
        if isinstance(term, Discrepancy | GradientOfBias | PathTerm):
            continue
        own = values[channel.model.where(term.name)]
        coefficients = {name: float(v) for name, v in zip(term.names(), own, strict=True)}
        section = getattr(triad, section_of(triad, term.name))
        assert isinstance(term, Map | SignalMap)
        of_rate = (f"rate {AXIS_NAMES[channel.axis]}",)
        signals = term.signals if isinstance(term, SignalMap) else () if term.rate is None else of_rate
        bases = {"temperature": section.temperature, "rate": getattr(section, "rate", None)}
        yield build_term(term.name, term.unit, signals, coefficients, **bases)


def _path_coefficients(built: AssembledUnit, values: np.ndarray, deviations: np.ndarray) -> Iterator[PathCoefficient]:
    """What depends on the path of temperature and was estimated beside the maps, from all reported parameters."""
    begin = 0
    for c in built.model.channels:
        for term in c.model.terms:
            own = slice(begin, begin + term.size)
            begin = own.stop
            if not isinstance(term, PathTerm):
                continue
            of_play = {"width": Quantity.of(float(term.width), "K")} if isinstance(term, Hysteresis) else {}
            for name, value, std in zip(term.names(), values[own], deviations[own], strict=True):
                if name not in term.nuisances:
                    yield PathCoefficient(
                        channel=c.name, name=name, value=float(value), standard_deviation=float(std), unit=term.unit,
                        **of_play,
                    )  # fmt: skip


def _noise(spec: UnitSpec, log: Log) -> Noise:
    densities: dict[str, Any] = {"sample_rate": Quantity.of(1.0 / log.sample_interval_s, "Hz")}
    if (gyro := spec.sensor.gyro) is not None:
        densities |= random_walks(gyro)
    if (force := spec.sensor.accelerometer) is not None:
        densities["velocity_random_walk"] = force.velocity_random_walk
    return Noise(**densities)


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
