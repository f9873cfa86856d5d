"""What a calibration does to data: solved to rounding, held at the edge, lagging, and refused where it does not fit."""

from dataclasses import replace

import numpy as np
import pytest
from calibration_samples import (
    BINS_W,
    SPLINE_T,
    WHOLE,
    G,
    a_truth,
    axis,
    calibration_of,
    gyro,
    of,
    readings,
    term,
)

from gradcal_jax.calibration.correction import apply, correct
from gradcal_jax.calibration.equation import map_of
from gradcal_jax.calibration.file import write_calibration
from gradcal_jax.cli import main
from gradcal_jax.records.log import Log, LogError, Reason
from gradcal_jax.records.log_file import write_log


def log_of(calibration, rows=500, seed=0, **more):
    """What the calibration's gyros say of known rates inside their range; the truth beside it."""
    rng = np.random.default_rng(seed)
    truth = np.radians(rng.uniform(-299, 299, (rows, 3)))
    temperature = np.linspace(-29.0, 69.0, rows)
    said = np.stack([gyro(calibration, truth[:, k], temperature, axis) for k, axis in enumerate("xyz")], axis=-1)
    log = Log(np.arange(rows) * 0.01, said[None], ("SN-7",), ("x", "y", "z"), temperature_c=temperature[None], **more)
    return log, truth


def log_of_x(time, said, temperature, **more):
    return Log(time, said[None, :, None], ("SN-7",), ("x",), temperature_c=temperature[None], **more)


def test_what_was_measured_is_solved_to_rounding():
    found = of(*(axis(n, SPLINE_T) for n in "xyz"))
    log, truth = log_of(found)
    corrected = apply(found, log)
    np.testing.assert_allclose(corrected.log.rate_rad_per_s[0], truth, rtol=4e-15, atol=4e-15)
    assert corrected.outside_temperature == corrected.outside_rate == 0
    assert corrected.log.simulated  # the calibration is


def test_the_log_of_an_imu_is_solved_to_the_truth_and_a_sample_without_a_solution_spoils_no_other():
    """Misalignments, sensitivities to acceleration and squares of the force, by a twin's own formulas."""
    truth, kept = a_truth(), np.arange(400) != 7
    log, rate, force = readings(truth)
    felt = log.specific_force_m_per_s2.copy()
    felt[0, 7, 2] = -1e9
    for wrong in (log, replace(log, specific_force_m_per_s2=felt)):
        done = apply(calibration_of(truth), wrong, "SN-7")
        assert np.max(np.abs(done.log.rate_rad_per_s[0] - rate)[kept]) < 1e-12
        assert np.max(np.abs(done.log.specific_force_m_per_s2[0] - force)[kept]) < 1e-13 * G
        assert (done.outside_temperature, done.outside_rate, done.left_alone) == (0, 0, ())


def test_bins_jump_and_are_solved_within_the_jump():
    found = of(axis("x", rate=BINS_W))
    truth = np.radians(np.linspace(-290.0, 290.0, 401))
    at = np.full_like(truth, 33.0)
    solved = correct(found.channel, ["rate x"], gyro(found, truth, at)[None], at)
    np.testing.assert_allclose(solved[0], truth, atol=1e-4)


def test_outside_its_range_the_edge_holds_and_is_counted():
    found = WHOLE
    log, _ = log_of(found, 100)
    hot = replace(log, rate_rad_per_s=log.rate_rad_per_s * 1.2, temperature_c=log.temperature_c + 20.0)
    corrected = apply(found, hot)
    assert corrected.outside_temperature == np.count_nonzero(hot.temperature_c > 70.0)
    assert corrected.outside_rate > 10
    assert np.isfinite(corrected.log.rate_rad_per_s).all()
    fast = np.abs(corrected.log.rate_rad_per_s[0, :, 0]) > np.radians(300.0)
    at = np.minimum(hot.temperature_c[0][fast], 70.0)
    bias, scale = (map_of(found.channel[0], term, at) for term in found.channel[0].term)
    said, true = hot.rate_rad_per_s[0, fast, 0], corrected.log.rate_rad_per_s[0, fast, 0]
    map_at_edge = scale(np.radians(300.0) * np.sign(said))
    np.testing.assert_allclose(true, (said - bias(said)) / (1.0 + map_at_edge), rtol=1e-12)
    edge = replace(hot, temperature_c=np.clip(hot.temperature_c, -30.0, 70.0))
    np.testing.assert_array_equal(corrected.log.rate_rad_per_s, apply(found, edge).log.rate_rad_per_s)


def test_a_signal_between_bars_counts_by_its_size():
    found = of(axis("x", terms=[term("asymmetry", "1", ["|rate x|"], {"asymmetry": 2e-3})]))
    truth = np.array([-2.0, -0.5, 0.0, 0.5, 2.0])
    at = np.full_like(truth, 33.0)
    said = gyro(of(axis("x")), truth, at) + 2e-3 * np.abs(truth)
    np.testing.assert_allclose(correct(found.channel, ["rate x"], said[None], at)[0], truth, atol=1e-14)


def test_masked_rows_stay_masked_and_missing_temperatures_are_bridged():
    found = WHOLE
    log, truth = log_of(found, 200)
    status = np.zeros((1, 200), np.uint16)
    status[0, 50:53] = Reason.MISSING_TEMPERATURE
    temperature = log.temperature_c.copy()
    temperature[0, 50:53] = np.nan
    corrected = apply(found, replace(log, temperature_c=temperature, status=status)).log
    np.testing.assert_allclose(corrected.rate_rad_per_s[0], truth, rtol=1e-9)
    assert corrected.counts() == {"used": 197, "missing temperature": 3}


def test_what_is_applied_lags_within_a_stretch_and_not_across_hours():
    found = of(axis("x", thermal_lag="2 min"))
    hour = np.arange(0.0, 3600.0, 1.0)
    behind = 120.0 / 60.0 * -np.expm1(-hour / 120.0)  # of a ramp of 1 K/min
    temperature = np.concatenate([hour / 60.0, 60.0 - hour / 60.0])
    truth = np.full_like(temperature, 0.3)
    said = gyro(found, truth, temperature + np.concatenate([-behind, behind]))
    time = np.concatenate([hour, 3.0 * 3600.0 + hour])
    starts = np.array([0, len(hour)])
    log = log_of_x(time, said, temperature, stretch_starts=starts)
    np.testing.assert_allclose(apply(found, log).log.rate_rad_per_s[0, :, 0], truth, rtol=1e-9)


GRADIENT = term("bias_temperature_gradient", "rad/K", ["temperature rate"], {"bias_temperature_gradient": 2e-3})


def test_the_bias_of_a_changing_temperature_is_taken_off():
    found = of(axis("x", terms=[GRADIENT]))
    time, truth = np.arange(0.0, 600.0, 0.5), np.full(1200, 0.3)
    temperature = 20.0 + time / 60.0
    said = gyro(found, truth, temperature) + 2e-3 / 60.0
    log = log_of_x(time, said, temperature)
    np.testing.assert_allclose(apply(found, log).log.rate_rad_per_s[0, :, 0], truth, rtol=1e-9)


def test_a_log_that_does_not_fit_is_a_sentence():
    found = WHOLE
    other = Log(np.arange(5.0), np.zeros((1, 5, 1)), ("SN-7",), ("roll",))
    with pytest.raises(LogError, match="none of the log's channels"):
        apply(found, other)
    with pytest.raises(LogError, match="no temperature"):
        apply(found, Log(np.arange(5.0), np.zeros((1, 5, 1)), ("SN-7",), ("x",)))
    log, *_ = readings(a_truth())
    without = replace(log, specific_force_m_per_s2=None, force_axes=())
    with pytest.raises(LogError, match="no accelerometer x, but"):
        apply(calibration_of(a_truth()), without)


def test_a_corrected_log_is_not_corrected_again(tmp_path, capsys):
    log, _ = log_of(WHOLE, 50)
    calibration, raw, done = (str(tmp_path / name) for name in ("cal.toml", "raw.nc", "done.nc"))
    write_calibration(WHOLE, calibration)
    write_log(log, raw)
    assert main(["apply", calibration, raw, "-o", done]) == 0
    for command in (["apply", calibration, done, "-o", str(tmp_path / "twice.nc")], ["validate", calibration, done]):
        assert main(command) == 2
        assert "done.nc is already corrected, by the calibration of SN-7" in capsys.readouterr().err
    assert not (tmp_path / "twice.nc").exists()


def test_a_log_may_have_fewer_channels_where_none_depends_on_another():
    found = WHOLE
    log, truth = log_of(found, 50)
    alone = replace(log, rate_rad_per_s=log.rate_rad_per_s[:, :, 1:2], axes=("y",))
    np.testing.assert_allclose(apply(found, alone).log.rate_rad_per_s[0, :, 0], truth[:, 1], rtol=4e-15, atol=4e-15)


def test_a_map_too_steep_to_invert_is_refused():
    terms = axis("x")
    terms["term"][1]["coefficients"]["b10"] = -3.0
    steep = of(terms)
    with pytest.raises(ValueError, match="gyro x is too steep"):
        correct(steep.channel, ["rate x"], np.radians(np.linspace(-300, 300, 61))[None], np.full(61, 70.0))
