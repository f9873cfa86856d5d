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
from gradcal_jax.calibration.file import (
    FORMAT,
    ORDER,
    CalibratedChannel,
    Calibration,
    Covariance,
    UnseenError,
    build_term,
)
from gradcal_jax.estimation.calibration_rows import fit_rows, provenance_of, rows_of_estimate
from gradcal_jax.estimation.consistency import Test, chi_squared_test
from gradcal_jax.estimation.standstill import find_standstills
from gradcal_jax.formulas import EARTH_RATE
from gradcal_jax.identify.instability import (
    RestRecord,
    allan_of,
    at_rest,
    plausible,
    too_noisy,
)
from gradcal_jax.records.log import Log, LogError
from gradcal_jax.spec.bases import TemperaturePolynomial
from gradcal_jax.spec.typical import grade_of_noise, terms_of
from gradcal_jax.tables.quantity import Quantity

DEGREE = 3
_STRETCHES = 300
# K; over a narrower span the terms of a cubic cannot be separated.
_LEAST_SPAN = 10.0
# A thermometer of larger steps than this, K, errs by half a step times the slope of the bias.
_COARSE_K = 0.2
# Probability below which the data contradict the model (the covariance then grows with the misfit).
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
    change of all coefficients; `grade`: the class of its white noise."""

    calibrated: CalibratedChannel
    covariance: np.ndarray
    unseen: list[tuple[str, np.ndarray]]
    test: Test
    grade: str


def estimate_warm_up(logs: Sequence[Log], *, sources: dict[str, str] | None = None) -> WarmUpReport:
    """The bias over temperature, a cubic, of every unit in records at rest; each log has units of one clock. Of
    accelerometers, its change over temperature. `sources`: names of files.

    **Raises:** `LogError` without a temperature that spans 10 K, without a rest, and where the record shows no white
    noise.
    """
    calibrations, messages = list[Calibration](), dict[str, tuple[str, ...]]()
    for log in logs:
        for unit in log.units:
            one, messages[unit] = _unit(_marked(log, unit), unit, sources or {})
            calibrations.append(one)
    return WarmUpReport(tuple(calibrations), messages)


def warm_up_rows(report: WarmUpReport) -> dict[str, Any]:
    """All numbers for `--json`."""
    rows = [rows_of_estimate(one, report.messages[one.serial_number]) for one in report.calibrations]
    simulated = any(one.simulated for one in report.calibrations)
    return {"simulated": simulated, "as_wished": report.as_wished, "units": rows}


def _unit(log: Log, unit: str, sources: dict[str, str]) -> tuple[Calibration, tuple[str, ...]]:
    channels = [_channel(log, axis, unit) for axis in log.axes]
    channels += [_channel(log, axis, unit, force=True) for axis in log.force_axes]
    messages = [
        f"the vehicle's rate is assumed to be zero, so the bias of a gyro includes a part of the Earth's rate, up to "
        f"{EARTH_RATE * unit_of.DEG_PER_H:.0f} deg/h; and it is that of this attitude: in another, the sensitivity of "
        "gyros to g changes it",
        "a warm-up goes one way: it shows neither a hysteresis of the biases, nor how the dies lag behind the "
        "thermometer (the uncertainty includes a minute, typical of such sensors), and a drift looks like a dependence "
        "on temperature. Cool the vehicle down again in the same record to see them",
    ]
    classes = ", ".join(f"{of.calibrated.label} {of.grade}" for of in channels)
    messages.append(f"the slow noise is that of the class of the sensor's white noise: {classes}")
    if log.force_axes:
        messages.append(
            "accelerometers at rest: a bias and a tilt cannot be separated, so the biases are changes from the middle "
            "of the temperatures, where they are zero. Calibrate the accelerometers in six positions at one "
            "temperature afterwards"
        )
    names, unseen, tests = list[str](), list[UnseenError](), dict[str, Test]()
    for of in channels:
        name = of.calibrated.name
        own = [f"{name}.a{k}" for k in range(DEGREE + 1)]
        names += own[-len(of.covariance) :]
        for error, change in of.unseen:
            unseen.append(UnseenError(name=error, coefficients=dict(zip(own, change.tolist(), strict=True))))
        tests[f"{name}: chi-squared"] = of.test
    contradicted = tuple(name for name, test in tests.items() if test.probability < _RARE)
    messages += [
        f"not valid: {name}: the output changes in other ways than with the temperature: was the vehicle moved or "
        "tilted? The covariance includes the misfit"
        for name in contradicted
    ]
    matrix = np.asarray(block_diag(*(of.covariance for of in channels)))
    calibration = Calibration(
        format=FORMAT,
        title="warm-up at rest",
        serial_number=unit,
        simulated=log.simulated,
        frame=f"the axes {', '.join(log.axes)} of the log, not orthogonalised",
        order=ORDER,
        channel=tuple(of.calibrated for of in channels),
        covariance=Covariance(names=tuple(names), matrix=tuple(map(tuple, matrix.tolist()))),
        unseen=tuple(unseen),
        fit=fit_rows(tests.items()),
        contradicted=contradicted,
        provenance=provenance_of([log], unit, sources, estimator="generalised least squares of means over stretches"),
    )
    return calibration, tuple(messages)


def _marked(log: Log, unit: str) -> Log:
    """The log with standstills marked. Raises `LogError` where its temperatures do not do."""
    index = log.unit_index(unit)
    if log.table_axes:
        raise LogError("the log has a table's motion: its calibration needs a spec (--spec) that describes it")
    if log.temperature_c is None or not np.isfinite(temperature := log.temperature_c[index]).any():
        raise LogError(f"the log has no temperature of IMU {unit}, but a bias over temperature needs it")
    usable = log.usable(unit)
    if log.standstill is None:
        standing = find_standstills(log.rate_rad_per_s[index], log.sample_interval_s, valid=usable)
        log = replace(log, standstill=standing)
    known = np.isfinite(temperature)
    there = temperature[known & usable & (log.standstill >= 0)]  # pyright: ignore[reportOptionalOperand]
    span = float(np.ptp(there)) if len(there) else 0.0
    if span < _LEAST_SPAN:
        raise LogError(
            f"the temperature of IMU {unit} changes by {span:.2g} K at rest: a bias over temperature needs "
            f"{_LEAST_SPAN:g} K or more, so cool the vehicle before you switch it on, and let it warm up longer"
        )
    step = float(np.diff(np.unique(temperature[known])).min())
    if step > _COARSE_K:
        raise LogError(
            f"the temperature of IMU {unit} changes in steps of {step:.2g} K: log it with more digits, since half a "
            "step changes the bias by more than its uncertainty"
        )
    return log


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
    kind, table, si, walk_unit, dimension = (
        ("accelerometer", "accelerometer", "m/s^2", "m/s/sqrt(s)", "acceleration")
        if force
        else ("gyro", "sensor", "rad/s", "rad/sqrt(s)", "angular rate")
    )
    rest = at_rest(log, axis, unit, bias_degree=DEGREE, lag=False, force=force)
    _, deviation = allan_of(rest)
    walk = deviation.angle_random_walk
    if not walk.value > walk.standard_error:
        raise LogError(
            f"the Allan deviation of {kind} {axis} of IMU {unit} shows no random walk of its integral, but the "
            "estimate needs one: log at a higher rate, leave the channel out of the column map, or give a spec with "
            "--spec"
        )
    if not (force or plausible(deviation)):
        raise LogError(f"gyro {axis} of IMU {unit}: {too_noisy(deviation)}")
    grade = grade_of_noise(table, Quantity.of(walk.value, walk_unit)).name
    typical, of_gyro = ({term.key: term.value for term in terms_of(of, grade)} for of in (table, "sensor"))
    means = _means(at_rest(log, axis, unit, bias_degree=-1, lag=False, force=force))
    low, high = float(np.floor(means.temperature.min() * 10) / 10), float(np.ceil(means.temperature.max() * 10) / 10)
    basis = TemperaturePolynomial(
        degree=DEGREE,
        centre=Quantity.of(round(0.5 * (low + high), 1), "degC"),
        scale=Quantity.of(round(0.5 * (high - low), 1), "K"),
    )
    noise = np.diag(walk.value**2 / means.duration)
    for drift in typical["drift"]:
        noise += unit_of.parse(drift["standard_deviation"], dimension) ** 2 * _lasting(means.time, drift)
    if (rate_walk := typical.get("rate_random_walk")) is not None:
        noise += unit_of.parse(rate_walk, "rate random walk") ** 2 * np.minimum.outer(means.time, means.time)
    root = cholesky(noise, lower=True)
    powers = basis.values(means.temperature)
    design, data = (solve_triangular(root, of, lower=True) for of in (powers, means.output))
    gain = np.linalg.pinv(design)
    found = gain @ data
    left = data - design @ found
    test = chi_squared_test(float(left @ left), len(left) - DEGREE - 1)
    # An accelerometer's a0 is defined, not estimated.
    own = slice(1 if force else 0, None)
    covariance = (gain @ gain.T)[own, own]
    if test.probability < _RARE:
        covariance = covariance * test.statistic / test.degrees

    def changed_by(error: np.ndarray) -> np.ndarray:
        """Of the coefficients, by errors of the means `(n,)` or `(n, k)`."""
        change = gain @ solve_triangular(root, error, lower=True)
        if force:
            change[0] = 0.0
        return change

    z = (means.temperature - basis.centre) / basis.scale
    slopes = np.polynomial.polynomial.polyval(z, np.polynomial.polynomial.polyder(found)) / basis.scale
    late = unit_of.parse(of_gyro["temperature_lag"], "time")
    unseen = [("lag of the temperature", changed_by(late * slopes * means.slope))]
    thermometer = of_gyro["temperature_error"]
    size = unit_of.parse(thermometer["standard_deviation"], "temperature difference")
    errors = changed_by(np.linalg.cholesky(_lasting(means.time, thermometer)) * (size * slopes)[:, None])
    values, vectors = np.linalg.eigh(errors @ errors.T)
    unseen += [("error of the thermometer", of) for of in (vectors * np.sqrt(np.maximum(values, 0.0))).T]
    if force:
        found[0] = 0.0
    else:
        follows = unit_of.parse(typical["bias_temperature_gradient"]["prior"], "bias temperature-gradient sensitivity")
        unseen.append(("bias from dT/dt", changed_by(follows * means.slope)))
        unseen.append(("Earth's rate", EARTH_RATE / np.sqrt(3.0) * np.eye(DEGREE + 1)[0]))
    still = Quantity.of(0.0, "rad/s")
    coefficients = {f"a{k}": value for k, value in enumerate(found.tolist())}
    calibrated = CalibratedChannel(
        kind=kind,
        axis=axis,
        valid_temperature=(Quantity.of(low, "degC"), Quantity.of(high, "degC")),
        valid_rate=(still, still),
        term=(build_term("bias", si, (), coefficients, temperature=basis),),
    )
    return _Channel(calibrated, covariance, unseen, test, grade)


def _lasting(time: np.ndarray, of: dict[str, str]) -> np.ndarray:
    """The correlation `(n, n)` at these times of an error with a correlation time."""
    return np.exp(-np.abs(time[:, None] - time) / unit_of.parse(of["correlation_time"], "time"))
