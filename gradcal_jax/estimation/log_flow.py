"""The functions that start from a log or an array: `noise`, `allan`, `estimate`. They read and write no files, and load
most of SciPy."""

from collections.abc import Sequence
from typing import Literal

import numpy as np

from gradcal_jax import identify
from gradcal_jax.estimation.estimate import EstimateReport, estimate_log
from gradcal_jax.estimation.log_rows import Options
from gradcal_jax.identify import instability
from gradcal_jax.identify.allan import TERMS
from gradcal_jax.records.log import Log
from gradcal_jax.records.log_from import log_from
from gradcal_jax.spec.spec import expect_spec
from gradcal_jax.spec.spec_sections import Spec


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
    lag: bool = True,
    rate: float | None = None,
) -> instability.Instability:
    """The smallest drift that bounds a record at rest: the Direct Bound of Berman's equations 6 and 7.

    `log`: a log, or `(n,)` rates in rad/s, `rate` of them a second. One channel, masked where the table moves, less
    its bias over temperature (`bias_degree`, `lag`: see `instability.at_rest`). The drift is measured from
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
    lag: bool = True,
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
    lag: float | Literal["auto"] = "auto",
    clock: Literal["sensor", "host"] | None = None,
    temperature_c: float | None = None,
) -> EstimateReport:
    """The calibration of every sensor in a log, by a spec's model, with covariance, tests and verdicts.

    Noise, table and terms are the spec's; the executed motion is read from the log. With several mountings, one log for
    each. `axis`: the recorded one, where the spec has one gyro on a table of one axis. `units`: default all.
    `lag` s of the maps behind the measured temperature, or "auto": fitted, and used if the data show one (and
    the spec does not state that there is none). `clock`: the clock over whose time rates are integrated (default: the
    spec's, or else the computer's where the log has both). `temperature_c` of a log without a thermometer.

    Returns `calibrations` (SI, one a sensor; `write_calibration` writes them), `verdicts` (in their units) and
    `messages` by sensor, every sensor's fit, and `as_wished`. Gauss-Newton through the finite geometry, with the
    whitened Jacobian of the prediction: the covariance that `predict` predicts, for the executed motion.

    Errors: `LogError` and `ValueError` where the log lacks what the estimate needs.
    """
    options = Options(lag=lag, clock=clock, temperature_c=temperature_c)
    logs = [log] if isinstance(log, Log) else log
    return estimate_log(expect_spec(spec), logs, axis=axis, units=units, options=options)
