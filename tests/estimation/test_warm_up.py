"""The loop of a flight controller's temperature calibration, by simulated vehicles: log, parameters, correction by the
controller's own formulas."""

from dataclasses import replace

import numpy as np
import pytest
from controllers import TAKEN_OFF, ardupilot, parameters_of
from scipy.stats import chi2
from vehicle_samples import dataflash, imu_rows, sensor_gyro, ulog
from warm_ups import DEG_PER_H, MICRO_G, accelerometers, gyros, output, warm_up, warming

from gradcal_jax.calibration.equation import map_of
from gradcal_jax.calibration.file import read_calibration
from gradcal_jax.cli import main
from gradcal_jax.estimation.calibrations import calibration_map
from gradcal_jax.estimation.warm_up import estimate_warm_up, warm_up_rows
from gradcal_jax.records.log import LogError

FIT = np.linspace(15.5, 48.0, 40)


def left(taken, bias, calibration):
    """Errors at `FIT` `(temperatures, 3)` in the stated σ of the calibration's fit, and that σ in rad/s."""
    fit = calibration.model_copy(update={"unseen": ()})
    gyro = [c for c in fit.channel if c.kind == "gyro"]
    sigma = np.stack([calibration_map(fit, c, "bias", FIT, np.zeros(1))[1].values[:, 0] for c in gyro], axis=1)
    return (taken - bias(FIT)) / (sigma * DEG_PER_H), sigma * DEG_PER_H


def within_sigma(target, path, out, bias, number, *options):
    """Export a calibration, and expect that what the controller makes of it is within σ; its parameters."""
    assert main(["export", str(out), "--format", target, *options, "-o", str(path)]) == 0
    values = parameters_of(path.read_text(encoding="utf-8"), target)
    taken = np.stack([TAKEN_OFF[target](values, axis, FIT, number) for axis in range(3)], axis=1)
    sigmas, sigma = left(taken, bias, read_calibration(out))
    assert np.sqrt(np.mean(sigmas**2)) < 1.5
    assert np.abs(sigmas).max() < 4.0
    assert 2.0 < sigma.mean() / DEG_PER_H < 30.0
    return values


@pytest.mark.long
def test_px4_from_its_log_to_its_parameters(tmp_path, capsys):
    """Two gyros, each with a clock of its own."""
    biases, (time, temperature) = (gyros(1), gyros(2)), warming(2400.0, 25.0)
    stamps, devices = (time * 1e6).astype(np.int64) + 10**6, (1310988, 3670026)
    raw = [output(bias, time, temperature, 1 + k) for k, bias in enumerate(biases)]
    path = ulog(
        tmp_path / "warm.ulg",
        ("sensor_gyro", 0, sensor_gyro(stamps, raw[0], temperature, devices[0])),
        ("sensor_gyro", 1, sensor_gyro(stamps + 777, raw[1], temperature, devices[1])),
    )
    assert main(["estimate", str(path), "-o", str(tmp_path / "cal.toml")]) in (0, 1)
    said = capsys.readouterr().out
    assert "Earth's" in said
    assert "IMU 1310988" in said
    for number, (bias, device) in enumerate(zip(biases, devices, strict=True)):
        out, wanted = tmp_path / f"cal-{device}.toml", ["--instance", str(number), "--device-id", str(device)]
        values = within_sigma("px4", tmp_path / "tc.params", out, bias, number, *wanted, "--force")
        assert (values["TC_G_ENABLE"], values[f"TC_G{number}_ID"]) == (1.0, device)


@pytest.mark.long
def test_ardupilot_from_its_log_to_its_parameters(tmp_path):
    """A log while ArduPilot learns: its offset is undone, what it has learnt so far is not applied, the new parameters
    are within their σ."""
    bias, (time, temperature) = gyros(3), warming(2400.0, 25.0)
    old = {
        "AHRS_ORIENTATION": 0.0, "INS_TCAL1_ENABLE": 2.0, "INS_TCAL1_TMIN": 20.0, "INS_TCAL1_TMAX": 45.0,
        "INS_GYR1_CALTEMP": 31.0, "INS_TCAL1_GYR1_X": 90.0, "INS_TCAL1_GYR2_Y": -3.0, "INS_GYROFFS_Z": 0.004,
    }  # fmt: skip
    taken = np.stack([ardupilot(old, axis, temperature) for axis in range(3)], axis=1)
    rows = imu_rows((time * 1e6).astype(np.int64), 0, output(bias, time, temperature, 3) - taken, temperature)
    path, out = dataflash(tmp_path / "cal.bin", rows, old), tmp_path / "cal.toml"
    assert main(["estimate", str(path), "-o", str(out)]) in (0, 1)
    values = within_sigma("ardupilot", tmp_path / "tcal.parm", out, bias, 1)
    assert values["INS_TCAL1_ENABLE"] == 1.0


def test_what_is_no_warm_up_is_said():
    log = warm_up(5, 900.0)
    with pytest.raises(LogError, match=r"changes by 7\.\d K at rest"):
        estimate_warm_up([warm_up(5, 160.0)])
    with pytest.raises(LogError, match="no temperature of IMU g"):
        estimate_warm_up([replace(log, temperature_c=None)])
    with pytest.raises(LogError, match="in steps of 1 K"):
        estimate_warm_up([replace(log, temperature_c=np.rint(log.temperature_c))])


KINDS = {
    "drift of 1 min": {"correlation_s": 60.0},
    "drift of 5 min": {"correlation_s": 300.0},
    "drift of 25 min": {"correlation_s": 1500.0},
    "random walk": {"drift": 400.0 * DEG_PER_H, "correlation_s": 1e7},
}


@pytest.mark.evidence
@pytest.mark.parametrize("kind", KINDS)
def test_the_stated_sigma_covers_what_is_left(kind):
    """Of 95 % intervals at 40 temperatures, 60 channels of each kind of drift: 0.90 and more hold the truth.

    (The slow noise is that of the class: of a gyro that is better than its class, σ is larger than need be.)"""
    inside, sizes, errors = [], [], []
    for seed in range(20):
        log, bias = warm_up(seed, **KINDS[kind]), gyros(seed)
        if kind == "random walk":  # its beginning is this run's bias
            start = first_push(seed, len(log.time_s)) * KINDS[kind]["drift"]
        (result,) = estimate_warm_up([log]).calibrations
        biases = [map_of(channel, channel.term_of("bias"), FIT) for channel in result.channel]
        taken = np.stack([bias_at(0.0 * FIT) for bias_at in biases], axis=1)
        taken -= start if kind == "random walk" else 0.0
        sigmas, sigma = left(taken, bias, result)
        inside.append(np.mean(np.abs(sigmas) < 1.96))
        sizes.append(sigma)
        errors.append(sigmas * sigma)
    share, sigma, error = np.mean(inside), np.mean(sizes), np.sqrt(np.mean(np.square(errors)))
    print(
        f"{kind}: {share:.3f} within 1.96 sigma; sigma {sigma / DEG_PER_H:.3g}, error {error / DEG_PER_H:.3g} deg/h rms"
    )
    assert share >= 0.90
    assert sigma < 3.0 * error


def first_push(seed, count):
    """The begin of a drift, in its standard deviations: drawn last by `output`."""
    rng = np.random.default_rng([seed, 2])
    rng.standard_normal((2 * count, 3))
    return rng.standard_normal(3)


# --- accelerometers, with a tilt that nobody knows --------------------------------------------------------------------


def test_changes_of_accelerometers_over_temperature_are_within_their_covariance():
    """The normalised errors of the values at three temperatures, less that in the middle: χ² of three coefficients."""
    total = 0.0
    for seed in range(8):
        (found,) = estimate_warm_up([warm_up(seed, force=True)]).calibrations
        assert not any(name.startswith("acc") for name in found.contradicted)
        covariance = np.array(found.covariance.matrix)[12:, 12:]
        for k, channel in enumerate(found.channel[3:]):
            term = channel.term[0]
            centre, scale = float(term.temperature.centre), float(term.temperature.scale)
            at = centre + scale * np.array([-0.9, 0.5, 0.9])
            powers = ((at - centre)[:, None] / scale) ** np.arange(1, 4)
            truth = accelerometers(seed)(np.array([*at, centre]))[:, k]
            error = powers @ [term.coefficients[f"a{i}"] for i in (1, 2, 3)] - (truth[:3] - truth[3])
            own = powers @ covariance[3 * k : 3 * k + 3, 3 * k : 3 * k + 3] @ powers.T
            total += float(error @ np.linalg.solve(own, error))
    assert chi2.ppf(0.001, 3 * 24) < total < chi2.ppf(0.999, 3 * 24)


def test_a_vehicle_that_tilts_during_the_record_contradicts_the_model():
    log = warm_up(1, force=True)
    moved = log.specific_force_m_per_s2 + 0.05 * (log.time_s > 900.0)[None, :, None] * np.array([1.0, 0.0, 0.0])
    report = estimate_warm_up([replace(log, specific_force_m_per_s2=moved)])
    (whole,) = report.calibrations
    assert "accelerometer_x: chi-squared" in whole.contradicted
    assert "accelerometer_y: chi-squared" not in whole.contradicted
    assert not report.as_wished
    assert any("not valid: accelerometer_x" in message for message in report.messages["g"])
    (row,) = warm_up_rows(report)["units"]
    assert [of["name"] for of in row["parameters"][:5]] == [*(f"gyro_x.a{k}" for k in range(4)), "gyro_y.a0"]


@pytest.mark.parametrize("target", ["px4", "ardupilot"])
def test_from_a_table_to_the_parameters_of_a_controller(tmp_path, capsys, target):
    log = warm_up(3, force=True)
    both = np.concatenate([log.rate_rad_per_s[0], log.specific_force_m_per_s2[0]], axis=1)
    np.savez(tmp_path / "a.npz", t=log.time_s, c=log.temperature_c[0], w=both)
    columns = 'format = "gradcal-columns/1"\ntime = { column = "t", unit = "s" }\n'
    columns += 'temperature = { column = "c", unit = "degC" }\n'
    for k, axis in enumerate("xyz"):
        columns += f'rate.{axis} = {{ column = "w", index = {k}, unit = "rad/s" }}\n'
        columns += f'force.{axis} = {{ column = "w", index = {3 + k}, unit = "m/s^2" }}\n'
    (tmp_path / "a.toml").write_text(columns, encoding="utf-8")
    out, parameters = tmp_path / "cal.toml", tmp_path / "parameters"
    assert main(["estimate", str(tmp_path / "a.npz"), "--columns", str(tmp_path / "a.toml"), "-o", str(out)]) in (0, 1)
    said = capsys.readouterr().out
    assert "a bias and a tilt cannot be separated" in said
    assert "accelerometer_z.a3" in said
    assert main(["export", str(out), "--format", target, "-o", str(parameters)]) == 0
    values = parameters_of(parameters.read_text(encoding="utf-8"), target)
    for k in range(3):
        number, truth = int(target == "ardupilot"), accelerometers(3)(FIT)[:, k]
        apart = truth - TAKEN_OFF[target](values, k, FIT, number, "accelerometer")
        assert np.ptp(apart) < min(0.25 * np.ptp(truth), 1500.0 * MICRO_G)
