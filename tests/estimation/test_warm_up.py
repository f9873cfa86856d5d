"""The loop of a flight controller's temperature calibration, by simulated vehicles: log, parameters, correction.

The controllers' formulas here are written from their sources, not taken from the package: PX4 `TemperatureCompensation`
(`calc_thermal_offsets_3D`), ArduPilot `AP_InertialSensor_TCal::correct_sensor`.
"""

import json

import numpy as np
import pytest
from vehicle_samples import dataflash, imu_rows, sensor_gyro, ulog
from warm_ups import DEG_PER_H, output, vehicle, warming

from gradcal_jax.calibration import read_calibration
from gradcal_jax.calibration.correction import term_values
from gradcal_jax.cli import main
from gradcal_jax.estimation.calibrations import calibration_map
from gradcal_jax.estimation.warm_up import estimate_warm_up
from gradcal_jax.records.examination import Columns, examine
from gradcal_jax.records.log import Log, LogError

FIT = np.linspace(15.5, 48.0, 40)


def px4_offset(values, number, axis, temperature):
    f = lambda name: np.float32(values[f"TC_G{number}_{name}"])  # noqa: E731
    delta = np.clip(temperature.astype(np.float32), f("TMIN"), f("TMAX")) - f("TREF")
    return sum(f(f"X{k}_{axis}") * delta**k for k in range(4)).astype(float)


def ardupilot_correction(values, number, axis, temperature):
    """What is taken off: the polynomial less its value at CALTEMP, and the offset."""
    f = lambda name: np.float32(values.get(f"INS_{name}", 0.0))  # noqa: E731
    low, high = f(f"TCAL{number}_TMIN"), f(f"TCAL{number}_TMAX")

    def polynomial(t):
        d = np.clip(np.asarray(t, np.float32), low, high) - np.float32(35)
        return sum(f(f"TCAL{number}_GYR{k}_{axis}") * np.float32(1e-6) * d**k for k in (1, 2, 3))

    at = polynomial(f(f"GYR{number}_CALTEMP"))
    offset = f(f"GYR{number if number > 1 else ''}OFFS_{axis}")
    return (polynomial(temperature) - at + offset).astype(float)


def left(errors, calibration):
    """Errors `(temperatures, 3)` in the stated σ of the calibration's fit at `FIT`, and that σ in deg/h."""
    fit = calibration.model_copy(update={"unseen": ()})
    gyros = [c for c in fit.channel if c.kind == "gyro"]
    sigma = np.stack([calibration_map(fit, c, "bias", FIT, np.zeros(1))[1].values[:, 0] for c in gyros], axis=1)
    return errors / (sigma * DEG_PER_H), sigma


def biases(calibration):
    return np.stack([term_values(channel.term_of("bias"), FIT) for channel in calibration.channel], axis=1)


def numbers(path, name=0, value=1):
    rows = [line.split() for line in path.read_text(encoding="utf-8").splitlines()]
    return {row[name]: float(row[value]) for row in rows}


@pytest.mark.long
def test_px4_from_its_log_to_its_parameters(tmp_path, capsys):
    """Two gyros, each with a clock of its own: what PX4 makes of the parameters is within their σ."""
    units, (time, temperature) = (vehicle(1), vehicle(2)), warming(2400.0, 25.0)
    stamps = (time * 1e6).astype(np.int64) + 10**6
    path = ulog(
        tmp_path / "warm.ulg",
        ("sensor_gyro", 0, sensor_gyro(stamps, output(units[0], time, temperature, 1), temperature, 1310988)),
        ("sensor_gyro", 1, sensor_gyro(stamps + 777, output(units[1], time, temperature, 2), temperature, 3670026)),
    )
    assert main(["estimate", str(path), "-o", str(tmp_path / "cal.toml")]) in (0, 1)
    said = capsys.readouterr().out
    assert "Earth's" in said
    assert "IMU 1310988" in said
    for number, (unit, device) in enumerate(zip(units, (1310988, 3670026), strict=True)):
        parameters = tmp_path / f"tc-{number}.params"
        wanted = ["--format", "px4", "--instance", str(number), "--device-id", str(device), "-o", str(parameters)]
        assert main(["export", str(tmp_path / f"cal-{device}.toml"), *wanted]) == 0
        assert "TC_G" not in capsys.readouterr().out
        values = numbers(parameters, 2, 3)
        assert values["TC_G_ENABLE"] == 1.0
        assert values[f"TC_G{number}_ID"] == device
        truth = unit.true_bias(FIT)
        taken = np.stack([px4_offset(values, number, axis, FIT) for axis in range(3)], axis=1)
        sigmas, sigma = left(taken - truth, read_calibration(tmp_path / f"cal-{device}.toml"))
        assert np.sqrt(np.mean(sigmas**2)) < 1.5
        assert np.abs(sigmas).max() < 4.0
        assert 2.0 < sigma.mean() < 30.0
        # On another warm-up, corrected by PX4's formula: a hundredth of what it was, and within σ but for the noise.
        other_time, other = warming(1800.0, 25.0, cold=18.0, warmer_by=29.0)
        raw = output(unit, other_time, other, 50 + number)
        corrected = raw - np.stack([px4_offset(values, number, axis, other) for axis in range(3)], axis=1)
        means = corrected.reshape(18, -1, 3).mean(axis=1) / DEG_PER_H
        assert np.sqrt(np.mean(means**2)) < 2.0 * np.hypot(sigma.mean(), 8.0)
        assert np.sqrt(np.mean(raw**2)) / DEG_PER_H > 500.0


@pytest.mark.long
def test_ardupilot_from_its_log_to_its_parameters(tmp_path):
    """A log that was corrected by other parameters on the way: they are undone, and the new ones are within their σ."""
    unit, (time, temperature) = vehicle(3), warming(2400.0, 25.0)
    raw = output(unit, time, temperature, 3)
    old = {
        "AHRS_ORIENTATION": 0.0, "INS_TCAL1_ENABLE": 1.0, "INS_TCAL1_TMIN": 20.0, "INS_TCAL1_TMAX": 45.0,
        "INS_GYR1_CALTEMP": 31.0, "INS_TCAL1_GYR1_X": 90.0, "INS_TCAL1_GYR2_Y": -3.0, "INS_GYROFFS_Z": 0.004,
    }  # fmt: skip
    logged = raw - np.stack([ardupilot_correction(old, 1, axis, temperature) for axis in "XYZ"], axis=1)
    path = dataflash(tmp_path / "cal.bin", imu_rows((time * 1e6).astype(np.int64), 0, logged, temperature), old)
    out, parameters = tmp_path / "cal.toml", tmp_path / "tcal.parm"
    assert main(["estimate", str(path), "-o", str(out)]) in (0, 1)
    assert main(["export", str(out), "--format", "ardupilot", "-o", str(parameters)]) == 0
    values = numbers(parameters)
    assert values["INS_TCAL1_ENABLE"] == 1.0
    taken = np.stack([ardupilot_correction(values, 1, axis, FIT) for axis in "XYZ"], axis=1)
    sigmas, sigma = left(taken - unit.true_bias(FIT), read_calibration(out))
    assert np.sqrt(np.mean(sigmas**2)) < 1.5
    assert np.abs(sigmas).max() < 4.0
    assert 2.0 < sigma.mean() < 30.0


def log_of(unit, time, temperature, seed):
    rates = output(unit, time, temperature, seed)
    return Log(time, rates[None], ("g",), ("x", "y", "z"), temperature[None])


@pytest.mark.long
def test_a_thermometer_that_steps_by_a_degree():
    """Half a step times the slope of B is 25 to 86 deg/h; between the steps' instants the temperature is known."""
    unit, (time, temperature) = vehicle(5), warming(2400.0, 25.0)
    log = log_of(unit, time, temperature, 5)
    coarse = estimate_warm_up([Log(time, log.rate_rad_per_s, ("g",), log.axes, np.rint(temperature)[None])])
    (result,) = coarse.calibrations
    errors = biases(result) - unit.true_bias(FIT)
    sigmas, _ = left(errors, result)
    assert np.abs(sigmas).max() < 3.0
    assert np.sqrt(np.mean(errors**2)) / DEG_PER_H < 12.0


def test_masked_rows_change_no_bit_of_a_calibration():
    """Rows that the device marks as bad, and some seconds of false temperatures, which the examination masks."""
    unit, (time, course) = vehicle(5), warming(1800.0, 5.0)
    rates, marked = output(unit, time, course, 5), np.random.default_rng(5).random(len(time)) < 0.02

    def estimated(rate, temperature, false_reading):
        read = np.round(course, 3)
        read[3000:3030] = false_reading
        values = {f"gyro {axis}": np.where(marked, rate, rates[:, k])[None] for k, axis in enumerate("xyz")}
        values |= {"time": time, "temperature": np.where(marked, temperature, read)[None], "marked": marked[None]}
        columns = Columns(("g",), values)
        (result,) = estimate_warm_up([examine(columns)], axes=("x",)).calibrations
        return result

    first, other = estimated(0.0, 20.0, 85.0), estimated(1e300, -273.0, -127.0)
    assert first.model_dump_json() == other.model_dump_json()
    low, high = first.channel[0].valid_temperature
    assert course.min() - 0.1 <= low < high <= course.max() + 0.1


def test_what_is_no_warm_up_is_said(tmp_path, capsys):
    unit, (time, temperature) = vehicle(5), warming(300.0, 25.0)
    with pytest.raises(LogError, match=r"changes by 7\.\d K at rest"):
        estimate_warm_up([log_of(unit, *warming(160.0, 25.0), 5)])
    rates = output(unit, time, temperature, 5)
    with pytest.raises(LogError, match="no temperature of IMU g"):
        estimate_warm_up([Log(time, rates[None], ("g",), ("x", "y", "z"))])
    with pytest.raises(LogError, match="there is no IMU 'h' in this log; it has g"):
        estimate_warm_up([log_of(unit, *warming(900.0, 10.0), 5)], units=("h",))
    table = tmp_path / "a.csv"
    table.write_text("t,x\n" + "\n".join(f"{k / 10},{k % 7 * 1e-4}" for k in range(999)), encoding="utf-8")
    columns = tmp_path / "a.toml"
    columns.write_text(
        'format = "gradcal-columns/1"\ntime = { column = "t", unit = "s" }\nrate.x = { column = "x", unit = "rad/s" }'
    )
    asked = ["estimate", str(table), "--columns", str(columns)]
    assert main(asked) == 2
    assert "no temperature" in capsys.readouterr().err


def test_a_table_with_a_column_map_is_a_warm_up_too(tmp_path, capsys):
    unit, (time, temperature) = vehicle(6), warming(1500.0, 10.0)
    rates = output(unit, time, temperature, 6)
    np.savez(tmp_path / "a.npz", t=time, w=rates, c=temperature)
    (tmp_path / "a.toml").write_text(
        'format = "gradcal-columns/1"\ntime = { column = "t", unit = "s" }\n'
        'temperature = { column = "c", unit = "degC" }\nrate.x = { column = "w", index = 0, unit = "rad/s" }'
    )
    assert main(["estimate", str(tmp_path / "a.npz"), "--columns", str(tmp_path / "a.toml"), "--json"]) in (0, 1)
    (channel,) = json.loads(capsys.readouterr().out)["units"]
    assert [p["name"] for p in channel["parameters"]] == ["gyro_x.a0", "gyro_x.a1", "gyro_x.a2", "gyro_x.a3"]


KINDS = {
    "drift of 1 min": {"correlation_time_s": 60.0},
    "drift of 5 min": {"correlation_time_s": 300.0},
    "drift of 25 min": {"correlation_time_s": 1500.0},
    "random walk": {"drift_std": 400.0 * DEG_PER_H, "correlation_time_s": 1e7},
}


@pytest.mark.evidence
@pytest.mark.parametrize("kind", KINDS)
def test_the_stated_sigma_covers_what_is_left(kind):
    """Of 95 % intervals at 40 temperatures, 60 channels of each kind of drift: 0.90 and more hold the truth.

    (The slow noise is that of the class: of a gyro that is better than its class, σ is larger than need be.)"""
    inside, sizes, errors = [], [], []
    for seed in range(20):
        unit = vehicle(seed, **KINDS[kind])
        (result,) = estimate_warm_up([log_of(unit, *warming(2400.0, 10.0), seed)]).calibrations
        truth = unit.true_bias(FIT)
        if kind == "random walk":  # its beginning is this run's bias
            truth = truth + drift_at_start(unit, seed)
        taken = biases(result)
        sigmas, sigma = left(taken - truth, result)
        inside.append(np.mean(np.abs(sigmas) < 1.96))
        sizes.append(sigma)
        errors.append((taken - truth) / DEG_PER_H)
    share, sigma, error = np.mean(inside), np.mean(sizes), np.sqrt(np.mean(np.square(errors)))
    print(f"{kind}: {share:.3f} within 1.96 sigma; sigma {sigma:.3g}, error {error:.3g} deg/h rms")
    assert share >= 0.90
    assert sigma < 3.0 * error


def drift_at_start(unit, seed):
    return unit.drift_std * first_pushes(seed)


def first_pushes(seed):
    rng = np.random.default_rng([seed, 2])
    count = len(warming(2400.0, 10.0)[0])
    rng.standard_normal((count, 3))
    return rng.standard_normal(3)
