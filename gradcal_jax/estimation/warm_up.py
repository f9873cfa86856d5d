"""The biases over temperature of a vehicle that warms up at rest, gyros and accelerometers, without a spec.

A flight controller heats up after it is switched on; PX4 and ArduPilot fit a cubic to its biases and subtract it. Here
the same cubics are generalised least squares of means over stretches of the record, with the white noise of the record
(from its Allan deviation), and the drift and rate random walk that are typical of the sensor's class.

At rest, a gyro's bias includes any rate of the vehicle, and an accelerometer's bias and a tilt are one number: it
measures its bias plus a part of gravity that nobody knows. What a warm-up shows of it is therefore how the bias
*changes*. It is zero in the middle of the range of temperature, by definition, and six positions at one temperature
tell what it is there (PX4's and ArduPilot's accelerometer calibration).

Of no residual are the lag of the die behind its thermometer, the thermometer's own slow error, a sensitivity to dT/dt
and the Earth's rate: they count as unseen errors, by the figures of the class.
"""

from collections.abc import Sequence
from dataclasses import replace
from typing import Any, NamedTuple

import numpy as np
from scipy.linalg import block_diag, cholesky, solve_triangular

from gradcal_jax import units as unit_of
from gradcal_jax.calibration import (
    FORMAT,
    ORDER,
    CalibratedChannel,
    CalibratedTerm,
    Calibration,
    Covariance,
    Noise,
    UnseenError,
)
from gradcal_jax.estimation.calibration_rows import coefficient_rows, fit_rows, provenance_of
from gradcal_jax.estimation.consistency import Test, chi_squared_test
from gradcal_jax.estimation.standstill import find_standstills
from gradcal_jax.formulas import EARTH_RATE
from gradcal_jax.identify.instability import (
    RestRecord,
    allan_of,
    at_rest,
    number,
    plausible,
    samples_per_row,
    too_noisy,
)
from gradcal_jax.records.log import Log, LogError
from gradcal_jax.spec.bases import TemperaturePolynomial
from gradcal_jax.spec.typical import grade_of_noise, terms_of
from gradcal_jax.tables.quantity import Quantity
from gradcal_jax.units import DEG_PER_SQRT_H

DEGREE = 3
_STRETCHES = 300
# K; over a narrower span the terms of a cubic cannot be separated.
_LEAST_SPAN = 10.0
# A thermometer of larger steps than this, K, is interpolated.
_COARSE_K = 0.2
# Probability below which the data contradict the model (the covariance then grows with the misfit), and above one less
# which the noise of the class is larger than the sensor's.
_RARE = 1e-3


class WarmUpReport(NamedTuple):
    """The calibration of every unit, in SI, and by unit sentences to read before it is used."""

    calibrations: tuple[Calibration, ...]
    messages: dict[str, tuple[str, ...]]

    @property
    def as_wished(self) -> bool:
        """Whether no data contradict the model."""
        return not any(one.contradicted for one in self.calibrations)


class _Means(NamedTuple):
    """Of stretches of a record: time (s), length of the data in it (s), output (SI), temperature (°C), dT/dt (K/s)."""

    time: np.ndarray
    duration: np.ndarray
    output: np.ndarray
    temperature: np.ndarray
    slope: np.ndarray


class _Channel(NamedTuple):
    """A channel's calibration with the covariance of its coefficients and the errors that no residual shows, each a
    change of all coefficients; `walk`: of its white noise; `typical`: figures of its class."""

    calibrated: CalibratedChannel
    covariance: np.ndarray
    unseen: list[tuple[str, np.ndarray]]
    test: Test
    walk: float
    typical: dict[str, Any]
    words: list[str]


def estimate_warm_up(
    logs: Sequence[Log], *, axes: Sequence[str] = (), units: Sequence[str] = (), sources: dict[str, str] | None = None
) -> WarmUpReport:
    """The bias over temperature, a cubic, of every unit in records at rest; each log has units of one clock. Of
    accelerometers, its change over temperature, unless `axes` names gyros. `sources`: names of files.

    **Raises:** `LogError` without a temperature that spans 10 K, without a rest, and where the record shows no white
    noise.
    """
    if missing := [unit for unit in units if not any(unit in log.units for log in logs)]:
        known = ", ".join(unit for log in logs for unit in log.units)
        raise LogError(f"there is no IMU '{missing[0]}' in this log; it has {known}")
    calibrations, messages = list[Calibration](), dict[str, tuple[str, ...]]()
    for log in logs:
        for unit in log.units:
            if not units or unit in units:
                one, messages[unit] = _unit(_marked(log, unit), unit, axes, sources or {})
                calibrations.append(one)
    return WarmUpReport(tuple(calibrations), messages)


def warm_up_rows(report: WarmUpReport) -> dict[str, Any]:
    """All numbers for `--json`, in SI unless they have a unit beside them."""
    rows = [
        {
            "unit": one.serial_number,
            "simulated": one.simulated,
            "parameters": coefficient_rows(one),
            "covariance": None if one.covariance is None else one.covariance.model_dump(mode="json"),
            "valid_temperature_c": [float(t) for t in one.valid_temperature],
            "tests": [row.model_dump(mode="json") for row in one.fit],
            "messages": list(report.messages[one.serial_number]),
        }
        for one in report.calibrations
    ]
    simulated = any(one.simulated for one in report.calibrations)
    return {"simulated": simulated, "as_wished": report.as_wished, "units": rows}


def _unit(log: Log, unit: str, axes: Sequence[str], sources: dict[str, str]) -> tuple[Calibration, tuple[str, ...]]:
    gyros = [_channel(log, axis, unit) for axis in axes or log.axes]
    forces = [] if axes else [_channel(log, axis, unit, force=True) for axis in log.force_axes]
    channels = [*gyros, *forces]
    messages = [
        f"the vehicle's rate is assumed to be zero, so the bias of a gyro includes a part of the Earth's rate, up to "
        f"{EARTH_RATE * unit_of.DEG_PER_H:.0f} deg/h; and it is that of this attitude: in another, the sensitivity of "
        "gyros to g changes it",
        "a warm-up goes one way: it shows neither a hysteresis of the biases, nor how the dies lag behind the "
        "thermometer (the uncertainty includes a minute, typical of such sensors), and a drift looks like a dependence "
        "on temperature. Cool the vehicle down again in the same record to see them",
    ]
    if forces:
        basis = forces[0].calibrated.term[0].temperature
        assert isinstance(basis, TemperaturePolynomial)
        messages.append(
            "accelerometers at rest: a bias and a tilt cannot be separated, so the biases are changes from "
            f"{basis.centre}, where they are zero. Calibrate the accelerometers in "
            "six positions at one temperature afterwards"
        )
    names, unseen, tests = list[str](), list[UnseenError](), dict[str, Test]()
    for of in channels:
        own = [f"{of.calibrated.name}.{name}" for name in of.calibrated.term[0].coefficients]
        names += own[-len(of.covariance) :]
        for name, change in of.unseen:
            coefficients = {one: float(value) for one, value in zip(own, change, strict=True)}
            unseen.append(UnseenError(name=name, coefficients=coefficients))
        tests[f"{of.calibrated.name}: chi-squared"] = of.test
        messages += of.words
    noise: dict[str, Any] = {}
    folded, _ = samples_per_row(log, log.sample_interval_s)
    if np.isfinite(folded):
        walk = max(of.walk for of in gyros) / float(np.sqrt(folded))
        noise["noise"] = Noise(
            angle_random_walk=Quantity.of(walk, "rad/sqrt(s)"),
            rate_random_walk=gyros[0].typical["rate_random_walk"],
            sample_rate=Quantity.of(1.0 / log.sample_interval_s, "Hz"),
        )
    else:
        messages.append(
            "the calibration states no noise, because it is not known whether the log's rows are single samples or "
            'means: state the sensor\'s own rate, as --sensor-rate "400 Hz", or --sensor-rate "means"'
        )
    matrix = np.asarray(block_diag(*(of.covariance for of in channels)))
    named = ", ".join(of.calibrated.axis for of in gyros)
    calibration = Calibration(
        format=FORMAT,
        title="warm-up at rest",
        serial_number=unit,
        simulated=log.simulated,
        frame=f"the axes {named} of the log, not orthogonalised",
        order=ORDER,
        channel=tuple(of.calibrated for of in channels),
        covariance=Covariance(names=tuple(names), matrix=tuple(map(tuple, matrix.tolist()))),
        unseen=tuple(unseen),
        fit=fit_rows(tests.items()),
        contradicted=tuple(name for name, test in tests.items() if test.probability < _RARE),
        provenance=provenance_of([log], unit, sources, estimator="generalised least squares of means over stretches"),
        **noise,
    )
    return calibration, tuple(messages)


def _marked(log: Log, unit: str) -> Log:
    """The log with standstills marked, and the steps of a coarse thermometer interpolated."""
    index = log.unit_index(unit)
    if log.table_axes:
        raise LogError("the log has a table's motion: its calibration needs a spec (--spec) that describes it")
    if log.temperature_c is None or not np.isfinite(temperature := log.temperature_c[index]).any():
        raise LogError(f"the log has no temperature of IMU {unit}, but a bias over temperature needs it")
    usable = log.usable(unit)
    standing = log.standstill
    if standing is None:
        standing = find_standstills(log.rate_rad_per_s[index], log.sample_interval_s, valid=usable)
        log = replace(log, standstill=standing)
    known = np.isfinite(temperature)
    there = temperature[known & usable & (standing >= 0)]
    span = float(np.ptp(there)) if len(there) else 0.0
    if span < _LEAST_SPAN:
        raise LogError(
            f"the temperature of IMU {unit} changes by {span:.2g} K at rest: a bias over temperature needs "
            f"{_LEAST_SPAN:g} K or more, so cool the vehicle before you switch it on, and let it warm up longer"
        )
    levels = np.unique(temperature[known])
    if len(levels) > 1 and float(np.min(np.diff(levels))) > _COARSE_K:
        through = np.interp(log.time_s, *_crossings(log.time_s[known], temperature[known]))
        everyone = np.array(log.temperature_c)
        everyone[index] = through
        log = replace(log, temperature_c=everyone)
    return log


def _crossings(time: np.ndarray, temperature: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """The times and temperatures (°C) at which a rounding thermometer changes its level, where it has no rounding
    error.

    Repeated changes between two levels count once. The ends are extrapolated linearly, within half a level.
    """
    at = np.flatnonzero(np.diff(temperature))
    value, when = 0.5 * (temperature[at] + temperature[at + 1]), 0.5 * (time[at] + time[at + 1])
    group = np.cumsum(np.diff(value, prepend=value[0]) != 0.0)
    counts = np.bincount(group)
    when, value = np.bincount(group, when) / counts, np.bincount(group, value) / counts
    ends: list[float] = []
    for near, far, row in ((0, 1, 0), (-1, -2, -1)):
        slope = (value[near] - value[far]) / (when[near] - when[far]) if len(when) > 1 else 0.0
        half, straight = abs(temperature[row] - value[near]), value[near] + slope * (time[row] - when[near])
        ends.append(float(np.clip(straight, temperature[row] - half, temperature[row] + half)))
    return np.concatenate([time[:1], when, time[-1:]]), np.array([ends[0], *value, ends[1]])


def _means(rest: RestRecord) -> _Means:
    """Means over up to `_STRETCHES` stretches with data for at least half of each."""
    assert rest.temperature_c is not None
    width = max(len(rest.rate) // _STRETCHES, 1)
    count = len(rest.rate) // width

    def of(values: np.ndarray) -> np.ndarray:
        return np.where(rest.valid, values, 0.0)[: count * width].reshape(count, width).sum(axis=1)

    held = of(np.ones(len(rest.rate)))
    kept = held > 0.5 * width
    middle = (np.flatnonzero(kept) + 0.5) * width * rest.sample_interval_s
    output, temperature = (of(values)[kept] / held[kept] for values in (rest.rate, rest.temperature_c))
    return _Means(middle, held[kept] * rest.sample_interval_s, output, temperature, np.gradient(temperature, middle))


def _channel(log: Log, axis: str, unit: str, *, force: bool = False) -> _Channel:
    """The bias over temperature of one channel of a log whose standstills are marked."""
    kind, label = ("accelerometer", f"accelerometer {axis}") if force else ("gyro", f"axis {axis}")
    rest = at_rest(log, axis, unit, bias_degree=DEGREE, lag="none", force=force)
    _, deviation = allan_of(rest)
    walk = deviation.angle_random_walk
    if not walk.value > walk.standard_error:
        raise LogError(
            f"the Allan deviation of {label} of IMU {unit} shows no random walk of its integral, but the estimate "
            "needs one: log at a higher rate, leave the channel out of the column map, or give a spec with --spec"
        )
    if not (force or plausible(deviation)):
        raise LogError(f"{label} of IMU {unit}: {too_noisy(deviation)}")
    table, si_unit, dimension = (
        ("accelerometer", "m/s^2", "acceleration") if force else ("sensor", "rad/s", "angular rate")
    )
    grade = grade_of_noise(table, Quantity.of(walk.value, "m/s/sqrt(s)" if force else "rad/sqrt(s)"))
    typical = {term.key: term.value for term in terms_of(table, grade.name)}
    means = _means(at_rest(log, axis, unit, bias_degree=-1, lag="none", force=force))
    low, high = float(np.floor(means.temperature.min() * 10) / 10), float(np.ceil(means.temperature.max() * 10) / 10)
    centre, scale = round(0.5 * (low + high), 1), round(0.5 * (high - low), 1)
    z = (means.temperature - centre) / scale
    powers = np.vander(z, DEGREE + 1, increasing=True)
    noise = np.diag(walk.value**2 / means.duration)
    for drift in typical["drift"]:
        noise += unit_of.parse(drift["standard_deviation"], dimension) ** 2 * _lasting(means.time, drift)
    if "rate_random_walk" in typical:
        density = unit_of.parse(typical["rate_random_walk"], "rate random walk")
        noise += density**2 * np.minimum.outer(means.time, means.time)
    root = cholesky(noise, lower=True)
    design, data = (solve_triangular(root, of, lower=True) for of in (powers, means.output))
    gain = np.linalg.pinv(design)
    found = gain @ data
    left = data - design @ found
    test = chi_squared_test(float(left @ left), len(z) - DEGREE - 1)
    # An accelerometer's a0 is defined, not estimated.
    own = slice(1 if force else 0, None)
    covariance = (gain @ gain.T)[own, own]
    ratio = test.statistic / max(test.degrees, 1)
    words = [
        f"{label}: {'velocity' if force else 'angle'} random walk "
        + (
            f"{number(walk.value * 60.0)} m/s/sqrt(h)"
            if force
            else f"{number(walk.value * DEG_PER_SQRT_H)} deg/sqrt(h)"
        )
        + f", from the record; slow noise of the class {grade.name} ({grade.like})"
    ]
    if test.probability < _RARE:
        covariance = covariance * ratio
        words.append(
            f"not valid: {label}: its output changes in other ways than with the temperature: was the vehicle moved or "
            "tilted? The covariance includes the misfit"
        )
    elif test.probability > 1.0 - _RARE:
        words.append(
            f"{label}: the residuals are only {ratio**0.5:.3g} times the noise: the slow noise of the class is larger "
            "than that of this sensor, and so is the uncertainty"
        )

    def changed_by(error: np.ndarray) -> np.ndarray:
        """Of the coefficients, by errors of the means `(n,)` or `(n, k)`."""
        change = gain @ solve_triangular(root, error, lower=True)
        if force:
            change[0] = 0.0
        return change

    slopes = np.polynomial.polynomial.polyval(z, np.polynomial.polynomial.polyder(found)) / scale
    of_class = {term.key: term.value for term in terms_of("sensor", grade.name)}
    late = unit_of.parse(of_class["temperature_lag"], "time")
    unseen = [("lag of the temperature", changed_by(late * slopes * means.slope))]
    thermometer = of_class["temperature_error"]
    size = unit_of.parse(thermometer["standard_deviation"], "temperature difference")
    errors = changed_by(np.linalg.cholesky(_lasting(means.time, thermometer)) * (size * slopes)[:, None])
    values, vectors = np.linalg.eigh(errors @ errors.T)
    for k in range(DEGREE + 1):
        unseen.append(("error of the thermometer", vectors[:, k] * np.sqrt(max(values[k], 0.0))))
    if not force:
        follows = unit_of.parse(typical["bias_temperature_gradient"]["prior"], "bias temperature-gradient sensitivity")
        unseen.append(("bias from dT/dt", changed_by(follows * means.slope)))
        unseen.append(("Earth's rate", EARTH_RATE / np.sqrt(3.0) * np.eye(DEGREE + 1)[0]))
    still = Quantity.of(0.0, "rad/s")
    basis = TemperaturePolynomial(degree=DEGREE, centre=Quantity.of(centre, "degC"), scale=Quantity.of(scale, "K"))
    coefficients = found if not force else np.concatenate([[0.0], found[1:]])
    term = CalibratedTerm(
        name="bias",
        unit=si_unit,
        temperature=basis,
        coefficients={f"a{k}": value for k, value in enumerate(coefficients.tolist())},
    )
    calibrated = CalibratedChannel(
        kind=kind,
        axis=axis,
        valid_temperature=(Quantity.of(low, "degC"), Quantity.of(high, "degC")),
        valid_rate=(still, still),
        term=(term,),
    )
    return _Channel(calibrated, covariance, unseen, test, walk.value, typical, words)


def _lasting(time: np.ndarray, of: dict[str, str]) -> np.ndarray:
    """The correlation `(n, n)` at these times of an error with a correlation time."""
    return np.exp(-np.abs(time[:, None] - time) / unit_of.parse(of["correlation_time"], "time"))
