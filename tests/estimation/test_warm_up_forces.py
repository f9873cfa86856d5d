"""Accelerometers of a vehicle that warms up at rest: simulated, with a tilt that nobody knows."""

from dataclasses import replace

import numpy as np
import pytest
from scipy.signal import lfilter
from scipy.stats import chi2
from warm_ups import output, vehicle, warming

from gradcal_jax.calibration import read_calibration
from gradcal_jax.calibration.exports import ardupilot_correction, px4_correction
from gradcal_jax.cli import main
from gradcal_jax.estimation.warm_up import estimate_warm_up
from gradcal_jax.records.log import Log

MICRO_G = 9.80665e-6
HERTZ = 10.0
FIT = np.linspace(16.0, 48.0, 33)


def true_bias(temperature, seed):
    """`(n, 3)`, m/s²: some 150 µg/K, and curved."""
    sizes = np.array([20000.0, 150.0, 3.0, 0.05]) * MICRO_G
    b = np.random.default_rng([seed, 5]).standard_normal((3, 4)) * sizes
    return np.stack([np.polynomial.polynomial.polyval(temperature - 31.0, row) for row in b], axis=1)


def forces(temperature, seed, drift=100.0 * MICRO_G):
    """What the accelerometers say at rest, m/s²: gravity in an unknown attitude, bias, 5 min drift, white noise."""
    rng = np.random.default_rng([seed, 6])
    up = rng.standard_normal(3) * 0.1 + [0.0, 0.0, 1.0]
    kept = np.exp(-1.0 / HERTZ / 300.0)
    pushes = drift * np.sqrt(1.0 - kept**2) * rng.standard_normal((len(temperature), 3))
    pushes[0] = drift * rng.standard_normal(3)
    white = 0.08 / 60.0 * np.sqrt(HERTZ) * rng.standard_normal((len(temperature), 3))
    slow = lfilter([1.0], [1.0, -kept], pushes, axis=0)
    return 9.81 * up / np.linalg.norm(up) + true_bias(temperature, seed) + slow + white


def log_of(seed, **noise):
    time, temperature = warming(2400.0, HERTZ)
    rates = output(vehicle(seed), time, temperature, seed)
    return Log(
        time, rates[None], ("g",), ("x", "y", "z"), temperature[None], standstill=np.zeros(len(time), int),
        specific_force_m_per_s2=forces(temperature, seed, **noise)[None], force_axes=("x", "y", "z"),
    )  # fmt: skip


def test_changes_over_temperature_are_within_their_covariance():
    """The normalised errors of the values at four temperatures, less that in the middle: χ² of three coefficients."""
    total = 0.0
    for seed in range(8):
        (found,) = estimate_warm_up([log_of(seed)]).calibrations
        assert not any(name.startswith("acc") for name in found.contradicted)
        covariance = np.array(found.covariance.matrix)[12:, 12:]
        for k, channel in enumerate(found.channel[3:]):
            term = channel.term[0]
            centre, scale = float(term.temperature.centre), float(term.temperature.scale)
            at = centre + scale * np.array([-0.9, 0.5, 0.9])
            powers = ((at - centre)[:, None] / scale) ** np.arange(1, 4)
            truth = true_bias(at, seed)[:, k] - true_bias(np.array([centre]), seed)[:, k]
            error = powers @ [term.coefficients[f"a{i}"] for i in (1, 2, 3)] - truth
            own = powers @ covariance[3 * k : 3 * k + 3, 3 * k : 3 * k + 3] @ powers.T
            total += float(error @ np.linalg.solve(own, error))
    assert chi2.ppf(0.001, 3 * 24) < total < chi2.ppf(0.999, 3 * 24)


def test_a_vehicle_that_tilts_during_the_record_contradicts_the_model():
    log = log_of(1)
    moved = log.specific_force_m_per_s2 + 0.05 * (log.time_s > 900.0)[None, :, None] * np.array([1.0, 0.0, 0.0])
    report = estimate_warm_up([replace(log, specific_force_m_per_s2=moved)])
    (whole,) = report.calibrations
    assert "accelerometer_x: chi-squared" in whole.contradicted
    assert "accelerometer_y: chi-squared" not in whole.contradicted
    assert not report.as_wished
    assert any("not valid: accelerometer x" in message for message in report.messages["g"])


@pytest.mark.parametrize("target", ["px4", "ardupilot"])
def test_from_a_table_to_the_parameters_of_a_controller(tmp_path, capsys, target):
    log = log_of(3)
    rows = np.column_stack([log.time_s, log.temperature_c[0], log.rate_rad_per_s[0], log.specific_force_m_per_s2[0]])
    header = "t,c,wx,wy,wz,ax,ay,az"
    np.savetxt(tmp_path / "a.csv", rows, delimiter=",", header=header, comments="", fmt="%.8f")
    columns = 'format = "gradcal-columns/1"\ntime = { column = "t", unit = "s" }\n'
    columns += 'temperature = { column = "c", unit = "degC" }\n'
    for axis in "xyz":
        columns += f'rate.{axis} = {{ column = "w{axis}", unit = "rad/s" }}\n'
        columns += f'force.{axis} = {{ column = "a{axis}", unit = "m/s^2" }}\n'
    (tmp_path / "a.toml").write_text(columns, encoding="utf-8")
    out, parameters = tmp_path / "cal.toml", tmp_path / "parameters"
    assert main(["estimate", str(tmp_path / "a.csv"), "--columns", str(tmp_path / "a.toml"), "-o", str(out)]) in (0, 1)
    said = capsys.readouterr().out
    assert "a bias and a tilt cannot be separated" in said
    assert "accelerometer_z.a3" in said
    assert main(["export", str(out), "--format", target, "-o", str(parameters)]) == 0
    split = [line.split() for line in parameters.read_text(encoding="utf-8").splitlines()]
    name, value = (2, 3) if target == "px4" else (0, 1)
    values = {words[name]: float(words[value]) for words in split}
    of = px4_correction if target == "px4" else ardupilot_correction
    last = {"letter": "A", "number": 0} if target == "px4" else {"kind": "ACC"}
    for k, axis in enumerate("xyz"):
        left = true_bias(FIT, 3)[:, k] - of(values, axis, FIT, **last)
        assert np.ptp(left) < 0.25 * np.ptp(true_bias(FIT, 3)[:, k])
        assert np.ptp(left) < 1500.0 * MICRO_G
    assert {channel.kind for channel in read_calibration(out).channel} == {"gyro", "accelerometer"}
