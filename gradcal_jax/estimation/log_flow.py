"""The functions that start from a log or an array: `noise`, `allan`, `estimate`, and B(T) with covariance
from a record at rest during warm-up, without a spec (the static gradient method for vehicles). They read and write no
files, and load most of SciPy.

A flight controller heats up after it is switched on; PX4 and ArduPilot fit a cubic to its bias and subtract it. Here
the same cubic is estimated by the one measurement model, with the angle random walk of the record (from the Allan
deviation of the residual of a first fit) and the drift and rate random walk of the gyro's class. A reading is the
sensor's integrated rate at rest: any rate of the vehicle, the Earth's too, becomes part of the bias.
"""

from collections.abc import Sequence
from dataclasses import replace
from typing import Literal

import numpy as np
from scipy.linalg import block_diag

from gradcal_jax import estimation, identify
from gradcal_jax.calibration import Calibration, Covariance, Noise
from gradcal_jax.estimation.estimate import EstimateReport, SensorEstimate, estimate_log
from gradcal_jax.estimation.log_rows import Options
from gradcal_jax.estimation.warm_up_forces import forces_of_warm_up
from gradcal_jax.identify import instability
from gradcal_jax.identify.allan import TERMS
from gradcal_jax.identify.instability import (
    allan_of,
    at_rest,
    number,
    plausible,
    samples_per_row,
    too_noisy,
)
from gradcal_jax.records.log import Log, LogError
from gradcal_jax.records.log_from import log_from
from gradcal_jax.spec.absent import absent_terms, sensor_grade
from gradcal_jax.spec.changes import changed
from gradcal_jax.spec.sensor import GyroTriad
from gradcal_jax.spec.spec import expect_spec, parse_spec
from gradcal_jax.spec.spec_sections import Spec
from gradcal_jax.tables.quantity import Quantity
from gradcal_jax.units import DEG_PER_SQRT_H


def _log_of(log: Log | np.ndarray, rate: float | None) -> Log:
    """The log, or one of rates (rad/s) of which there are `rate` a second."""
    if isinstance(log, Log):
        if rate is not None:
            raise ValueError("rate: a log has its own times; leave the argument rate out")
        return log
    if rate is None or not rate > 0.0:
        raise ValueError("rate: state the samples per second of the array, such as rate=100.0")
    return log_from(np.arange(len(log)) / rate, log)


def noise(
    log: Log | np.ndarray,
    axis: str | int = 0,
    unit: str | int = 0,
    *,
    averaging_time_s: float = 10.0,
    shortest_s: float = 1.0,
    longest_s: float = 1200.0,
    margin: float = 2.5,
    angle_random_walk: float | None = None,
    bias_degree: int | None = None,
    lag: float | Literal["auto", "fit", "none"] = "auto",
    rate: float | None = None,
) -> instability.Instability:
    """The smallest drift that bounds a record at rest: the Direct Bound of Berman's equations 6 and 7.

    `log`: a log, or `(n,)` rates in rad/s, `rate` of them a second. One channel, masked where the table moves, less
    its bias over temperature (`bias_degree`, `lag` in s: see `instability.at_rest`). The drift is measured from
    an average over `averaging_time_s`, for `shortest_s` to `longest_s`, and must stay within `margin` standard
    deviations. `angle_random_walk`: rad/√s; None: from the Allan deviation. Returns `bound` (`drift_std` in rad/s,
    `correlation_time_s`), the Allan deviation with its fit, and `drift_block()`, text for a spec.

    Errors: `LogError` where nothing stands still, or too little is left.
    """
    rest = instability.at_rest(_log_of(log, rate), axis, unit, bias_degree=bias_degree, lag=lag)
    return instability.instability(
        rest,
        averaging_time_s=averaging_time_s,
        shortest_s=shortest_s,
        longest_s=longest_s,
        margin=margin,
        angle_random_walk=angle_random_walk,
    )


def allan(
    log: Log | np.ndarray,
    axis: str | int = 0,
    unit: str | int = 0,
    *,
    terms: Sequence[str] = TERMS,
    confidence: float = 0.683,
    bias_degree: int | None = None,
    lag: float | Literal["auto", "fit", "none"] = "auto",
    rate: float | None = None,
) -> tuple[identify.AllanDeviation, identify.AllanFit]:
    """The overlapping Allan deviation of a record at rest, and the coefficients of a weighted fit (IEEE 952).

    `log`: a log, or `(n,)` rates in rad/s, `rate` of them a second. One channel, prepared as in `noise`
    (`bias_degree`, `lag`). `terms`: which the sensor may have. The deviation
    `(times,)` is in rad/s against averaging times in s; the fit has quantisation (rad), angle random walk (rad/√s),
    bias instability (rad/s) and rate random walk (rad/s/√s), each with its standard error, and bounds of `confidence`.

    Errors: `LogError` where nothing stands still; `ValueError` for unknown terms.

    Ten minutes of 0.1 deg/√h at 100 Hz:

    >>> white = np.radians(0.1 / 60.0) * 10.0 * np.random.default_rng(0).standard_normal(60_000)
    >>> _, fit = allan(white, rate=100.0)
    >>> print(f"{np.degrees(fit.angle_random_walk.value) * 60.0:.2f} deg/sqrt(h)")
    0.10 deg/sqrt(h)
    """
    rest = instability.at_rest(_log_of(log, rate), axis, unit, bias_degree=bias_degree, lag=lag)
    deviation, fit = instability.allan_of(rest, terms=terms, confidence=confidence)
    return deviation, instability.of_sensor(rest, fit)


def estimate(
    spec: Spec,
    log: Log | Sequence[Log],
    *,
    axis: str | None = None,
    units: Sequence[str] = (),
    earth_rate: float | None = None,
    robust: bool = False,
    lag: float | Literal["auto", "fit"] = "auto",
    clock: Literal["sensor", "host"] | None = None,
    read_every: float | None = None,
    table_axis: str | None = None,
    neighbours_k: float | None = None,
    temperature_c: float | None = None,
) -> EstimateReport:
    """The calibration of every sensor in a log, by a spec's model, with covariance, tests and verdicts.

    Noise, table and terms are the spec's; the executed motion is read from the log. With several mountings, one log for
    each. `axis`: the recorded one, where the spec has one gyro on a table of one axis. `units`: default all.
    `earth_rate` rad/s along that axis is subtracted (default: the spec's). `robust`: Huber weights for outliers. `lag`
    s of the maps behind the measured temperature, "fit", or "auto": fitted, and used if the data show one (and the spec
    does not state that there is none). `clock`: the clock over whose time rates are integrated (default: the spec's, or
    else the computer's where the log has both). `read_every` s: spacing of readings at rest (default: the spec's).
    `table_axis`: the log's name of the table's only axis. `neighbours_k`: also group moves of one rate within
    this temperature difference, without a structure. `temperature_c` of a log without a thermometer.

    Returns `calibrations` (SI, one a sensor; `write_calibration` writes them), `verdicts` (in their units) and
    `messages` by sensor, every sensor's fit, and `as_wished`. Gauss-Newton through the finite geometry, with the
    whitened Jacobian of the prediction: the covariance that `predict` predicts, for the executed motion.

    Errors: `LogError` and `ValueError` where the log lacks what the estimate needs.
    """
    options = Options(
        earth_rate=earth_rate,
        robust=robust,
        lag=lag,
        clock=clock,
        read_every=read_every,
        table_axis=table_axis,
        neighbours_k=neighbours_k,
        temperature_c=temperature_c,
    )
    logs = [log] if isinstance(log, Log) else log
    return estimate_log(expect_spec(spec), logs, axis=axis, units=units, options=options)


DEGREE = 3
_ROWS = ("channel", "unseen", "fit", "contradicted", "unobservable", "result")
# K; over a narrower span the terms of a cubic cannot be separated.
_LEAST_SPAN = 10.0
# A thermometer of larger steps than this, K, is interpolated.
_COARSE_K = 0.2
_EARTH = 15.04
_SLOW_NOISE = ("sensor.gyro.drift", "sensor.gyro.rate_random_walk")


def estimate_warm_up(
    logs: Sequence[Log],
    *,
    axes: Sequence[str] = (),
    units: Sequence[str] = (),
    options: Options | None = None,
    sources: dict[str, str] | None = None,
) -> EstimateReport:
    """The bias over temperature, a cubic, of every unit in records at rest; each log has units of one clock. Of
    accelerometers, its change over temperature (`warm_up_forces`), unless `axes` names gyros.

    The covariance includes the white noise of the record and the slow noise of the class. `options`, `sources` as of
    `estimate_log`. **Raises:** `LogError` without a temperature that spans 10 K, without a rest, and where the
    record shows no angle random walk.
    """
    options = options or Options()
    parts = [
        _unit(log, unit, axes, options, sources) for log in logs for unit in log.units if not units or unit in units
    ]
    if missing := [unit for unit in units if not any(unit in log.units for log in logs)]:
        known = ", ".join(unit for log in logs for unit in log.units)
        raise LogError(f"there is no IMU '{missing[0]}' in this log; it has {known}")
    parts, sensors = zip(*parts, strict=True)
    return EstimateReport(tuple(one for own in sensors for one in own), parts)


def _unit(
    log: Log, unit: str, axes: Sequence[str], options: Options, sources: dict[str, str] | None
) -> tuple[Calibration, list[SensorEstimate]]:
    """The calibration of all axes of a unit, and the estimate of each."""
    log, sensors, noises = _marked(log, unit), list[SensorEstimate](), list[GyroTriad]()
    before = [
        f"the vehicle's rate is assumed to be zero, so the bias includes up to {_EARTH:.0f} deg/h of the Earth's rate"
    ] * (not options.earth_rate)
    for axis in axes or log.axes:
        spec, words = warm_up_spec(log, axis, unit)
        (one,) = estimate_log(spec, [log], axis=axis, units=(unit,), options=options, sources=sources).sensors
        own = (f"axis {axis}: {m}" for m in one.messages if "no table angle" not in m)
        sensors.append(one._replace(messages=(*before, words, *own)))
        before = []
        gyro = one.built.spec.sensor.gyro
        assert gyro is not None
        noises.append(gyro)
    calibrations = [one.calibration for one in sensors]
    walk = max(s.angle_random_walk for s in noises)
    folded, _ = samples_per_row(log, log.sample_interval_s)
    noise = None
    if np.isfinite(folded):
        noise = Noise(
            angle_random_walk=Quantity.of(float(walk) / float(np.sqrt(folded)), "rad/sqrt(s)") if folded > 1 else walk,
            rate_random_walk=max((k for s in noises if (k := s.rate_random_walk) is not None), default=None),
            sample_rate=Quantity.of(1.0 / log.sample_interval_s, "Hz"),
        )
    else:
        words = (
            "the calibration states no noise, because it is not known whether the log's rows are single samples or "
            'means: state the sensor\'s own rate, as --sensor-rate "400 Hz", or --sensor-rate "means"'
        )
        sensors[0] = sensors[0]._replace(messages=(*sensors[0].messages, words))
    named = ", ".join(channel.axis for c in calibrations for channel in c.channel)
    first = calibrations[0]
    blocks = [c.covariance for c in calibrations if c.covariance is not None]
    rows = {key: tuple(row for c in calibrations for row in getattr(c, key)) for key in _ROWS}
    if log.force_axes and not axes:
        forces = forces_of_warm_up(log, unit)
        blocks.append(forces.covariance)
        rows["channel"] += forces.channels
        rows["fit"] += forces.tests
        rows["contradicted"] += forces.contradicted
        sensors[-1] = sensors[-1]._replace(messages=(*sensors[-1].messages, *forces.messages))
    whole = first.model_copy(
        update={
            **rows,
            "covariance": joined(blocks),
            "noise": noise,
            "frame": f"the axes {named} of the log, not orthogonalised",
            "provenance": {**first.provenance, "rows": ", ".join(c.provenance["rows"] for c in calibrations)},
        }
    )
    if noise is None:
        whole.model_fields_set.discard("noise")  # absent from the file, not written as nothing
    return whole, sensors


def joined(blocks: Sequence[Covariance]) -> Covariance:
    """One covariance of channels that were estimated each by itself."""
    matrix = np.asarray(block_diag(*(np.array(block.matrix).reshape(2 * (len(block.names),)) for block in blocks)))
    return Covariance(
        names=tuple(name for block in blocks for name in block.names), matrix=tuple(map(tuple, matrix.tolist()))
    )


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
        standing = estimation.find_standstills(log.rate_rad_per_s[index], log.sample_interval_s, valid=usable)
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


def warm_up_spec(log: Log, axis: str, unit: str) -> tuple[Spec, str]:
    """A spec with the white noise of one channel of a record, and a sentence on it. `log`: with standstills marked."""
    rest = at_rest(log, axis, unit, bias_degree=DEGREE, lag="none")
    _, fit = allan_of(rest)
    walk = fit.angle_random_walk
    if not walk.value > walk.standard_error:
        raise LogError(
            f"the Allan deviation of axis {axis} of IMU {unit} shows no angle random walk, but the estimate "
            "needs one: log at a higher rate, or give a spec with --spec"
        )
    if not plausible(fit):
        raise LogError(f"axis {axis} of IMU {unit}: {too_noisy(fit)}")
    assert rest.temperature_c is not None
    known = rest.temperature_c[rest.valid]
    low, high = float(np.floor(known.min() * 10) / 10), float(np.ceil(known.max() * 10) / 10)
    centre, scale = round(0.5 * (low + high), 1), round(0.5 * (high - low), 1)
    # The same thermometer serves in use, and there is no table.
    text = f"""
format = "gradcal-spec/1"
title  = "warm-up at rest"
[sensor]
temperature_offset = "0 K"
[sensor.gyro]
axes = ["x"]
angle_random_walk = "{number(walk.value * DEG_PER_SQRT_H)} deg/sqrt(h)"
[sensor.gyro.bias]
temperature = {{ degree = {DEGREE}, centre = "{centre} degC", scale = "{scale} K" }}
[rig.site]
latitude = "unknown"
[rig.table]
standing = "read"
mounting = {{ x = "+z", y = "+x", z = "+y" }}
[[rig.table.axis]]
name = "x"
direction = [0.0, 0.0, 1.0]
max_rate         = "1 deg/s"
max_acceleration = "1 deg/s^2"
[rig.table.axis.angle]
reading_noise = "0 deg"
read_every = "1 s"
[rig.chamber]
range       = ["{low - 1:.1f} degC", "{high + 1:.1f} degC"]
max_heating = "10 K/min"
max_cooling = "10 K/min"
[[requirement]]
name        = "bias, on average"
quantity    = "gyro_bias"
axis = "x"
temperature = ["{low:.1f} degC", "{high:.1f} degC"]
[[requirement]]
name        = "bias, at worst"
quantity    = "gyro_bias"
axis = "x"
temperature = ["{low:.1f} degC", "{high:.1f} degC"]
statistic   = "max"
[plan]
method      = "gradient"
temperature = ["{low:.1f} degC", "{high:.1f} degC"]
gradient    = "1 K/min"
"""
    spec = parse_spec(text)
    slow = {t.key: t.value for t in absent_terms(spec) if t.key in _SLOW_NOISE}
    grade = sensor_grade(spec.sensor)
    words = (
        f"axis {axis}: angle random walk {number(walk.value * DEG_PER_SQRT_H)} deg/sqrt(h), from the record; drift and "
        f"rate random walk of the class {grade.name} ({grade.like})"
    )
    return changed(spec, slow), words
