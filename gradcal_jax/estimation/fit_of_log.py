"""The fit of a model to the rows of a log (the executed motion, the readings of it, the estimate), and its calibration.

The motion is read from the log; the rates within a move are first the gyros' own, then corrected by the first estimate.
"""

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import replace
from typing import Any, NamedTuple

import numpy as np

from gradcal_jax import estimation
from gradcal_jax.calibration import (
    FORMAT,
    FRAME_OF_CASE,
    ORDER,
    CalibratedChannel,
    CalibratedTerm,
    Calibration,
    Covariance,
    Noise,
    PathCoefficient,
    Residuals,
    TableError,
    build_term,
)
from gradcal_jax.calibration.correction import correct_triads
from gradcal_jax.estimation import (
    ExecutedImu,
    ImuEstimate,
    ImuRows,
    TablePoints,
    Test,
)
from gradcal_jax.estimation.calibration_rows import (
    fit_rows,
    provenance_of,
    random_walks,
    result_of_requirement,
    section_of,
)
from gradcal_jax.estimation.findings import (
    SCALE_FACTOR_ERROR,
    refuse_implausible,
    refuse_misaligned,
    wrapped_sentence,
)
from gradcal_jax.estimation.imu_readings import errors_of_gears
from gradcal_jax.estimation.lag_of_maps import Fit, Lag, LateTemperatures, fit_with_lag
from gradcal_jax.estimation.log_rows import Options, read_by_events
from gradcal_jax.information.plan_sentences import prior_deviations, unobserved_parameters
from gradcal_jax.model import (
    AXIS_NAMES,
    Channel,
    Discrepancy,
    GradientOfBias,
    Hysteresis,
    Map,
    OwnTerm,
    ProductTerm,
)
from gradcal_jax.model.build import BuiltImu, course_before
from gradcal_jax.model.nodes import INPUTS
from gradcal_jax.records.log import Log, LogError
from gradcal_jax.spec.absent import with_typical
from gradcal_jax.spec.plan import StandardPlan
from gradcal_jax.spec.schedule import StandardSchedule
from gradcal_jax.spec.spec_sections import Spec
from gradcal_jax.tables.contracts import RequirementRow
from gradcal_jax.tables.quantity import Quantity

# Standard deviations by which a coefficient must be beyond what a device has.
_SURE = 3.0
# Residuals of this many times the noise come from a wrong table, order of axes, or sign.
_ABSURD = 100.0
# Temperatures (°C) and rates (rad/s) of a calibration that is used at those of its own data alone.
_EVERYWHERE = (-273.0, 1000.0), (-1e4, 1e4)
# Change of an estimated angle (rad) below which it stands still, and the most linearisations until then.
_STANDS, _LINEARISED = 2e-6, 24
# The last step of the first fit, in standard deviations: the second one begins there.
_COARSE = 0.1
# The linearisation from which on half of the change is taken: with a large azimuth the whole of it may oscillate.
_HALF_FROM = 6


def _may_lag(built: BuiltImu) -> bool:
    """Whether the spec leaves a lag of the maps to the data: it does not state that there is none, and no term of the
    model has another temperature of its own."""
    sensor, terms = built.spec.sensor, built.model.terms
    others = any(getattr(t, "other", None) for t in terms)
    return not (others or sensor.second_thermometer is not None or sensor.temperature_lag == 0.0)


def fit_readings(
    built: BuiltImu,
    name: str,
    rows: ImuRows,
    temperature: np.ndarray,
    *,
    before: Fit | None = None,
    checked: bool = True,
) -> Fit:
    """The fit with a `temperature` (degC) for each row. `before`: a fit of the same rows, about which this one is
    linearised, and by which the rates within moves are corrected; None: that by the gyros' own rates. (A rate-dependent
    scale factor of a per cent would be estimated at wrong rates otherwise.) `checked`: whether readings of another unit
    or table are refused, which a lag may make of the right ones."""
    if before is None:
        before = _pass(built, name, rows, temperature, None)
        before = _likely(built, name, before) if checked else before
    fit = _pass(built, name, rows, temperature, before)
    return _likely(built, name, fit) if checked else fit


def _corrected(
    built: BuiltImu, rows: ImuRows, temperature: np.ndarray, parameters: np.ndarray
) -> tuple[np.ndarray, np.ndarray]:
    """Rates (rad/s) and specific forces (m/s²) `(n, 3)` corrected by an estimate."""
    held = tuple(calibrated_channels(built, built.model.to_reported @ parameters, _EVERYWHERE))
    rates, felt = correct_triads(held, rows.rates, rows.force, temperature)
    # Where no accelerometer is, nothing tells what a move adds to gravity.
    felt = np.where([any(c.input == f"force {a}" for c in held) for a in AXIS_NAMES], felt, np.nan)
    # Data that hardly determine a map give one that no gyro has, which corrects nothing.
    known = np.isfinite(rows.rates)
    far = np.nanmax(np.abs(rates - rows.rates), axis=0, initial=0.0, where=known)
    fastest = np.nanmax(np.abs(rows.rates), axis=0, initial=0.0, where=known)
    return np.where(far <= SCALE_FACTOR_ERROR * fastest, rates, rows.rates), felt


def _pass(
    built: BuiltImu,
    name: str,
    rows: ImuRows,
    temperature: np.ndarray,
    before: Fit | None,
) -> Fit:
    """The executed motion, the unit's readings and the estimate, linearised about the one `before`; where no encoder
    tells the table's angles, again about those of the estimate, until they stand still. Errors: `LogError` where they
    do not."""
    free, plan = built.spec.rig.table.by_gravity, built.spec.plan
    seen, felt, first, number = rows, None, None, 0
    if before is not None:
        # Angles that no encoder tells are estimated.
        rows, first = rows._replace(angles=before.readings.log.angles), before.solution
        rates, felt = _corrected(built, rows, temperature, first.parameters)
        seen = rows._replace(rates=rates)
    about = None if first is None else first.parameters
    corrected_by = None if first is None else (first.parameters, first.known)
    while True:
        try:
            done = _executed(built, seen)
            done = done._replace(motion=replace(done.motion, history=course_before(built.spec)))
        except ValueError as error:
            raise LogError(f"{name}: {error}") from None
        readings = estimation.readings_of(
            built.model, done, rows, temperature, 0 if built.rough else built.points, felt, corrected_by, free=free
        )
        of_gears = errors_of_gears(built.spec, readings, None if first is None else first.parameters)
        readings = readings.with_common(of_gears)
        if isinstance(plan, StandardPlan) and plan.estimator == "least squares":
            solution = estimation.estimate_unweighted(readings)
        else:
            settled = {"settled": _COARSE} if before is None and not free else {}
            solution = estimation.solve_imu(readings, about, **settled)
        if not free:
            break
        errors = estimation.angle_errors(readings, solution.parameters)
        largest = float(np.nanmax(np.abs(errors)))
        if largest < _STANDS:
            break
        if number == _LINEARISED:
            raise LogError(
                f"{name}: the angles from gravity do not converge (they still change by "
                f"{np.degrees(largest):.2g} deg from one linearisation to the next, after {number} linearisations): is "
                "the IMU at rest in the standstills, and do the plan's turns and the directions of the axes agree with "
                "the log?"
            )
        share = 0.5 if number >= _HALF_FROM else 1.0
        angles = rows.angles + share * np.where(np.isfinite(errors), errors, 0.0)
        rows, seen = rows._replace(angles=angles), seen._replace(angles=angles)
        about = solution.parameters if about is None else about + share * (solution.parameters - about)
        number += 1
    return Fit(done, readings, solution, seen.rates)


def _refuse_the_implausible(built: BuiltImu, name: str, solution: ImuEstimate) -> None:
    """Raise `LogError` for the first channel with coefficients that no device has."""
    model, priors = built.model, prior_deviations(built.model)
    values, begin = model.to_reported @ solution.parameters, 0
    # What the data hardly determine proves nothing.
    doubt = _SURE * solution.known.deviations(model.to_reported)
    values = np.sign(values) * np.maximum(np.abs(values) - np.where(np.isfinite(doubt), doubt, np.inf), 0.0)
    for c in model.channels:
        own = slice(begin, begin + c.size)
        begin = own.stop
        refuse_implausible(f"{name}, {c.name.replace('_', ' ')}", c.names(), values[own], priors[own])


def _likely(built: BuiltImu, name: str, fit: Fit) -> Fit:
    """The same fit. Errors: `LogError` for readings of another IMU or table."""
    estimate = fit.solution.estimate
    scale = float(np.sqrt(estimate.chi_squared / max(estimate.degrees, 1)))
    absurd = (
        f"the readings of the IMU differ from those of the table by {scale:.3g} times the noise: do the mounting, the "
        "axes and signs of the IMU and the table's angles agree with the spec?"
    )
    try:
        _refuse_the_implausible(built, name, fit.solution)
    except LogError as error:
        # What is implausible may only follow from readings of the table that are wrong.
        raise (LogError(f"{error} And {absurd}") if scale > _ABSURD else error) from None
    if scale > _ABSURD:
        raise LogError(f"{name}: {absurd}")
    return fit


def _executed(built: BuiltImu, seen: ImuRows) -> ExecutedImu:
    """The executed motion by the rates of `seen`. Raises `ValueError`."""
    encoder, geometry = built.model.encoder, built.motion.geometry
    if isinstance(built.spec.plan, StandardPlan):
        return estimation.motion_at_points(points_of(built, seen), seen, geometry)
    if read_by_events(built.spec):
        return estimation.motion_by_readings(seen, geometry)
    spacing = {} if encoder.held else {"read_every": float(encoder.every[0])}
    done = estimation.executed_imu(seen, geometry, **spacing)
    return estimation.readings_counted(done, built.model)


def points_of(built: BuiltImu, rows: ImuRows) -> TablePoints:
    """The points of the standard method in a log's rows. Raises `ValueError` where there are none."""
    plan = built.spec.schedule
    assert isinstance(plan, StandardSchedule)
    assert rows.table_rate is not None
    planned = np.array(plan.temperatures), np.array(plan.rates)
    reference = rows.temperature_c, rows.table_rate, rows.usable
    return estimation.plateaus(rows.time_s, *reference, *planned, plan.integration, points=plan.shared)


class Recorded(NamedTuple):
    """The rows of one sensor, and messages on them."""

    rows: ImuRows
    messages: tuple[str, ...]


class FittedRows(NamedTuple):
    """The fit of one sensor's rows, the temperature of its maps (°C) and their lag."""

    built: BuiltImu
    recorded: Recorded
    temperature: np.ndarray
    fit: Fit
    lag: Lag


def fit_of(built: BuiltImu, name: str, recorded: Recorded, options: Options) -> FittedRows:
    """The fit of one sensor's rows."""
    try:
        return _fit_of(built, name, recorded, options)
    except LogError as error:
        if sentence := wrapped_sentence(recorded.rows.angles):
            raise LogError(f"{error}{sentence}") from error
        raise


def _fit_of(built: BuiltImu, name: str, recorded: Recorded, options: Options) -> FittedRows:
    rows, messages = recorded
    temperature_of = LateTemperatures(rows, _wander(built.spec))
    refuse_misaligned(name, estimation.coarse_fits(rows, built.motion.geometry), built.model.channels)
    lag, stable = Lag(0.0 if isinstance(options.lag, str) else options.lag), isinstance(built.spec.plan, StandardPlan)
    fit = None
    if options.lag == "fit" and stable:
        messages = *messages, "a lag cannot be estimated at constant temperatures: zero lag is assumed"
    elif isinstance(options.lag, str) and not stable and (options.lag == "fit" or _may_lag(built)):

        def fit_at(lag: float, before: Fit | None = None) -> Fit:
            options.progress(f"IMU {name}: fit with a lag of {lag:.3g} s")
            # A lag may make readings of another IMU of the right ones.
            late = temperature_of(lag)
            at_lag = fit_readings(built, name, rows, late, before=before, checked=False)
            return _with_errors(at_lag, [late + doubt for doubt in temperature_of.doubts(lag)])

        size = built.spec.sensor.temperature_lag
        lag, fit, said = fit_with_lag(fit_at, temperature_of, size, wanted=options.lag == "fit")
        messages = *messages, *said
    temperature = temperature_of(lag.seconds)
    doubts = [] if stable else temperature_of.doubts(lag.seconds)
    if fit is not None:
        fit = _likely(built, name, fit)
    else:
        options.progress(f"IMU {name}: fit")
        fit = fit_readings(built, name, rows, temperature)
        fit = _with_errors(fit, [temperature + doubt for doubt in doubts])
    possible = float(built.spec.sensor.temperature_lag or 0.0) if options.lag == "auto" and _may_lag(built) else 0.0
    if possible and not (stable or lag.seconds):
        # A small lag cannot be fitted, but tests of the fit would notice it.
        doubts = temperature_of.doubts(possible)
        others = [temperature_of(possible), *(temperature + doubt for doubt in doubts)]
        fit, lag = _with_errors(fit, others), Lag(0.0, in_rows=True)
    return FittedRows(built, recorded._replace(messages=messages), temperature, fit, lag)


def _wander(spec: Spec) -> float:
    """The rate (K²/s) at which the variance of the thermometer's error grows in short times, or a typical one's."""
    sensor = with_typical(spec).sensor
    errors = [triad.temperature_error for triad in (sensor.gyro, sensor.accelerometer) if triad is not None]
    known = [(float(e.standard_deviation), float(e.correlation_time)) for e in errors if e and e.correlation_time]
    rates = [2.0 * size**2 / time for size, time in known]
    return max(rates, default=0.0)


def _with_errors(fit: Fit, others_c: Sequence[np.ndarray]) -> Fit:
    """The fit with errors of the maps' temperature common to all its rows; `others_c` (°C): temperatures that each is
    off by one standard deviation."""
    if not others_c:
        return fit
    readings, parameters = fit.readings, fit.solution.parameters
    changes = [readings.at(other_c, parameters) - readings.expected(parameters) for other_c in others_c]
    readings = readings.with_common(np.stack(changes, axis=1))
    return fit._replace(readings=readings, solution=estimation.solve_imu(readings, parameters))


def calibration_of(
    built: BuiltImu,
    logs: Sequence[Log],
    name: str,
    solution: ImuEstimate,
    tests: Mapping[str, Test],
    requirements: tuple[RequirementRow, ...],
    covered: tuple[tuple[float, float], tuple[float, float]],
    lag: Lag,
    options: Options,
    sources: dict[str, str],
) -> Calibration:
    """The calibration of a sensor of this `name`; `covered`: temperatures (°C) and rates (rad/s)."""
    model, spec = built.model, built.spec
    reported = model.to_reported
    values, deviations = reported @ solution.parameters, solution.known.deviations(reported)
    names, units = model.names(), model.units()
    priors = prior_deviations(model)
    own = slice(0, model.calibrated)
    held = [
        one.model_copy(update={"residuals": residuals_of(solution.residuals_of(k))})
        for k, one in enumerate(calibrated_channels(built, values, covered, lag.seconds))
    ]
    kept = {f"{c.name}.{n}" for c in held for term in c.term for n in term.coefficients}
    covariant = [k for k in range(model.calibrated) if np.isfinite(deviations[k]) and names[k] in kept]
    matrix = solution.known.covariance(reported[own])[np.ix_(covariant, covariant)]
    frame = spec.sensor.frame
    case = frame == "case"
    section: dict[str, Any] = {
        "format": FORMAT,
        "title": spec.title or f"calibration of {name}",
        "serial_number": name,
        "simulated": any(one.simulated for one in logs),
        "frame": FRAME_OF_CASE if case else "the table's axes at zero angles, rotated by the nominal mounting",
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
        "fit": fit_rows(tests.items()),
        "unobservable": tuple(n for n in unobserved_parameters(model, solution.known) if n in kept),
        "noise": _noise(spec, logs[0]),
        "result": tuple(map(result_of_requirement, requirements)),
        "provenance": provenance_of(
            logs,
            name,
            sources,
            estimator=_estimator(solution, lag, options),
            rows=str(int(np.count_nonzero(solution.used))),
        ),
    }  # fmt: skip
    return Calibration(**section)


def _estimator(solution: ImuEstimate, lag: Lag, options: Options) -> str:
    parts = [f"Gauss-Newton with finite rotations, {solution.rounds} iterations"]
    if lag.std is not None:
        parts.append(f"lag fitted: {lag.seconds:.4g} s, 1 sigma {lag.std:.2g} s")
    if options.clock == "host":
        parts.append("clock of the computer")
    return "; ".join(parts)


def residuals_of(white: np.ndarray) -> Residuals:
    """The histogram of whitened residuals (in standard deviations, in order of time), and their rms along the run."""
    counts = np.histogram(white, np.concatenate([[-np.inf], np.arange(-4.0, 4.25, 0.5), [np.inf]]))[0]
    tenths = np.array_split(white, 10) if len(white) >= 100 else []
    return Residuals(counts=tuple(counts.tolist()), rms=tuple(float(np.sqrt(np.mean(part**2))) for part in tenths))


def calibrated_channels(
    built: BuiltImu, values: np.ndarray, covered: tuple[tuple[float, float], tuple[float, float]], lag: Any = None
) -> Iterator[CalibratedChannel]:
    """The calibrated channels, from all reported parameters `(p,)`; `covered`: temperatures (°C) and rates (rad/s)."""
    begin = 0
    shared: dict[str, Any] = {
        "valid_temperature": tuple(f"{t:.1f} degC" for t in covered[0]),
        "valid_rate": tuple(f"{np.degrees(r):.1f} deg/s" for r in covered[1]),
    }
    shared |= {"thermal_lag": Quantity.of(float(lag), "s")} if lag else {}
    for c in built.model.channels:
        terms = _terms(built.spec, c, values[begin : begin + c.size])
        yield CalibratedChannel(kind=c.kind, axis=AXIS_NAMES[c.axis], term=tuple(terms), **shared)
        begin += c.size


def _terms(spec: Spec, channel: Channel, values: np.ndarray) -> Iterator[CalibratedTerm]:
    triad = getattr(spec.sensor, channel.kind)
    for term in channel.terms:
        # A sensitivity to dT/dt and what else depends on the path of temperature are estimated beside the calibration.
        if isinstance(term, Discrepancy | GradientOfBias | OwnTerm):
            continue
        own = values[channel.where(term.name)]
        coefficients = {name: float(v) for name, v in zip(term.names(), own, strict=True)}
        section = getattr(triad, section_of(triad, term.name))
        assert isinstance(term, Map)
        bases = {"temperature": section.temperature, "rate": getattr(section, "rate", None)}
        yield build_term(term.name, term.unit, term.signals, coefficients, **bases)


def _path_coefficients(built: BuiltImu, values: np.ndarray, deviations: np.ndarray) -> Iterator[PathCoefficient]:
    """Path-of-temperature terms, estimated in addition to the maps, from all reported parameters."""
    begin = 0
    for c in built.model.channels:
        own_input = (f"{INPUTS[c.kind]} {AXIS_NAMES[c.axis]}",)
        for term in c.terms:
            own = slice(begin, begin + term.size)
            begin = own.stop
            if not isinstance(term, OwnTerm | GradientOfBias):
                continue
            of_path: dict[str, Any] = {}
            if isinstance(term, Hysteresis):
                of_path["width"] = Quantity.of(float(term.width), "K")
            elif isinstance(term, ProductTerm) and term.signals in ((), own_input) and term.path_factors == 1:
                of_path["second_thermometer"] = term.other is not None
            elif isinstance(term, OwnTerm):
                of_path["own"] = True
            for name, value, std in zip(term.names(), values[own], deviations[own], strict=True):
                if not isinstance(term, OwnTerm) or name not in term.nuisances:
                    yield PathCoefficient(
                        channel=c.name, name=name, value=float(value), standard_deviation=float(std), unit=term.unit,
                        **of_path,
                    )  # fmt: skip


def _noise(spec: Spec, log: Log) -> Noise:
    densities: dict[str, Any] = {"sample_rate": Quantity.of(1.0 / log.sample_interval_s, "Hz")}
    if (gyro := spec.sensor.gyro) is not None:
        densities |= random_walks(gyro)
    if (force := spec.sensor.accelerometer) is not None:
        densities["velocity_random_walk"] = force.velocity_random_walk
    return Noise(**densities)
