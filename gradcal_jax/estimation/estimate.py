"""The estimate of sensors from a log and a spec: parameters of sensor and table, tests, verdicts, a calibration.

The spec describes the noise, the table and the terms; the executed motion is read from the log.
"""

import itertools
from collections.abc import Iterator, Mapping, Sequence
from types import MappingProxyType
from typing import Any, NamedTuple, cast

import numpy as np

from gradcal_jax import estimation
from gradcal_jax.calibration.file import Calibration
from gradcal_jax.estimation import ExecutedImu, ImuEstimate, Test
from gradcal_jax.estimation.added_columns import Whitener, added_tests, halves_test
from gradcal_jax.estimation.calibration_of_fit import Range, calibration_of
from gradcal_jax.estimation.calibration_rows import (
    fit_rows,
    provenance_of,
    result_of_requirement,
    rows_of_estimate,
)
from gradcal_jax.estimation.findings import (
    FitFinding,
    RecordFaults,
    beyond_the_data,
    beyond_the_spec,
    failed,
    goes_one_way,
    lacks_of,
    omitted_sentences,
    refuse_other_units,
    sentences_of,
    without_bad_rows,
)
from gradcal_jax.estimation.fit_of_log import fit_of, points_of
from gradcal_jax.estimation.lag_of_maps import Fit, Lag
from gradcal_jax.estimation.log_rows import Options, count_rows, imu_rows, with_options
from gradcal_jax.information.plan_sentences import one_way_sentences, prior_deviations
from gradcal_jax.information.prediction import requirement_row
from gradcal_jax.information.unseen import EstimatedRun, answers_of, budget_of_estimate, omitted_noise_of_imu
from gradcal_jax.information.verdicts import finite
from gradcal_jax.model import AXIS_NAMES, ImuModel
from gradcal_jax.model.build import BuiltImu, build_imu
from gradcal_jax.records.log import Log, LogError
from gradcal_jax.spec.absent import attitude_sentences, branch_sentences
from gradcal_jax.spec.changes import along_axis
from gradcal_jax.spec.contracts import RequirementRow, outcomes
from gradcal_jax.spec.moves import Axis
from gradcal_jax.spec.places import places_of, specs_at_places
from gradcal_jax.spec.plan import StandardPlan
from gradcal_jax.spec.spec import expect_spec
from gradcal_jax.spec.spec_sections import Spec
from gradcal_jax.tables.display import summary

# Steps to which the ranges of a calibration are rounded, outwards.
_TEMPERATURE_STEP_K, _RATE_STEP_RAD_PER_S = 0.1, float(np.radians(0.1))
CHI_SQUARED, HEATING_AGAINST_COOLING = "chi-squared of the fit", "heating against cooling"
_LOOP = (
    "heating and cooling disagree: the errors depend on past temperatures; add to the spec the term that describes it: "
    "hysteresis, bias_temperature_gradient or a lag of the bias of the sensor"
)
# A share of the readings that is too small to be half of an experiment, and the probability of too small residuals.
_FEW, _TOO_GOOD = 0.1, 1e-3
# The last step, in standard deviations, of an estimate that has not converged.
_MOVED = 1e-2


class SensorEstimate(NamedTuple):
    """The estimate of one sensor, in SI except `requirements`. `tests`: of the fit, by name."""

    unit: str
    built: BuiltImu
    executed: ExecutedImu
    solution: ImuEstimate
    calibration: Calibration
    requirements: tuple[RequirementRow, ...]
    tests: Mapping[str, Test]
    messages: tuple[str, ...]
    lag: Lag = Lag(0.0)
    """Lag of the maps behind the measured temperature."""
    counts: Mapping[str, int] = MappingProxyType({})
    """Numbers of rows used and left out, by reason; they add up to the rows read."""

    __repr__ = summary

    def _shown(self) -> list[str]:
        rows, one = self.requirements, self.calibration
        return [
            f"Estimate of {self.unit}" + (", SIMULATED" if one.simulated else ""),
            one.valid_range,
            *([f"contradicted: {', '.join(one.contradicted)}"] if one.contradicted else []),
            *([f"not observable: {', '.join(one.unobservable)}"] if one.unobservable else []),
            *(f"note: {message}" for message in self.messages[:2]),
            outcomes(rows, limits=False).text(),
        ]

    @property
    def as_wished(self) -> bool:
        """Whether every target is met, every parameter observable and every test passed."""
        met = all(row.verdict in (None, "met") for row in self.requirements)
        return met and not self.calibration.unobservable and not self.calibration.contradicted


class EstimateReport(NamedTuple):
    """The estimates of the `sensors` of a log."""

    sensors: tuple[SensorEstimate, ...]

    __repr__ = summary

    def _shown(self) -> list[str]:
        return [line for one in self.sensors for line in one._shown()]

    @property
    def calibrations(self) -> tuple[Calibration, ...]:
        """The calibration of every sensor, in SI."""
        return tuple(one.calibration for one in self.sensors)

    @property
    def messages(self) -> dict[str, tuple[str, ...]]:
        """By sensor: sentences to read before its calibration is used."""
        return {one.unit: one.messages for one in self.sensors}

    @property
    def verdicts(self) -> dict[str, tuple[RequirementRow, ...]]:
        """The requirements by sensor."""
        return {one.unit: one.requirements for one in self.sensors}

    @property
    def as_wished(self) -> bool:
        """Whether every target is met, every parameter observable and every test passed."""
        return all(one.as_wished for one in self.sensors)


def estimate_log(
    spec: Spec,
    logs: Sequence[Log],
    *,
    axis: str | None = None,
    units: Sequence[str] = (),
    options: Options | None = None,
    sources: dict[str, str] | None = None,
) -> EstimateReport:
    """As `estimate`, of logs of every mounting, with `options` in one object; `sources`: names of files, for the
    provenance."""
    of = of_log(expect_spec(spec), logs[0], axis)
    return EstimateReport(tuple(estimate_sensors(of, logs, units=units, options=options, sources=sources)))


def of_log(spec: Spec, log: Log, axis: str | None = None) -> Spec:
    """The spec of one gyro along a table's only axis, of the `axis` of the body that was recorded, if it is another: it
    is named, or the log has no other. Errors: `LogError` and `ValueError`."""
    if axis is not None:
        log.channel(f"gyro {axis}")
        if axis not in AXIS_NAMES:
            raise LogError(f"gyro axes are x, y and z, not '{axis}': rename it in the column map")
        return along_axis(spec, cast("Axis", axis))
    gyro = spec.sensor.gyro
    alone = gyro is not None and len(gyro.axes) == 1 and spec.is_one_axis and len(log.axes) == 1
    return along_axis(spec, cast("Axis", log.axes[0])) if alone and log.axes[0] in AXIS_NAMES else spec


def estimate_sensors(
    spec: Spec,
    logs: Sequence[Log],
    *,
    units: Sequence[str] = (),
    options: Options | None = None,
    sources: dict[str, str] | None = None,
) -> list[SensorEstimate]:
    """The estimate of every sensor in `units` (default: all) of a log; with several mountings, one log for each. Each
    IMU at a place of a fixture, in one log or in one each, is estimated by itself."""
    options, sources = options or Options(), sources or {}
    if not spec.rig.table.place:
        return list(_estimates(spec, logs, units, options, sources))
    names = dict.fromkeys(name for log in logs for name in log.units)
    if unknown := [name for name in units if name not in names]:
        raise LogError(f"no IMU has the name {unknown[0]}: the logs have {', '.join(names)}")
    where, at = places_of(spec, list(names)), specs_at_places(spec)
    found = list[SensorEstimate]()
    for name in units or names:
        own = [log for log in logs if name in log.units]
        found += _estimates(at[where[name]], own, [name], options, sources)
    return found


def _estimates(
    spec: Spec, logs: Sequence[Log], units: Sequence[str], options: Options, sources: dict[str, str]
) -> Iterator[SensorEstimate]:
    """The estimate of every sensor by itself; errors say what else is wrong with its log."""
    mountings = len(spec.rig.table.mounting)
    if len(logs) != mountings and (len(logs) > 1 or logs[0].mounting is None):
        raise LogError(
            f"the spec has {mountings} mounting(s), one after the other, and there are {len(logs)} log(s): give "
            "one log for each mounting, in the order of the spec"
        )
    names = list(units) or [name for name in logs[0].units if all(name in log.units for log in logs)]
    if not names:
        raise LogError("no IMU is in all of the logs")
    lacks = lacks_of(spec, logs)
    spec, options, said = with_options(spec, logs, options)
    for log, name in itertools.product(logs, names):
        if log.temperature_c is not None:
            refuse_other_units(spec, log.temperature_c[log.unit_index(name)], name)
    built = build_imu(spec)
    logs, faults = without_bad_rows(spec, logs, [c.name.replace("_", " ") for c in built.model.channels])
    noise = omitted_noise_of_imu(built)
    said = [*([lacks] if lacks else []), *said]
    for name in names:
        shown, progress = faults[name], options.progress
        try:
            progress(f"IMU {name}: rows of the log")
            rows, messages = imu_rows(built, logs, name, options)
            fit = fit_of(built, name, rows, options)
            progress(f"IMU {name}: tests of the fit")
            one = _report_of(built, fit, logs, name, options, sources, noise, shown, lacks)
            yield one._replace(messages=(*said, *shown.sentences, *messages, *one.messages))
        except LogError as error:
            raise LogError("; ".join([str(error), *shown.sentences])) from None


def _report_of(
    built: BuiltImu,
    fit: Fit,
    logs: Sequence[Log],
    name: str,
    options: Options,
    sources: dict[str, str],
    noise: dict[str, np.ndarray],
    shown: RecordFaults,
    lacks: str | None,
) -> SensorEstimate:
    """The estimate of one sensor from the fit of its rows."""
    readings, solution, lag = fit.readings, fit.solution, fit.lag
    done, model, spec = readings.done, built.model, built.spec
    stable, temperature = isinstance(spec.plan, StandardPlan), readings.temperature_c
    # The factor by which residuals exceed the spec's noise where the χ² test fails.
    excess = 1.0 if solution.test.passed else max(1.0, solution.noise_scale)
    tests = _tests_of_fit(solution, model, _heating(fit))
    covered = _covered(done, fit.rates, temperature)
    record = temperature[int(done.rows[0]) : int(done.rows[-1]) + 1]
    whiten = Whitener(readings)
    # At stable temperatures nothing lags, and between them no data are used.
    answers = answers_of(built) if stable else whiten.answers(solution)
    lag_std = 0.0 if lag.in_rows else lag.std
    run = EstimatedRun(solution.parameters, covered[0], answers, lag_std, goes_one_way(record), options.clock_doubt)
    estimated = built._replace(about=solution.parameters)
    known = solution.known._replace(spread=solution.known.spread * excess)
    budget = budget_of_estimate(estimated, known, run, noise)
    of_fit = failed(tests | dict(added_tests(spec, whiten, solution, excess)))
    of_fit += beyond_the_spec(model, model.to_reported @ solution.parameters, prior_deviations(model))
    contradicted = tuple(one.name for one in (*shown.findings, *of_fit) if one.contradicts)
    beyond = [beyond_the_data(requirement, *covered) for requirement in spec.requirement]
    requirements = tuple(
        _judged(requirement_row(estimated, budget, requirement), sentence, contradicted)
        for requirement, sentence in zip(spec.requirement, beyond, strict=True)
    )
    of_tests = {test: outcome for test, (outcome, _) in tests.items()}
    calibration = calibration_of(
        built,
        logs,
        name,
        solution,
        covered,
        lag.seconds,
        budget,
        fit=fit_rows(of_tests.items()),
        result=tuple(map(result_of_requirement, requirements)),
        contradicted=contradicted,
        lacks=lacks,
        provenance=provenance_of(
            logs, name, sources, estimator=_estimator(solution, lag, options), rows=str(np.count_nonzero(solution.used))
        ),
    )
    sentences = [
        *(points_of(built, readings.log).sentences if stable else []),
        *fit.messages,
        *sentences_of([*_remarks(solution), *of_fit]),
        *([f"not observable: {', '.join(calibration.unobservable)}"] if calibration.unobservable else []),
        *one_way_sentences(built, solution.known),
        *branch_sentences(spec),
        *attitude_sentences(spec),
        *omitted_sentences(spec, record, lag.std is not None),
        *filter(None, beyond),
    ]
    return SensorEstimate(
        name,
        built,
        done,
        solution,
        calibration,
        requirements,
        of_tests,
        tuple(sentences),
        lag,
        _counts(logs, name, done),
    )


def _judged(row: RequirementRow, beyond: str | None, contradicted: Sequence[str]) -> RequirementRow:
    """A requirement as an estimate meets it: no verdict where the data lack what it asks for (`beyond`), or contradict
    the model."""
    verdict = "not covered" if beyond and row.verdict in ("met", "missed") else row.verdict
    return row.model_copy(update={"verdict": "not valid" if contradicted else verdict})


def _estimator(solution: ImuEstimate, lag: Lag, options: Options) -> str:
    parts = [f"Gauss-Newton with finite rotations, {solution.rounds} iterations"]
    if lag.std is not None:
        parts.append(f"lag fitted: {lag.seconds:.4g} s, 1 sigma {lag.std:.2g} s")
    if options.clock == "host":
        parts.append("clock of the computer")
    return "; ".join(parts)


def _heating(fit: Fit) -> np.ndarray:
    """Of the rows used, whether the temperature rises over their segments."""
    at, ends = fit.readings.segments, fit.readings.temperature_c[fit.readings.done.rows]
    return (ends[at.last + 1] > ends[at.first])[at.row_segment][fit.solution.used]


def _tests_of_fit(solution: ImuEstimate, model: ImuModel, heating: np.ndarray) -> dict[str, tuple[Test, str]]:
    """The tests of a fit by their names in the calibration file, each with what to say if it fails; `heating`: truth
    values of the rows used."""
    named = {
        CHI_SQUARED: (
            solution.test,
            f"the residuals are {solution.noise_scale:.3g} times the noise of the spec: the model is incomplete (try a "
            "higher degree of the polynomials), something jumped or drifted during the run, or the noise figures are "
            "too small; requirements are judged with the larger noise",
        )
    }
    # That of a single channel is the whole fit's.
    for i, c in enumerate(model.channels if len(model.channels) > 1 else ()):
        own = solution.channel == i
        left = solution.residuals[own]
        free = round(len(left) - float(np.sum(solution.leverage[own])))
        test = estimation.chi_squared_test(float(left @ left), free)
        scale = np.sqrt(test.statistic / max(test.degrees, 1))
        sentence = f"{c.name.replace('_', ' ')}: its residuals are {scale:.3g} times the noise of the spec"
        named[f"{c.name}: chi-squared"] = test, sentence
    if _FEW < np.mean(heating) < 1.0 - _FEW:
        named[HEATING_AGAINST_COOLING] = halves_test(solution.white, heating), _LOOP
    return named


def _remarks(solution: ImuEstimate) -> Iterator[FitFinding]:
    """What contradicts no model."""
    if solution.moved > _MOVED:
        yield FitFinding(
            "convergence",
            solution.moved,
            _MOVED,
            f"the estimate has not converged (last step: {solution.moved:.2g} standard deviations): the table differs "
            "from the spec by more than small angles",
            contradicts=False,
        )
    if solution.test.probability > 1.0 - _TOO_GOOD:
        yield FitFinding(
            "small residuals",
            solution.noise_scale,
            1.0,
            f"the residuals are only {solution.noise_scale:.3g} times the noise of the spec: the spec's noise figures "
            "are larger than the noise of this sensor",
            contradicts=False,
        )


def _covered(done: ExecutedImu, rates: np.ndarray, temperature: np.ndarray) -> tuple[Range, Range]:
    """The ranges of temperature (°C) and rate (rad/s) of the pieces used, from those of the rows; rest included."""
    line, whole = done.motion.line, ~np.asarray(done.motion.line.gap)
    if line.rates:
        warm, fast = np.asarray(line.level)[whole], np.asarray(line.terms)[whole, 0]
    else:
        warm = temperature[_rows_within(done, whole, len(temperature))]
        fast = rates[_rows_within(done, whole & (done.motion.axis >= 0), len(rates))]
    fast = np.concatenate([[0.0], fast[np.isfinite(fast)]])
    return _outwards(warm, _TEMPERATURE_STEP_K), _outwards(fast, _RATE_STEP_RAD_PER_S)


def _rows_within(done: ExecutedImu, pieces: np.ndarray, count: int) -> np.ndarray:
    """`(count,)`: whether a row lies in one of the chosen pieces."""
    return estimation.within(np.stack([done.rows[:-1], done.rows[1:]], axis=1)[pieces], count)


def _outwards(values: np.ndarray, step: float) -> Range:
    """The range of values, rounded outwards to whole steps."""
    low, high = float(values.min()) / step, float(values.max()) / step
    return float(np.floor(low + 1e-6) * step), float(np.ceil(high - 1e-6) * step)


def _counts(logs: Sequence[Log], name: str, done: ExecutedImu) -> dict[str, int]:
    """Numbers of rows of all logs: used, without a reference, and left out, by reason."""
    whole = ~np.asarray(done.motion.line.gap)
    used = _rows_within(done, whole, sum(len(log.time_s) for log in logs))
    parts = np.split(used, np.cumsum([len(log.time_s) for log in logs])[:-1])
    counts: dict[str, int] = {}
    for log, own in zip(logs, parts, strict=True):
        for reason, count in count_rows(log, log.unit_index(name), own).items():
            counts[reason] = counts.get(reason, 0) + count
    return counts


def estimate_rows(report: EstimateReport) -> dict[str, Any]:
    """All numbers for `--json`."""
    return {
        "simulated": any(c.simulated for c in report.calibrations),
        "as_wished": report.as_wished,
        "units": [_sensor_rows(one) for one in report.sensors],
    }


def _sensor_rows(report: SensorEstimate) -> dict[str, Any]:
    """All numbers of an estimate for `--json`."""
    calibration, solution = report.calibration, report.solution
    left = np.abs(solution.residuals)
    return rows_of_estimate(
        calibration,
        report.messages,
        readings=int(np.count_nonzero(solution.used)),
        rows=dict(report.counts),
        lag_s=report.lag.seconds,
        lag_std_s=report.lag.std,
        noise_scale=finite(solution.noise_scale),
        share_beyond_three_sigma=float(np.mean(left > 3.0)),
        largest_residual_sigma=float(left.max()),
        table=[row.model_dump(mode="json") for row in calibration.table],
        requirements=[
            row.model_dump(mode="json", exclude_none=True) | {"value": row.judged, "named": row.decisive}
            for row in report.requirements
        ],
    )
