"""Raw samples through the whole door: simulated logs of both methods whose truth is known, and what can go wrong."""

import re
from dataclasses import replace

import numpy as np
import pytest
from expected_errors import nees_band, on_trajectory
from gradcal_jax.api.calibration import estimate_calibration
from logs_zoo import GRADIENT, STANDARD, spec_of
from simulated_log import simulate_log

from gradcal_jax.api import assemble, posterior_of_plan
from gradcal_jax.api.estimate import estimate_channels
from gradcal_jax.api.estimate_options import Options
from gradcal_jax.api.fitted_lag import fitted_lag
from gradcal_jax.api.log_rows import Rows, host_time, temperature_followed
from gradcal_jax.files import changed, parse_spec, presets
from gradcal_jax.files.calibration.correction import term_values
from gradcal_jax.files.log import Log, LogError, Reason
from gradcal_jax.information import information
from gradcal_jax.information import posterior as posterior_of
from gradcal_jax.model import BIAS, SCALE_FACTOR


def errors(channel, truth):
    """Of the reported parameters, in standard deviations, and their NEES."""
    rows = channel.model.to_reported
    known = channel.estimate.known[0]
    error = channel.estimate.parameters[0] - truth
    white = np.linalg.lstsq(known.spread, error, rcond=None)[0]
    return rows @ error / known.deviations(rows), float(white @ white)


@pytest.fixture(scope="module")
def many():
    spec = spec_of()
    return spec, simulate_log(spec, units=24, sample_rate_hz=20.0, seed=5, readings=True)


def test_raw_samples_of_many_units_err_as_they_say(many):
    """The table's own noise is small here, so that the units of one log are independent."""
    spec, made = many
    channels = estimate_channels(spec, made.log)
    squares = [errors(c, t)[1] for c, t in zip(channels, made.truth["x"], strict=True)]
    p = made.truth["x"].shape[1]
    low, high = nees_band(len(squares), p)
    assert low < np.mean(squares) / p < high
    fits = np.array([c.consistency.fit.statistic / c.consistency.fit.degrees for c in channels])
    low, high = nees_band(len(fits), channels[0].consistency.fit.degrees)
    assert low < fits.mean() < high
    assert np.mean([c.consistency.whiteness.probability > 0.01 for c in channels]) > 0.9
    for channel in channels:
        assert sum(channel.counts.values()) == made.log.rows_read
    # What was executed is what was planned, so what is known is what was predicted, within how readings are spaced.
    predicted = posterior_of_plan(assemble(spec))
    rows = channels[0].model.to_reported
    ratio = channels[0].estimate.known[0].deviations(rows) / predicted.deviations(rows)
    assert np.all(np.abs(ratio - 1.0) < 0.005)  # of rows instead of instants


def test_the_covariance_is_the_prediction_of_the_executed_timeline(many):
    """The executed timeline put through the prediction: its pieces turn at mean rates, hence the small difference."""
    from gradcal_jax import estimation as room

    spec, made = many
    log, model = made.log, assemble(spec).model
    rows = np.arange(len(log.time_s))
    done = room.executed(
        log.time_s,
        log.temperature_c[0],
        log.rate_rad_per_s[0, :, 0],
        np.interp(rows, log.readings.row, log.readings.angle_rad),
        log.standstill >= 0,
        rows > 0,
        np.isin(rows, log.readings.row),
    )
    observations = on_trajectory(done.line, model, np.zeros((done.line.piece_count, 1)))
    ours = room.solve(room.whitened(observations, model)).known[0]
    theirs = posterior_of(information(done.line, model))
    rows = model.to_reported
    np.testing.assert_allclose(ours.deviations(rows), theirs.deviations(rows), rtol=1e-9)
    np.testing.assert_allclose(ours.covariance(rows), theirs.covariance(rows), rtol=1e-6, atol=1e-16)
    (channel,) = estimate_channels(spec, log, units=[log.units[0]])
    plain = replace(
        log, units=log.units[:1], rate_rad_per_s=log.rate_rad_per_s[:1], temperature_c=log.temperature_c[:1]
    )
    (alone,) = estimate_channels(spec, plain)
    np.testing.assert_allclose(alone.estimate.parameters, channel.estimate.parameters, rtol=1e-6)


@pytest.mark.parametrize("text", [GRADIENT, STANDARD], ids=["gradient", "standard"])
def test_without_noise_the_maps_come_back(text):
    """What is left is the sampling of the motion alone."""
    spec = spec_of(text)
    made = simulate_log(spec, sample_rate_hz=50.0, seed=2, noiseless=True)
    report = estimate_calibration(spec, made.log)
    (calibration,) = report.calibrations
    bias, scale_factor = (calibration.channel[0].term_of(name) for name in ("bias", "scale_factor"))
    model = assemble(spec).model
    t, w = np.array([5.0, 20.0, 35.0]), np.radians(np.array([-250.0, 40.0, 250.0]))
    rows = model.scale.values(t, w)
    truth = made.truth["x"][0]
    np.testing.assert_allclose(term_values(scale_factor, t, w), rows @ truth[model.where(SCALE_FACTOR)], atol=0.2e-6)
    of_bias = model.bias.values(t, t) @ truth[model.where(BIAS)]
    np.testing.assert_allclose(term_values(bias, t), of_bias, atol=np.radians(0.02) / 3600)
    assert calibration.simulated
    assert made.log.simulated


@pytest.mark.parametrize("points", ["independent", "one run"])
def test_a_log_of_the_standard_method_errs_as_it_says(points):
    spec = spec_of(STANDARD + f'points = "{points}"\n')
    squares = []
    for seed in range(6):
        made = simulate_log(spec, units=5, sample_rate_hz=2.0, seed=seed)
        channels = estimate_channels(spec, made.log)
        squares += [errors(c, t)[1] for c, t in zip(channels, made.truth["x"], strict=True)]
    p = made.truth["x"].shape[1]
    low, high = nees_band(len(squares), p, 0.9999)  # the five of a log share the table's rates
    assert low < np.mean(squares) / p < high
    (planned,) = {len(c.weights) for c in channels}
    assert planned == 15
    # Of a table that turns as told: the prediction's covariance, but that points of one run are a row farther apart.
    told = simulate_log(spec, sample_rate_hz=20.0, noiseless=True)
    (channel,) = estimate_channels(spec, told.log)
    rows = channel.model.to_reported
    ratio = channel.estimate.known[0].deviations(rows) / posterior_of_plan(assemble(spec)).deviations(rows)
    np.testing.assert_allclose(ratio, 1.0, rtol=1e-9 if points == "independent" else 2.5e-5)


def test_maps_that_do_not_settle_are_said(many):
    """A sensor whose scale factor changes by 30 % with the rate: the rates at which its map is taken run away."""
    spec, made = many
    rate = made.log.rate_rad_per_s[:1]
    one = replace(made.log, units=made.log.units[:1], temperature_c=made.log.temperature_c[:1], rate_rad_per_s=rate)
    (sound,) = estimate_channels(spec, one)
    (wild,) = estimate_channels(spec, replace(one, rate_rad_per_s=rate * (1.0 + 0.3 * np.tanh(rate / 5.0))))
    assert not any("not converged" in message for message in sound.messages)
    assert any("not converged" in message for message in wild.messages)


def test_gaps_and_masked_rows_are_bridged_by_new_origins_and_counted():
    spec = spec_of()
    made = simulate_log(spec, sample_rate_hz=20.0, seed=9)
    log = made.log
    rows = len(log.time_s)
    status = np.zeros((1, rows), np.uint16)
    rng = np.random.default_rng(1)
    bad = rng.choice(rows, 30, replace=False)
    status[0, bad] = Reason.SATURATED
    rates = log.rate_rad_per_s.copy()
    rates[0, bad] = 50.0
    kept = np.ones(rows, bool)
    kept[4000:4100] = False
    starts = np.array([0, 4000])
    holed = Log(
        log.time_s[kept],
        rates[:, kept],
        log.units,
        log.axes,
        temperature_c=log.temperature_c[:, kept],
        table_axes=log.table_axes,
        table_angle_rad=log.table_angle_rad[kept],
        standstill=log.standstill[kept],
        status=status[:, kept],
        stretch_starts=starts,
        rows_read=rows,
        rows_removed={"duplicate stamp": 100},
        simulated=True,
    )
    (channel,) = estimate_channels(spec, holed)
    off, square = errors(channel, made.truth["x"][0])
    assert square / len(off) < nees_band(1, len(off), 0.9999)[1]
    assert channel.counts["saturated"] == np.count_nonzero(status[0, kept])
    assert channel.counts["duplicate stamp"] == 100
    assert sum(channel.counts.values()) == rows
    whole = estimate_channels(spec, log)[0]
    rows_ = channel.model.to_reported
    assert np.all(channel.estimate.known[0].deviations(rows_) >= whole.estimate.known[0].deviations(rows_))


def test_a_lag_of_the_temperature_is_found():
    spec = spec_of(
        **{
            'temperature = ["0 degC", "40 degC"]\ngradient = "4 K/min"': PROGRAMME,
            '"0.5 deg/sqrt(h)"': '"0.01 deg/sqrt(h)"',
        }
    )
    made = simulate_log(spec, sample_rate_hz=10.0, seed=4)
    # The thermometer leads: what the maps followed is the log's temperature, what is measured is ahead of it.
    log = made.log
    lag = 40.0
    true = log.temperature_c[0]
    ahead = true + lag * np.gradient(true, log.time_s)
    (channel,) = estimate_channels(spec, replace(log, temperature_c=ahead[None]), options=Options(lag="fit"))
    assert channel.lag_s == pytest.approx(lag, abs=max(5 * channel.lag_std_s, 2.0))
    assert channel.lag_std_s < 5.0
    (without,) = estimate_channels(spec, replace(log, temperature_c=ahead[None]))
    assert without.consistency.fit.statistic > channel.consistency.fit.statistic + 100.0
    split = next(s for s in without.consistency.splits if s.name == "heating against cooling")
    assert not split.agreement.passed


def rows_at(time: np.ndarray, temperature: np.ndarray, starts: list[int]) -> Rows:
    """Of a unit that does nothing but get warm."""
    nothing, every = np.zeros(len(time)), np.ones(len(time), bool)
    step = np.diff(time, prepend=time[0])
    return Rows(
        time, step, nothing, temperature, None, None, every, every, np.ones(len(time)), every, np.array(starts), ()
    )


def test_a_lag_does_not_run_across_what_was_not_recorded():
    hour, lag, per_s = np.arange(0.0, 3600.0, 0.1), 120.0, 1.0 / 60.0
    up, down = 20.0 + per_s * hour, 80.0 - per_s * hour
    time = np.concatenate([hour, 3.0 * 3600.0 + hour])
    late = temperature_followed(rows_at(time, np.concatenate([up, down]), [0, len(hour)]), lag)
    behind = per_s * lag * -np.expm1(-hour / lag)
    np.testing.assert_allclose(late[: len(hour)], up - behind, atol=1e-9)
    np.testing.assert_allclose(late[len(hour) :], down + behind, atol=1e-9)


def test_a_lag_goes_on_over_samples_that_were_lost():
    time = np.arange(0.0, 3600.0, 0.1)
    rows = rows_at(time, 20.0 + time / 60.0, [0])
    whole = temperature_followed(rows, 120.0)
    kept = np.ones(len(time), bool)
    # A row alone among losses, and nine seconds.
    kept[20_000:20_010] = kept[20_011:20_101] = False
    holed = rows_at(time[kept], rows.temperature[kept], [0, 20_000, 20_001])
    np.testing.assert_allclose(temperature_followed(holed, 120.0), whole[kept], atol=1e-9)


@pytest.mark.parametrize(("at_s", "std_s"), [(-3.0, 4.0), (0.3, 0.5), (40.0, 2.0)])
def test_how_well_a_lag_is_known_is_told_also_where_there_is_none(at_s, std_s):
    lag, known = fitted_lag(lambda lag: ((lag - at_s) / std_s) ** 2)
    assert lag == pytest.approx(max(at_s, 0.0), abs=0.1)
    assert known == pytest.approx(std_s, rel=1e-6)


PROGRAMME = """programme = [
  { soak = "1 min", at = "0 degC" }, { ramp_to = "30 degC", rate = "5 K/min" },
  { ramp_to = "0 degC", rate = "5 K/min" } ]"""


def test_the_earths_rate_is_taken_off():
    spec = spec_of()
    made = simulate_log(spec, sample_rate_hz=20.0, seed=3)
    earth = np.radians(10.4) / 3600
    turned = replace(made.log, rate_rad_per_s=made.log.rate_rad_per_s + earth)
    plain = estimate_channels(spec, made.log)[0].estimate.parameters
    corrected = estimate_channels(spec, turned, options=Options(earth_rate=earth))[0].estimate.parameters
    np.testing.assert_allclose(corrected, plain, atol=1e-10)


def test_one_number_is_not_the_earths_rate_along_several_axes():
    spec = spec_of()
    log = simulate_log(spec, sample_rate_hz=20.0, seed=3).log
    both = replace(log, rate_rad_per_s=np.tile(log.rate_rad_per_s, 2), axes=("x", "y"))
    with pytest.raises(ValueError, match="changes while other axes turn"):
        estimate_channels(spec, both, axes=["x", "y"], options=Options(earth_rate=5e-5))


def test_the_computers_clock_in_the_place_of_the_sensors():
    spec = spec_of()
    made = simulate_log(spec, sample_rate_hz=20.0, seed=3, noiseless=True)
    slow = replace(made.log, host_time_s=made.log.time_s.copy(), time_s=made.log.time_s * (1 - 500e-6))
    (right,) = estimate_channels(spec, slow, options=Options(clock="host"))
    (wrong,) = estimate_channels(spec, slow, options=Options(clock="sensor"))
    # A log with both takes the computer's without being asked.
    (same,) = estimate_channels(spec, slow)
    np.testing.assert_array_equal(same.estimate.parameters, right.estimate.parameters)
    b00 = 2  # after the two of the bias
    rows = right.model.to_reported
    truth = (rows @ made.truth["x"][0])[b00]
    assert (rows @ right.estimate.parameters[0])[b00] == pytest.approx(truth, abs=1e-6)
    assert (rows @ wrong.estimate.parameters[0])[b00] == pytest.approx(truth - 500e-6, abs=5e-6)
    with pytest.raises(LogError, match="no host time"):
        estimate_channels(spec, made.log, options=Options(clock="host"))


def test_what_is_unsure_of_the_computers_clock_is_unsure_of_the_scale_factor():
    spec, rate_std = spec_of(), 40e-6
    made = simulate_log(spec, sample_rate_hz=20.0, seed=3)
    known = replace(made.log, host_time_s=made.log.time_s)
    unsure = replace(known, provenance={"clock_from_row": "0", "clock_rate_std": f"{rate_std:.1e}"})
    b00 = 2  # after the two of the bias
    variances = []
    for log in (known, unsure):
        (channel,) = estimate_channels(spec, log, options=Options(clock="host"))
        variances.append(channel.estimate.known[0].covariance(channel.model.to_reported)[b00, b00])
    assert variances[1] - variances[0] == pytest.approx(rate_std**2, rel=1e-3)


SLOW = 300e-6


def two_hours(far_s: float, **more: object) -> Log:
    """Of a unit whose clock is slow: two parts that were laid on the computer's clock where each begins."""
    hour = np.arange(0.0, 3600.0, 0.1)
    time = np.concatenate([1000.0 + hour, 1000.0 + far_s + hour])
    host = np.concatenate([1000.0 + hour * (1.0 + SLOW), 1000.0 + far_s + hour * (1.0 + SLOW)])
    rates = np.zeros((1, len(time), 1))
    return Log(time, rates, ("u",), ("x",), stretch_starts=np.array([0, len(hour)]), host_time_s=host, **more)


def test_the_slope_of_two_clocks_is_that_within_the_stretches():
    log = two_hours(36_000.0)
    time, said = host_time(log)
    assert np.ptp(time[:36_000]) == pytest.approx(3599.9 * (1.0 + SLOW), abs=1e-6)
    assert "1.000300000 s of the computer (how well that is known the log does not say)" in said
    jitter = np.random.default_rng(1).uniform(0.0, 0.01, len(time))
    _, said = host_time(replace(log, host_time_s=log.host_time_s + jitter))
    # 10 ms / √12, by two levers of 3600 s · √(36000 / 12).
    assert "(1σ 0.01 ppm from the stamps' scatter)" in said


def test_how_well_a_runs_clock_is_known_comes_from_the_run():
    made = {"clock_from_row": "0, 36000", "clock_rate_std": "3.0e-07, 4.0e-07"}
    log = two_hours(36_000.0, provenance=made)
    # The second part ran by another clock: the better known counts for more.
    host = log.host_time_s.copy()
    host[36_000:] += (log.time_s[36_000:] - log.time_s[36_000]) * 10e-6
    _, said = host_time(replace(log, host_time_s=host))
    assert "1.000303600 s of the computer (1σ 0.24 ppm from when its samples arrived)" in said
    one = {"clock_rate_std": "2.5e-07"}
    _, said = host_time(two_hours(3600.0 * (1.0 + SLOW), provenance=one))
    assert "(1σ 0.25 ppm from when its samples arrived)" in said


def test_points_are_found_in_the_log_whatever_the_plan_says():
    """Of a run at 5 temperatures and 7 rates the spec names 2 and 2: all 35 points are used, and soaks are not."""
    many = STANDARD.replace(
        '["0 degC", "20 degC", "40 degC"]', '["0 degC", "10 degC", "20 degC", "30 degC", "40 degC"]'
    )
    rates = ", ".join(f'"{r} deg/s"' for r in (-300, -160, -80, 40, 80, 160, 300))
    many = re.sub(r"rates *= *\[.*?\]", f"rates = [{rates}]", many, flags=re.S)
    made = simulate_log(parse_spec(many), sample_rate_hz=10.0, seed=5)
    few = re.sub(r"rates *= *\[.*?\]", 'rates = ["-300 deg/s", "80 deg/s"]', many, flags=re.S)
    few = few.replace('"10 degC", "20 degC", "30 degC", ', "")
    (channel,) = estimate_channels(parse_spec(few), made.log)
    assert len(channel.weights) == 35
    assert any(
        "31 points, at held rates and stable temperatures, that are not in the plan" in m for m in channel.messages
    )
    (all_planned,) = estimate_channels(parse_spec(many), made.log)
    np.testing.assert_allclose(channel.estimate.parameters, all_planned.estimate.parameters, rtol=1e-2)


def test_what_a_log_lacks_is_a_sentence():
    spec = spec_of()
    log = simulate_log(spec, sample_rate_hz=10.0, noiseless=True).log
    with pytest.raises(LogError, match="no temperature"):
        estimate_channels(spec, replace(log, temperature_c=None))
    constant = parse_spec(GRADIENT.replace("degree = 1, centre", "degree = 0, centre"))
    with pytest.raises(LogError, match="give that of the recording"):
        estimate_channels(constant, replace(log, temperature_c=None))
    (at,) = estimate_channels(constant, replace(log, temperature_c=None), options=Options(temperature_c=23.4))
    assert at.valid_temperature_c == pytest.approx((23.4, 23.4))
    with pytest.raises(LogError, match="this log has its own"):
        estimate_channels(spec, log, options=Options(temperature_c=23.4))
    with pytest.raises(LogError, match="no table axis 'q'"):
        estimate_channels(spec, log, options=Options(table_axis="q"))
    with pytest.raises(ValueError, match="never stands still"):
        estimate_channels(spec, replace(log, standstill=np.full(len(log.time_s), -1)))
    with pytest.raises(LogError, match="no axis 'roll'"):
        estimate_channels(spec, log, axes=["roll"])
    standard = spec_of(STANDARD)
    with pytest.raises(ValueError, match="none of the plan's points"):
        estimate_channels(standard, replace(log, temperature_c=log.temperature_c + 200.0))


def test_without_a_table_only_the_bias_is_seen():
    spec = spec_of()
    log = simulate_log(spec, sample_rate_hz=20.0, seed=3).log
    alone = replace(log, table_axes=(), table_angle_rad=None)
    report = estimate_calibration(spec, alone)
    assert not report.as_wished
    (calibration,) = report.calibrations
    assert calibration.covariance.names == ("gyro_x.a0", "gyro_x.a1")
    assert len(calibration.unobservable) == 4
    assert any("the scale factor is not observable" in message for message in report.messages[log.units[0]])
    verdicts = {v.name: v.verdict for v in report.verdicts[log.units[0]]}
    assert verdicts["map"] == "unobservable"


def test_a_log_that_determines_no_coefficient_has_a_calibration_without_covariance():
    one_cycle = {"plan.temperature": ["20 degC", "26 degC"], "sensor.scale_factor.temperature.degree": 1}
    spec = changed(parse_spec(presets.text("paper-dynamic-gradient")), one_cycle)
    report = estimate_calibration(spec, simulate_log(spec, sample_rate_hz=10.0).log)
    assert report.calibrations[0].covariance.names == ()
    assert {row.verdict for row in report.verdicts["simulated-1"]} == {"unobservable"}
    assert not report.as_wished
