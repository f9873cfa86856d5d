"""Raw samples through the whole door: simulated logs of both methods whose truth is known, and what can go wrong."""

from dataclasses import replace

import numpy as np
import pytest
from expected_errors import nees_band
from logs_zoo import GRADIENT, STANDARD, estimated, spec_of
from simulated_log import simulate_log

from gradcal_jax.calibration.equation import map_of
from gradcal_jax.estimation import ImuRows
from gradcal_jax.estimation.estimate import estimate_log
from gradcal_jax.estimation.lag_of_maps import LateTemperatures
from gradcal_jax.estimation.log_rows import Options, time_of
from gradcal_jax.formulas import followed
from gradcal_jax.information.plan_information import imu_posterior
from gradcal_jax.model import BIAS, SCALE_FACTOR
from gradcal_jax.model.build import build_imu
from gradcal_jax.records.log import Log, LogError, Reason
from gradcal_jax.spec import presets
from gradcal_jax.spec.changes import changed
from gradcal_jax.spec.spec import parse_spec


def errors(channel, truth):
    """Of the reported parameters, in standard deviations, and their NEES."""
    own = slice(channel.built.model.calibrated)
    rows, spread = channel.built.model.to_reported[own, own], channel.solution.known.spread[own]
    error = channel.solution.parameters[own] - truth
    white = np.linalg.lstsq(spread, error, rcond=None)[0]
    return rows @ error / np.linalg.norm(rows @ spread, axis=1), float(white @ white)


@pytest.fixture(scope="module")
def many():
    spec = spec_of()
    return spec, simulate_log(spec, units=24, sample_rate_hz=20.0, seed=5, readings=True)


@pytest.mark.long
def test_raw_samples_of_many_units_err_as_they_say(many):
    """The table's own noise is small here, so that the units of one log are independent."""
    spec, made = many
    channels = estimated(spec, made.log)
    squares = [errors(c, t)[1] for c, t in zip(channels, made.truth["x"], strict=True)]
    p = made.truth["x"].shape[1]
    low, high = nees_band(len(squares), p)
    assert low < np.mean(squares) / p < high
    fits = np.array([c.solution.test.statistic / c.solution.test.degrees for c in channels])
    low, high = nees_band(len(fits), channels[0].solution.test.degrees)
    assert low < fits.mean() < high
    for channel in channels:
        assert sum(channel.counts.values()) == made.log.rows_read
    # What was executed is what was planned, so what is known is what was predicted, within how readings are spaced.
    predicted = imu_posterior(build_imu(spec))
    rows = channels[0].built.model.to_reported
    ratio = channels[0].solution.known.deviations(rows) / predicted.deviations(rows)
    assert np.all(np.abs(ratio - 1.0) < 0.005)  # of rows instead of instants


@pytest.mark.parametrize("text", [GRADIENT, STANDARD], ids=["gradient", "standard"])
def test_without_noise_the_maps_come_back(text):
    """What is left is the sampling of the motion alone."""
    spec = spec_of(text)
    made = simulate_log(spec, sample_rate_hz=50.0, seed=2, noiseless=True)
    report = estimate_log(spec, [made.log])
    (calibration,) = report.calibrations
    (gyro,) = calibration.channel
    bias, scale_factor = (gyro.term_of(name) for name in ("bias", "scale_factor"))
    (channel,) = build_imu(spec).model.channels
    t, w = np.array([5.0, 20.0, 35.0]), np.radians(np.array([-250.0, 40.0, 250.0]))
    rows = channel.map(SCALE_FACTOR).values(t, w)
    truth = made.truth["x"][0]
    np.testing.assert_allclose(map_of(gyro, scale_factor, t)(w), rows @ truth[channel.where(SCALE_FACTOR)], atol=0.2e-6)
    of_bias = channel.map(BIAS).values(t, t) @ truth[channel.where(BIAS)]
    np.testing.assert_allclose(map_of(gyro, bias, t)(w), of_bias, atol=np.radians(0.02) / 3600)
    assert calibration.simulated
    assert made.log.simulated


@pytest.mark.long
@pytest.mark.parametrize("points", ["independent", "one run"])
def test_a_log_of_the_standard_method_errs_as_it_says(points):
    spec, squares = spec_of(STANDARD + f'points = "{points}"\n'), []
    for seed in range(6):
        made = simulate_log(spec, units=5, sample_rate_hz=2.0, seed=seed)
        channels = estimated(spec, made.log)
        squares += [errors(c, t)[1] for c, t in zip(channels, made.truth["x"], strict=True)]
        assert {int(np.count_nonzero(c.solution.used)) for c in channels} == {15}
    p = made.truth["x"].shape[1]
    low, high = nees_band(len(squares), p, 0.9999)  # the five of a log share the table's rates
    assert low < np.mean(squares) / p < high
    # Of a table that turns as told: the prediction's covariance, but that points of one run are a row farther apart.
    (channel,) = estimated(spec, simulate_log(spec, sample_rate_hz=20.0, noiseless=True).log)
    reported = channel.built.model.to_reported
    ratio = channel.solution.known.deviations(reported) / imu_posterior(build_imu(spec)).deviations(reported)
    np.testing.assert_allclose(ratio, 1.0, rtol=1e-9 if points == "independent" else 2.5e-5)


def test_a_map_that_no_gyro_has_is_refused(many):
    """A sensor whose scale factor changes by 30 % with the rate, and a spec without that structure."""
    spec, made = many
    rate = made.log.rate_rad_per_s[:1]
    one = replace(made.log, units=made.log.units[:1], temperature_c=made.log.temperature_c[:1], rate_rad_per_s=rate)
    (sound,) = estimated(spec, one)
    assert not any("not converged" in message for message in sound.messages)
    with pytest.raises(LogError, match=r"differ from those of the table by [0-9]+ times the noise"):
        estimated(spec, replace(one, rate_rad_per_s=rate * (1.0 + 0.3 * np.tanh(rate / 5.0))))


def test_gaps_and_masked_rows_are_bridged_by_new_origins_and_counted():
    spec = spec_of()
    made = simulate_log(spec, sample_rate_hz=20.0, seed=9)
    log, rows = made.log, len(made.log.time_s)
    status = np.zeros((1, rows), np.uint16)
    bad = np.random.default_rng(1).choice(rows, 30, replace=False)
    status[0, bad] = Reason.SATURATED
    rates = log.rate_rad_per_s.copy()
    rates[0, bad] = 50.0
    kept = np.r_[:4000, 4100:rows]
    holed = replace(
        log,
        time_s=log.time_s[kept],
        rate_rad_per_s=rates[:, kept],
        temperature_c=log.temperature_c[:, kept],
        table_angle_rad=log.table_angle_rad[kept],
        standstill=log.standstill[kept],
        status=status[:, kept],
        stretch_starts=np.array([0, 4000]),
        rows_read=rows,
        rows_removed={"duplicate stamp": 100},
    )
    (channel,), (whole,) = estimated(spec, holed), estimated(spec, log)
    off, square = errors(channel, made.truth["x"][0])
    assert square / len(off) < nees_band(1, len(off), 0.9999)[1]
    assert channel.counts["saturated"] == np.count_nonzero(status[0, kept])
    assert channel.counts["duplicate stamp"] == 100
    assert sum(channel.counts.values()) == rows
    reported = channel.built.model.to_reported
    assert np.all(channel.solution.known.deviations(reported) >= whole.solution.known.deviations(reported))


def test_a_lag_does_not_run_across_what_was_not_recorded():
    hour, lag, per_s = np.arange(0.0, 3600.0, 0.1), 120.0, 1.0 / 60.0
    up, down = 20.0 + per_s * hour, 80.0 - per_s * hour
    time = np.concatenate([hour, 3.0 * 3600.0 + hour])
    late = followed(np.concatenate([up, down]), time, np.array([0, len(hour)]), lag)
    behind = per_s * lag * -np.expm1(-hour / lag)
    np.testing.assert_allclose(late[: len(hour)], up - behind, atol=1e-9)
    np.testing.assert_allclose(late[len(hour) :], down + behind, atol=1e-9)


@pytest.mark.long
def test_a_lag_of_the_temperature_is_found():
    changes = {
        'temperature = ["0 degC", "40 degC"]\ngradient = "4 K/min"': PROGRAMME,
        '"0.5 deg/sqrt(h)"': '"0.01 deg/sqrt(h)"',
    }
    spec, lag = spec_of(**changes), 40.0
    log = simulate_log(spec, sample_rate_hz=10.0, seed=4).log
    # The thermometer leads: what the maps followed is the log's temperature, what is measured is ahead of it.
    ahead = log.temperature_c + lag * np.gradient(log.temperature_c[0], log.time_s)
    (channel,) = estimated(spec, replace(log, temperature_c=ahead))
    assert channel.lag.seconds == pytest.approx(lag, abs=max(5 * channel.lag.std, 2.0))
    assert channel.lag.std < 5.0
    (without,) = estimated(spec, replace(log, temperature_c=ahead), options=Options(lag=0.0))
    assert without.solution.test.statistic > channel.solution.test.statistic + 100.0


@pytest.mark.long
def test_a_small_lag_that_the_spec_states_is_fitted_or_in_the_covariance():
    """Some of the lags are larger than what a single log determines, some are not. Either way the errors of twelve
    units are as large in their standard deviations as without any lag."""
    units, size_s = 12, 5.0
    spec = spec_of(**{'temperature = ["0 degC", "40 degC"]\ngradient = "4 K/min"': PROGRAMME})
    spec = changed(spec, {"sensor.temperature_lag": f"{size_s} s"})
    made = simulate_log(spec, units=units, sample_rate_hz=10.0, seed=8)
    true, lags = made.log.temperature_c[0], size_s * np.abs(np.random.default_rng(1).standard_normal(units))
    late = replace(made.log, temperature_c=true + lags[:, None] * np.gradient(true, made.log.time_s))
    squares = {}
    for name, log, lag in (("no lag", made.log, 0.0), ("auto", late, "auto"), ("none", late, 0.0)):
        channels = estimated(spec, log, options=Options(lag=lag))
        found = [errors(c, t)[1] for c, t in zip(channels, made.truth["x"], strict=True)]
        squares[name] = np.mean(found) / made.truth["x"].shape[1]
        if lag == "auto":
            fitted = [(c.lag, s) for c, s in zip(channels, lags, strict=True) if not c.lag.in_rows]
            assert 0 < len(fitted) < units
            assert max(abs(of.seconds - s) / of.std for of, s in fitted) < 4.0
    assert squares["auto"] == pytest.approx(squares["no lag"], abs=0.03)
    assert squares["none"] > squares["no lag"] + 0.15


PROGRAMME = """programme = [
  { soak = "1 min", at = "0 degC" }, { ramp_to = "30 degC", rate = "5 K/min" },
  { ramp_to = "0 degC", rate = "5 K/min" } ]"""


def test_the_computers_clock_in_the_place_of_the_sensors():
    spec = spec_of()
    made = simulate_log(spec, sample_rate_hz=20.0, seed=3, noiseless=True)
    slow = replace(made.log, host_time_s=made.log.time_s.copy(), time_s=made.log.time_s * (1 - 500e-6))
    (right,) = estimated(spec, slow, options=Options(clock="host"))
    (wrong,) = estimated(spec, slow, options=Options(clock="sensor"))
    # A log with both takes the computer's without being asked.
    (same,) = estimated(spec, slow)
    np.testing.assert_array_equal(same.solution.parameters, right.solution.parameters)
    b00 = 2  # after the two of the bias
    rows = right.built.model.to_reported
    truth = (rows @ made.truth["x"][0])[b00]
    assert (rows @ right.solution.parameters)[b00] == pytest.approx(truth, abs=1e-6)
    assert (rows @ wrong.solution.parameters)[b00] == pytest.approx(truth - 500e-6, abs=5e-6)
    with pytest.raises(LogError, match="no host time"):
        estimated(spec, made.log, options=Options(clock="host"))


def test_what_is_unsure_of_the_computers_clock_is_unsure_of_the_scale_factor():
    spec, rate_std = spec_of(), 40e-6
    made = simulate_log(spec, sample_rate_hz=20.0, seed=3)
    known = replace(made.log, host_time_s=made.log.time_s)
    unsure = replace(known, provenance={"clock_from_row": "0", "clock_rate_std": f"{rate_std:.1e}"})
    b00 = 2  # after the two of the bias
    variances = []
    for log in (known, unsure):
        (channel,) = estimated(spec, log, options=Options(clock="host"))
        variances.append(channel.solution.known.covariance(channel.built.model.to_reported)[b00, b00])
    assert variances[1] - variances[0] == pytest.approx(rate_std**2, rel=1e-3)


SLOW, HOST = 300e-6, Options(clock="host")


def two_hours(far_s: float) -> Log:
    """Of a unit whose clock is slow: two parts that were laid on the computer's clock where each begins."""
    hour = np.arange(0.0, 3600.0, 0.1)
    time = np.concatenate([1000.0 + hour, 1000.0 + far_s + hour])
    host = np.concatenate([1000.0 + hour * (1.0 + SLOW), 1000.0 + far_s + hour * (1.0 + SLOW)])
    rates = np.zeros((1, len(time), 1))
    return Log(time, rates, ("u",), ("x",), stretch_starts=np.array([0, len(hour)]), host_time_s=host)


def test_the_slope_of_two_clocks_is_that_within_the_stretches():
    log = two_hours(36_000.0)
    time, (said,) = time_of(log, HOST)
    assert np.ptp(time[:36_000]) == pytest.approx(3599.9 * (1.0 + SLOW), abs=1e-6)
    assert "1.000300000 s of the computer's clock (the log does not state its uncertainty)" in said
    jitter = np.random.default_rng(1).uniform(0.0, 0.01, len(time))
    _, (said,) = time_of(replace(log, host_time_s=log.host_time_s + jitter), HOST)
    # 10 ms / √12, by two levers of 3600 s · √(36000 / 12).
    assert "(1σ 0.01 ppm)" in said
    # In a run's log that is stated; where the second part ran by another clock, the better known counts for more.
    host = log.host_time_s.copy()
    host[36_000:] += (log.time_s[36_000:] - log.time_s[36_000]) * 10e-6
    made = {"clock_from_row": "0, 36000", "clock_rate_std": "3.0e-07, 4.0e-07"}
    _, (said,) = time_of(replace(log, host_time_s=host, provenance=made), HOST)
    assert "1.000303600 s of the computer's clock (1σ 0.24 ppm)" in said


def test_what_a_log_lacks_is_a_sentence():
    spec = spec_of()
    log = simulate_log(spec, sample_rate_hz=10.0, noiseless=True).log
    with pytest.raises(LogError, match="no temperature"):
        estimated(spec, replace(log, temperature_c=None))
    constant = parse_spec(GRADIENT.replace("degree = 1, centre", "degree = 0, centre"))
    with pytest.raises(LogError, match="state it with --temperature"):
        estimated(constant, replace(log, temperature_c=None))
    (at,) = estimated(constant, replace(log, temperature_c=None), options=Options(temperature_c=23.4))
    assert at.calibration.valid_temperature == pytest.approx((23.4, 23.4))
    with pytest.raises(LogError, match="this log has temperatures"):
        estimated(spec, log, options=Options(temperature_c=23.4))
    with pytest.raises(ValueError, match="fewer than two readings while the table is at rest"):
        estimated(spec, replace(log, standstill=np.full(len(log.time_s), -1)))
    with pytest.raises(LogError, match="no table angle"):
        estimated(spec, replace(log, table_axes=(), table_angle_rad=None))
    with pytest.raises(LogError, match="no gyro roll"):
        estimated(spec, log, axis="roll")
    standard = spec_of(STANDARD)
    with pytest.raises(ValueError, match="none of the plan's points"):
        estimated(standard, replace(log, temperature_c=log.temperature_c + 10.0))


def test_a_log_that_determines_no_coefficient_has_a_calibration_without_covariance():
    one_cycle = {"plan.temperature": ["20 degC", "26 degC"], "sensor.gyro.scale_factor.temperature.degree": 1}
    spec = changed(parse_spec(presets.text("paper-dynamic-gradient")), one_cycle)
    report = estimate_log(spec, [simulate_log(spec, sample_rate_hz=10.0).log])
    assert report.calibrations[0].covariance.names == ()
    assert {row.verdict for row in report.verdicts["simulated-1"]} == {"unobservable"}
    assert not report.as_wished


def test_dies_may_be_late_from_the_begin_of_a_record_on_a_ramp():
    """Against the sum of the differential equation from long before the record, over a short break, too."""
    lag, time = 80.0, np.arange(0.0, 3000.0, 0.1)
    air = 20.0 + 0.03 * np.maximum(time - 50.0, 0.0) - 0.01 * np.maximum(time - 2000.0, 0.0)
    die = np.empty(len(time))
    die[0] = air[0]
    for k in range(1, len(time)):
        die[k] = die[k - 1] + (air[k - 1] - die[k - 1]) * 0.1 / lag
    kept = (time > 1000.0) & ~((time > 1500.0) & (time < 1540.0))
    rows = ImuRows(*(np.zeros(int(kept.sum())) for _ in range(9)))
    usable = np.ones(int(kept.sum()), bool)
    usable[np.flatnonzero(np.diff(time[kept]) > 1.0) + 1] = False
    noisy = air[kept] + 0.02 * np.random.default_rng(2).standard_normal(int(kept.sum()))
    rows = rows._replace(time_s=time[kept], temperature_c=noisy, usable=usable)
    late = LateTemperatures(rows)
    (doubt,) = late.doubts(lag)
    np.testing.assert_allclose(late(lag), die[kept], atol=0.03)
    # Had they rested until the record began, they would be later by nothing; that is well within the doubt.
    rested = followed(noisy, time[kept], rows.stretch_starts, lag)
    np.testing.assert_allclose(late(lag) - 0.1 * doubt, rested, atol=1e-9)
    assert doubt[0] == pytest.approx(-10.0 * lag * 0.03, abs=0.3)
    # A soak has no slope, and a thermometer of whole degrees shows none.
    still = rows._replace(temperature_c=np.rint(noisy / 100.0))
    late, settled = LateTemperatures(still), followed(still.temperature_c, still.time_s, still.stretch_starts, lag)
    np.testing.assert_array_equal(late(lag), settled)
    assert late.doubts(lag) == []
