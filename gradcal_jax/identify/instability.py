"""The instability of the channels of a log at rest: Direct Bound and Allan deviation; and the noise of all channels as
a block for an INS.

These hold continuous-time densities: the white noise N (rad/s/√Hz, m/s²/√Hz) and the random walk K of the bias
(rad/s²/√Hz, m/s³/√Hz), of each triad the largest axis. Names of the keys: kalibr's wiki, "IMU noise model".
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from functools import partial
from typing import Any

import numpy as np

from gradcal_jax import formulas, identify, units
from gradcal_jax.identify.allan import TERMS
from gradcal_jax.information.verdicts import finite
from gradcal_jax.records.log import SENSOR_RATE, EvenSeries, Log, LogError, Reason
from gradcal_jax.records.signal_checks import refuse_unlike_noise, without_faults
from gradcal_jax.tables.display import summary
from gradcal_jax.units import ARCSEC, DEG_PER_H, DEG_PER_SQRT_H

# A fitted lag is used where it reduces the rms residual to less than this share.
_LAG_PAYS = 0.9
_LONGEST_LAG_S = 1800.0
# Over a narrower span of temperature (K), B(T) cannot be estimated and is not removed.
_TELLING_SPAN = 5.0
# Rows slower than this are said to be taken as means.
_SLOW_HZ = 20.0
# rad/√s. The noisiest gyro known to us, the ADXRS150 of 2002, has 0.05 deg/s/√Hz, which is 3 deg/√h; below the
# other figure are only large fibre-optic and ring laser gyros, which few people have.
_NOISIEST = 4.0 / DEG_PER_SQRT_H
_QUIETEST = 0.006 / DEG_PER_SQRT_H


@dataclass(frozen=True)
class RestRecord:
    """One channel of a log at rest on an even grid, less B(T) if requested.

    `rate` `(samples,)` rad/s, `valid` `(samples,)`: usable samples, `temperature_c` `(samples,)` °C.
    """

    axis: str
    unit: str
    rate: np.ndarray
    valid: np.ndarray
    sample_interval_s: float
    time_s: np.ndarray
    """`(samples,)` by the record's clock; NaN in a gap."""
    temperature_c: np.ndarray | None
    thermal: identify.ThermalBias | None
    messages: tuple[str, ...]
    lost: str = ""
    """If the record has gaps: the numbers of lost rows, by reason, and what helps."""
    samples_per_row: float = 1.0
    """If rows are single samples: the number of samples of the sensor for each row; NaN: unknown, but more than one."""

    def walk_of_sensor(self, walk: float) -> float:
        """The sensor's angle random walk, where that of the rows is `walk` (rad/√s): single samples hold the noise of
        all the others, folded. Raises `LogError` where their number is not known."""
        if not np.isfinite(self.samples_per_row):
            raise LogError(
                f"axis {self.axis} of {self.unit}: its rows, at {1.0 / self.sample_interval_s:.3g} Hz, are of a raw "
                "channel that is sampled much faster: are the rows means of these samples, or every n-th "
                "sample? The angle random walk of the rows equals that of the sensor only if the rows are means. State "
                '--sensor-rate "means", or the sensor\'s own rate, such as --sensor-rate "400 Hz"; it is better to '
                "log at the full rate"
            )
        return walk / float(np.sqrt(self.samples_per_row))


def allan_of(
    rest: RestRecord, *, terms: Sequence[str] = TERMS, confidence: float = 0.683
) -> tuple[identify.AllanDeviation, identify.AllanFit]:
    """The Allan deviation of a record's rows and its fit. **Raises:** `LogError` that says which rows were lost."""
    try:
        deviation = identify.overlapping_allan(rest.rate, rest.sample_interval_s, valid=rest.valid)
        return deviation, identify.fit_allan(deviation, terms=terms, confidence=confidence)
    except np.linalg.LinAlgError:
        raise LogError(
            f"axis {rest.axis} of {rest.unit}: its rows repeat a pattern and are not noise: --plot shows the pattern"
        ) from None
    except ValueError as error:
        if confidence <= 0.0 or confidence >= 1.0 or not set(terms) <= set(TERMS):
            raise
        help_ = rest.lost or "use a longer record, or fewer terms in the fit"
        raise LogError(f"axis {rest.axis} of {rest.unit}: {error}; {help_}") from None


def of_sensor(rest: RestRecord, fit: identify.AllanFit) -> identify.AllanFit:
    """The fit with the sensor's own angle random walk, where rows are single samples."""
    if rest.samples_per_row == 1.0:
        return fit
    walk = fit.angle_random_walk
    scaled = replace(
        walk, value=rest.walk_of_sensor(walk.value), standard_error=rest.walk_of_sensor(walk.standard_error)
    )
    return replace(fit, angle_random_walk=scaled)


@dataclass(frozen=True)
class Instability:
    """The result of `instability` for a channel."""

    rest: RestRecord
    allan: identify.AllanDeviation
    allan_fit: identify.AllanFit
    bound: identify.DirectBound

    __repr__ = summary

    @property
    def deciding_span_s(self) -> tuple[float, float]:
        """The time span of the largest relative drift, by the record's clock: from the average over Δ to its end."""
        bound, interval = self.bound, self.rest.sample_interval_s
        first = bound.deciding_start_index - round(bound.averaging_time_s / interval)
        last = bound.deciding_start_index + round(bound.deciding_time_s / interval) - 1
        return float(self.rest.time_s[first]), float(self.rest.time_s[last])

    def drift_block(self) -> str:
        """The `[[sensor.gyro.drift]]` of a spec; only a comment where no drift shows."""
        walk = self.rest.walk_of_sensor(self.bound.angle_random_walk) * DEG_PER_SQRT_H
        walk = f'angle_random_walk = "{number(walk)} deg/sqrt(h)"'
        if not self.bound.drift_shows:
            hidden = number(self.bound.hidden_drift_std * DEG_PER_H)
            return f"# {walk}\n# no drift is visible above the angle random walk; up to {hidden} deg/h could be present"
        return "\n".join(
            [
                f"# {walk}",
                "[[sensor.gyro.drift]]",
                f'standard_deviation = "{number(self.bound.drift_std * DEG_PER_H)} deg/h"',
                f'correlation_time   = "{number(self.bound.correlation_time_s)} s"',
            ]
        )


def number(value: float) -> str:
    """Four digits, without an exponent: a number for a spec."""
    return np.format_float_positional(float(f"{value:.4g}"), trim="-")


def at_rest(
    log: Log,
    axis: str | int = 0,
    unit: str | int = 0,
    *,
    bias_degree: int | None = None,
    lag: bool = True,
    without: Sequence[tuple[float, float]] = (),
    force: bool = False,
) -> RestRecord:
    """One channel, masked where the table moves, with its bias over temperature subtracted.

    `force`: an accelerometer's, in m/s², in the place of a gyro's.

    `without`: spans of the record's time (s) to leave out.
    `bias_degree`: of the subtracted polynomial B(T); None: 3 where the record spans 5 K or more, otherwise 0; −1:
    nothing is subtracted. `lag`: whether a lag of the bias behind the temperature is fitted; it is used where it
    reduces the rms by a tenth. **Raises:** `LogError` where nothing of the record is at rest.
    """
    kind, other = ("accelerometer", Reason.MISSING_RATE) if force else ("gyro", Reason.MISSING_FORCE)
    label = axis if isinstance(axis, str) else (log.force_axes if force else log.axes)[axis]
    channel, name = f"{kind} {label}", log.units[log.unit_index(unit)]
    if log.status is not None:
        log = replace(log, status=log.status & ~np.uint16(other))  # which is no matter of this channel
    raw, read = log, log.counts(unit)
    own = log.channel(channel, unit)
    still = slice(None) if log.standstill is None else log.standstill >= 0
    said = refuse_unlike_noise(f"{channel} of {name}", own[still])
    log, faults = without_faults(log, {channel}, at_rest=True)
    even = log.even(channel, unit)
    valid = even.valid.copy()
    messages = [*said, *faults[name].sentences]
    if log.standstill is not None:
        valid &= (even.row >= 0) & (log.standstill[even.row] >= 0)
        moving = int(np.count_nonzero(even.valid & ~valid))
        if moving:
            messages.append(f"{moving} rows during moves of the table are left out")
    time = np.where(even.row >= 0, log.time_s[even.row], np.nan)
    for first, last in without:
        out = valid & (time >= first) & (time <= last)
        valid &= ~out
        messages.append(f"{np.count_nonzero(out)} rows from {first:g} s to {last:g} s are left out as requested")
    if not valid.any():
        lost = ", ".join(f"{count} {reason}" for reason, count in log.counts(unit).items() if reason != "used")
        raise LogError(
            f"of {log.rows_read} rows none is usable: {lost}"
            if not even.valid.any()
            else "no usable row of the record is marked as at rest: an instability is visible only at rest"
        )
    rate, named = even.rate_rad_per_s.copy(), (label, name)
    temperature = even.temperature_c
    known = temperature is not None and bool(np.isfinite(temperature[valid]).all())
    span = float(np.ptp(temperature[valid])) if known and temperature is not None else 0.0
    if bias_degree is None:
        bias_degree = 3 if span >= _TELLING_SPAN else 0
    if bias_degree > 0 and not known:
        raise LogError(
            "some usable rows of the log have no temperature, so a bias over temperature cannot be subtracted"
        )
    thermal = None
    if bias_degree == 0 or (bias_degree > 0 and temperature is None):
        rate = rate - rate[valid].mean()
    elif bias_degree > 0:
        assert temperature is not None
        thermal, said = _thermal(even, valid, temperature, bias_degree, lag)
        messages += said
        rows, where = np.arange(len(temperature)), np.isfinite(temperature)
        rate = rate - thermal.bias(np.interp(rows, rows[where], temperature[where]), even.sample_interval_s)
    rate[~valid] = 0.0
    per_row, words = samples_per_row(log, even.sample_interval_s)
    return RestRecord(
        *named, rate, valid, even.sample_interval_s, time, temperature, thermal, (*messages, *words),
        _lost(raw, read, valid, even.sample_interval_s), per_row,
    )  # fmt: skip


def samples_per_row(log: Log, interval_s: float) -> tuple[float, list[str]]:
    """Samples of the sensor for each row of a log (NaN: not stated), 1 for means, and a sentence on it."""
    stated = log.provenance.get(SENSOR_RATE)
    if stated == "unknown":
        return np.nan, []
    if stated in (None, "means"):
        slow = stated is None and interval_s * _SLOW_HZ > 1.0
        return 1.0, [
            f"rows at {1.0 / interval_s:.3g} Hz are taken as means of the sensor's samples; if each row is a "
            "single sample, the angle random walk is too large: state the sensor's rate as sensor_rate in the "
            "column map, or with --sensor-rate"
        ] * slow
    samples = max(units.parse(stated, "frequency") * interval_s, 1.0)
    return samples, [
        f"rows are every {samples:.4g}th sample of {stated}: the angle random walk of the rows is divided by "
        f"{np.sqrt(samples):.3g}; this assumes white noise up to the sensor's rate"
    ]


def _lost(log: Log, read: Mapping[str, int], valid: np.ndarray, interval_s: float) -> str:
    """How many rows were lost to what, where that leaves a record in many pieces."""
    runs = formulas.runs(valid)
    if len(runs) < 3:
        return ""
    longest = int(np.max(runs[:, 1] - runs[:, 0]))
    lost = [f"{count} {reason}" for reason, count in read.items() if reason != "used"]
    lost += [finding.message for finding in log.findings if finding.kind == "gap"]
    return (
        f"of {log.rows_read} rows {np.count_nonzero(valid)} are usable, in {len(runs)} stretches of at most "
        f"{longest} rows ({longest * interval_s:.3g} s): {'; '.join(lost) or 'others were left out'}. A longer "
        "record with the same losses does not help. Record without losses, or use sample_rate instead of uneven "
        "time stamps, or interpolate = true in the column map if channels have separate rows"
    )


def _thermal(
    even: EvenSeries, valid: np.ndarray, temperature: np.ndarray, degree: int, lag: bool
) -> tuple[identify.ThermalBias, list[str]]:
    """B(T), with a `lag` where that is better, and sentences on it."""
    fit = partial(
        identify.fit_thermal_bias,
        even.rate_rad_per_s,
        temperature,
        even.sample_interval_s,
        degree=degree,
        longest_lag_s=_LONGEST_LAG_S,
        valid=valid,
    )
    at_once = fit(lag_time_s=0.0)
    late = fit() if lag else at_once
    if late.residual_rms >= _LAG_PAYS * at_once.residual_rms:
        return at_once, []
    said = [
        f"the bias lags behind the temperature by {late.lag_time_s:.0f} s: with this lag, the residual is "
        f"{late.residual_rms / at_once.residual_rms:.0%} of the residual of B(T) without a lag"
    ]
    if late.lag_time_s > 0.99 * _LONGEST_LAG_S:
        said.append(
            f"the fitted lag is the longest allowed, {_LONGEST_LAG_S / 60:.0f} min: the record does not determine "
            "the lag, and the effect may be drift"
        )
    return late, said


def instability(
    rest: RestRecord,
    *,
    averaging_time_s: float = 10.0,
    shortest_s: float = 1.0,
    longest_s: float = 1200.0,
    margin: float = 2.5,
    angle_random_walk: float | None = None,
    count: int = 200,
) -> Instability:
    """Allan deviation with its fit, and the paper's Direct Bound with that fit's random walk or `angle_random_walk`
    (rad/√s).

    Integration times are limited by the longest unbroken stretch. **Raises:** `LogError` where it is too short.
    """
    valid = rest.valid
    interval = rest.sample_interval_s
    room = identify.longest_integration_time(valid, interval, averaging_time_s)
    longest = min(longest_s, room)
    if longest < max(shortest_s, interval):
        whole = room + averaging_time_s
        raise LogError(
            f"the longest unbroken stretch is {whole:.4g} s: too short to average for {averaging_time_s:g} s and then "
            f"integrate for {shortest_s:g} s; use a shorter average{', or a longer record' * (not rest.lost)}"
            + (rest.lost and f"; {rest.lost}")
        )
    allan, fit = allan_of(rest)
    walk = fit.angle_random_walk.value if angle_random_walk is None else angle_random_walk
    if angle_random_walk is None and walk <= fit.angle_random_walk.standard_error:
        raise LogError(
            f"the Allan deviation of axis {rest.axis} shows no angle random walk, but the bound needs one: "
            "record more often, or for longer"
        )
    times = identify.integration_times(max(shortest_s, interval), longest, interval, count=count)
    times = times[times <= room * (1 + 1e-12)]
    observed = identify.largest_drift(rest.rate, interval, times, averaging_time_s, valid=valid)
    bound = identify.fit_direct_bound(
        observed, walk, margin=margin, rate_in_words=lambda rate: f"{rate * DEG_PER_H:.3g} deg/h"
    )
    return Instability(rest, allan, fit, bound)


def instability_row(result: Instability) -> dict[str, Any]:
    """Plain numbers for `--json`: units in the names."""
    bound, thermal = result.bound, result.rest.thermal
    return {
        "axis": result.rest.axis,
        "unit": result.rest.unit,
        "drift_shows": bound.drift_shows,
        "drift_std_deg_per_h": bound.drift_std * DEG_PER_H,
        "correlation_time_s": bound.correlation_time_s,
        "angle_random_walk_deg_per_sqrt_h": result.rest.walk_of_sensor(bound.angle_random_walk) * DEG_PER_SQRT_H,
        "margin": bound.margin,
        "averaging_time_s": bound.averaging_time_s,
        "deciding_time_s": bound.deciding_time_s,
        "deciding_span_s": result.deciding_span_s,
        "hidden_drift_std_deg_per_h": finite(bound.hidden_drift_std * DEG_PER_H),
        "advised_averaging_time_s": bound.advised_averaging_time_s,
        "boundary": np.stack([bound.boundary_correlation_time_s, bound.boundary_drift_std * DEG_PER_H], 1).tolist(),
        "curve": {
            "integration_time_s": bound.integration_time_s.tolist(),
            "largest_drift_deg_per_h": (bound.largest_drift * DEG_PER_H).tolist(),
            "limit_deg_per_h": (bound.limit * DEG_PER_H).tolist(),
        },
        "thermal": None
        if thermal is None
        else {
            "degree": len(thermal.coefficients) - 1,
            "lag_s": thermal.lag_time_s,
            "residual_rms_deg_per_h": thermal.residual_rms * DEG_PER_H,
        },
        "messages": [*result.rest.messages, *allan_notes(of_sensor(result.rest, result.allan_fit)), *bound.messages],
    }


def allan_row(rest: RestRecord, allan: identify.AllanDeviation, fit: identify.AllanFit) -> dict[str, Any]:
    """Plain numbers for `--json`: the curve with its confidence, and the coefficients with standard errors."""
    fit = of_sensor(rest, fit)
    scale = {
        "quantisation_arcsec": (fit.quantisation, ARCSEC),
        "angle_random_walk_deg_per_sqrt_h": (fit.angle_random_walk, DEG_PER_SQRT_H),
        "bias_instability_deg_per_h": (fit.bias_instability, DEG_PER_H),
        "rate_random_walk_deg_per_h_per_sqrt_h": (fit.rate_random_walk, DEG_PER_H * 60.0),
    }
    return {
        "axis": rest.axis,
        "unit": rest.unit,
        "sample_interval_s": rest.sample_interval_s,
        "confidence": fit.confidence,
        "coefficients": {
            name: {"value": c.value * factor, "standard_error": c.standard_error * factor, "shows": c.shows}
            for name, (c, factor) in scale.items()
        },
        "curve": {
            "averaging_time_s": allan.averaging_time_s.tolist(),
            "deviation_deg_per_h": (allan.deviation * DEG_PER_H).tolist(),
            "lower_deg_per_h": (fit.lower * DEG_PER_H).tolist(),
            "upper_deg_per_h": (fit.upper * DEG_PER_H).tolist(),
            "model_deg_per_h": (fit.model_deviation * DEG_PER_H).tolist(),
        },
        "fitted_time_s": fit.fitted_time_s.tolist(),
        "low_passed": fit.low_passed,
        "misfit": {
            "chi_squared": fit.chi_squared,
            "degrees": fit.chi_squared_degrees,
            "chance": fit.chance,
            "level": identify.MISFIT,
        },
        "messages": [*rest.messages, *allan_notes(fit)],
    }


def allan_notes(fit: identify.AllanFit) -> tuple[str, ...]:
    """Times that a fit leaves out, and whether its model fits, in sentences."""
    notes: list[str] = []
    if not plausible(fit):
        notes.append(too_noisy(fit))
    elif 0.0 < fit.angle_random_walk.value < _QUIETEST:
        notes.append(
            f"an angle random walk of {fit.angle_random_walk.value * DEG_PER_SQRT_H:.2g} deg/sqrt(h) is that of a "
            "large fibre-optic or ring laser gyro: is the sensor such a gyro, or does the column map take angle "
            "increments as rates, or state deg/s for rates in rad/s, or ms for time stamps in s?"
        )
    if fit.low_passed:
        notes.append(
            f"a low-pass filter averages the samples: averaging times below {fit.fitted_time_s[0]:.3g} s are left "
            "out of the fit, and quantisation cannot be estimated"
        )
    if fit.chance < identify.MISFIT:
        last = fit.fitted_time_s[-1]
        notes.append(
            f"the fitted terms do not follow the curve; the deviation is largest near {fit.farthest_time_s:.3g} s "
            f"(χ² {fit.chi_squared:.4g} with {fit.chi_squared_degrees} degrees of freedom; of records with such noise, "
            f"fewer than {identify.MISFIT:.0%} deviate as much): the record has other effects (a trend, an "
            "oscillation, a thermal effect); "
            + (
                f"averaging times above {last:.3g} s are left out of the fit"
                if last < fit.averaging_time_s[-1] / 2
                else "the standard errors are increased accordingly"
            )
        )
    return tuple(notes)


def too_noisy(fit: identify.AllanFit) -> str:
    """The questions on a record with an implausible angle random walk."""
    return (
        f"an angle random walk of {fit.angle_random_walk.value * DEG_PER_SQRT_H:.3g} deg/sqrt(h) is more than any "
        "gyro has: does the column map state rad/s for rates in deg/s, or s for time stamps in ms, or did the "
        "sensor move?"
    )


def plausible(fit: identify.AllanFit) -> bool:
    """Whether a gyro can have this angle random walk; otherwise a unit is wrong, or the sensor moved."""
    return fit.angle_random_walk.value <= _NOISIEST
