"""The fit of a model to the rows of a log: the executed motion, the readings of it, the estimate, and the maps' lag.

The motion is read from the log; the rates within a move are first the gyros' own, then corrected by the first estimate.
"""

from collections.abc import Sequence
from dataclasses import replace

import numpy as np
from scipy.ndimage import minimum_filter1d

from gradcal_jax import estimation
from gradcal_jax.calibration.correction import correct_triads
from gradcal_jax.estimation import ExecutedImu, ImuRows, TablePoints
from gradcal_jax.estimation.calibration_of_fit import calibrated_channels
from gradcal_jax.estimation.clocks import Options
from gradcal_jax.estimation.findings import (
    SCALE_FACTOR_ERROR,
    refuse_implausible,
    refuse_misaligned,
    wrapped_sentence,
)
from gradcal_jax.estimation.imu_readings import errors_of_gears
from gradcal_jax.estimation.lag_of_maps import Fit, Lag, LateTemperatures, fit_with_lag
from gradcal_jax.estimation.log_rows import read_by_events
from gradcal_jax.information.plan_sentences import prior_deviations
from gradcal_jax.model import AXIS_NAMES
from gradcal_jax.model.build import BuiltImu
from gradcal_jax.motion.plan_motion import course_before
from gradcal_jax.records.log import LogError
from gradcal_jax.spec.absent import with_typical
from gradcal_jax.spec.plan import StandardPlan
from gradcal_jax.spec.schedule import StandardSchedule
from gradcal_jax.spec.spec_sections import Spec

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
# Of rows at rest, one in so many is corrected by itself.
_EACH = 32
# The linearisation from which on half of the change is taken: with a large azimuth the whole of it may oscillate.
_HALF_FROM = 6


def fit_of(built: BuiltImu, name: str, rows: ImuRows, options: Options) -> Fit:
    """The fit of one sensor's rows, with the lag of its maps if the options leave it to the data. Errors: `LogError`
    for readings of another sensor or table."""
    sensor, stable = built.spec.sensor, isinstance(built.spec.plan, StandardPlan)
    temperature_of = LateTemperatures(rows, _wander(built.spec))

    def fit_at(lag: float, before: Fit | None = None, *, checked: bool = False) -> Fit:
        options.progress(f"IMU {name}: fit with a lag of {lag:.3g} s")
        fit = fit_readings(built, name, rows, temperature_of(lag), before=before, checked=checked)
        return fit if stable else _with_errors(fit, temperature_of, lag)

    try:
        refuse_misaligned(name, estimation.coarse_fits(rows, built.motion.geometry), built.model.channels)
        if stable or options.lag != "auto" or not _may_lag(built):
            lag = Lag(0.0 if options.lag == "auto" else options.lag)
            return fit_at(lag.seconds, checked=True)._replace(lag=lag)
        # (A lag may make readings of another IMU of the right ones.)
        fit = _likely(built, name, fit_with_lag(fit_at, temperature_of, sensor.temperature_lag))
        if (possible := float(sensor.temperature_lag or 0.0)) and not fit.lag.seconds:
            # A small lag cannot be fitted, but tests of the fit would notice it.
            fit = _with_errors(fit, temperature_of, possible, [temperature_of(possible)])
            fit = fit._replace(lag=Lag(0.0, in_rows=True))
    except LogError as error:
        if sentence := wrapped_sentence(rows.angles):
            raise LogError(f"{error}{sentence}") from error
        raise
    return fit


def _may_lag(built: BuiltImu) -> bool:
    """Whether the spec leaves a lag of the maps to the data: it does not state that there is none."""
    return built.spec.sensor.temperature_lag != 0.0


def _wander(spec: Spec) -> float:
    """The rate (K²/s) at which the variance of the thermometer's error grows in short times, or a typical one's."""
    sensor = with_typical(spec).sensor
    errors = [triad.temperature_error for triad in (sensor.gyro, sensor.accelerometer) if triad is not None]
    known = [(float(e.standard_deviation), float(e.correlation_time)) for e in errors if e and e.correlation_time]
    rates = [2.0 * size**2 / time for size, time in known]
    return max(rates, default=0.0)


def _with_errors(fit: Fit, temperature_of: LateTemperatures, lag: float, others_c: Sequence[np.ndarray] = ()) -> Fit:
    """The fit with errors of the maps' temperature common to all its rows: of a begin on a ramp with this lag, and
    those of temperatures `others_c` (°C) that each is off by one standard deviation."""
    readings, parameters = fit.readings, fit.solution.parameters
    others = [*others_c, *(readings.temperature_c + doubt for doubt in temperature_of.doubts(lag))]
    if not others:
        return fit
    changes = [readings.at(other_c, parameters) - readings.expected(parameters) for other_c in others]
    readings = readings.with_common(np.stack(changes, axis=1))
    return fit._replace(readings=readings, solution=estimation.solve_imu(readings, parameters))


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
    at = corrected_rows(rows.standing, rows.usable)
    true = correct_triads(held, rows.rates[at], rows.force[at], temperature[at])
    rates, felt = (_between(of, at, done) for of, done in zip((rows.rates, rows.force), true, strict=True))
    # Where no accelerometer is, nothing tells what a move adds to gravity.
    felt = np.where([any(c.input == f"force {a}" for c in held) for a in AXIS_NAMES], felt, np.nan)
    # Data that hardly determine a map give one that no gyro has, which corrects nothing.
    known = np.isfinite(rows.rates)
    far = np.nanmax(np.abs(rates - rows.rates), axis=0, initial=0.0, where=known)
    fastest = np.nanmax(np.abs(rows.rates), axis=0, initial=0.0, where=known)
    return np.where(far <= SCALE_FACTOR_ERROR * fastest, rates, rows.rates), felt


def corrected_rows(standing: np.ndarray, usable: np.ndarray) -> np.ndarray:
    """The rows that are corrected by themselves, of `(n,)` truth values: one in 32 of the usable rows deep in a rest,
    where a correction changes with the temperature alone and most rows of a run are, and all other usable ones."""
    # (What is beyond the log's ends does not stand.)
    deep = np.asarray(minimum_filter1d(standing & usable, 2 * _EACH, mode="constant"), bool)
    return np.flatnonzero(usable & ~(deep & (np.arange(len(deep)) % _EACH > 0)))


def _between(measured: np.ndarray, at: np.ndarray, true: np.ndarray) -> np.ndarray:
    """Values of all rows `(n, 3)`, with the corrections of the rows `at` and what lies between these."""
    change, every = true - measured[at], np.arange(len(measured))
    return measured + np.stack([np.interp(every, at, of) for of in change.T], axis=1)


def _pass(built: BuiltImu, name: str, rows: ImuRows, temperature: np.ndarray, before: Fit | None) -> Fit:
    """The executed motion, the unit's readings and the estimate, linearised about the one `before`; where no encoder
    tells the table's angles, again about those of the estimate, until they stand still. Errors: `LogError` where they
    do not."""
    free, seen, felt, about, corrected_by = built.spec.rig.table.by_gravity, rows, None, None, None
    if before is not None:
        # Angles that no encoder tells are estimated.
        rows, about = rows._replace(angles=before.readings.log.angles), before.solution.parameters
        rates, felt = _corrected(built, rows, temperature, about)
        seen, corrected_by = rows._replace(rates=rates), (about, before.solution.known)
    first, settled = about, {"settled": _COARSE} if before is None and not free else {}
    number = 0
    while True:
        try:
            done = _executed(built, seen)
        except ValueError as error:
            raise LogError(f"{name}: {error}") from None
        done = done._replace(motion=replace(done.motion, history=course_before(built.spec)))
        readings = estimation.readings_of(
            built.model, done, rows, temperature, 0 if built.rough else built.points, felt, corrected_by, free=free
        )
        readings = readings.with_common(errors_of_gears(built.spec, readings, first))
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
    return Fit(readings, solution, seen.rates)


def _likely(built: BuiltImu, name: str, fit: Fit) -> Fit:
    """The same fit. Errors: `LogError` for readings of another IMU or table: residuals of a hundred times the noise,
    or coefficients that no device has."""
    model, solution, begin = built.model, fit.solution, 0
    scale = float(np.sqrt(solution.chi_squared / max(solution.degrees, 1)))
    absurd = (
        f"the readings of the IMU differ from those of the table by {scale:.3g} times the noise: do the mounting, the "
        "axes and signs of the IMU and the table's angles agree with the spec?"
    )
    priors, values = prior_deviations(model), model.to_reported @ solution.parameters
    # What the data hardly determine proves nothing.
    doubt = _SURE * solution.known.deviations(model.to_reported)
    values = np.sign(values) * np.maximum(np.abs(values) - np.where(np.isfinite(doubt), doubt, np.inf), 0.0)
    for c in model.channels:
        own = slice(begin, begin + c.size)
        begin = own.stop
        try:
            refuse_implausible(f"{name}, {c.name.replace('_', ' ')}", c.names(), values[own], priors[own])
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
    return estimation.plateaus(rows, np.array(plan.temperatures), np.array(plan.rates), plan.integration, plan.shared)
