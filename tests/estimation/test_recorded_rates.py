"""Real recordings through the estimator: step and rate runs of a jig.

The jig (Rimu test jig, a BNO055 on a stepper): 36 commanded steps of 10.0125° with rests, and runs of seven commanded
rates without any rest. Neither has an encoder: the reference is what the stepper was told, and at rest the drive
vibrates by degrees per second.
"""

import os
from pathlib import Path

import numpy as np
import pytest
from logs_zoo import GRADIENT, estimated
from scipy.ndimage import uniform_filter1d

from gradcal_jax.estimation import find_standstills
from gradcal_jax.estimation.estimate import estimate_log
from gradcal_jax.estimation.log_rows import Options
from gradcal_jax.records.log import Log
from gradcal_jax.spec.spec import parse_spec

FOLDER = Path(os.environ.get("GRADCAL_DATA", Path(__file__).parents[3] / "shared" / "data"))
pytestmark = pytest.mark.skipif(not FOLDER.is_dir(), reason="the recorded data are not here: set GRADCAL_DATA")

SCALE = 2000.0 / 32768.0
STEP = np.radians(10.0125)
# No temperature was recorded: the maps are constants. What the vibrating drive leaves of a BNO055: more random walk
# than its data sheet says, and a place of rest that is uncertain by a microstep (0.1125°).
CONSTANT = (
    GRADIENT.replace('degree = 1, centre = "20 degC", scale = "20 K"', 'degree = 0, centre = "20 degC", scale = "20 K"')
    .replace('degree = 1, scale = "300 deg/s"', 'degree = 0, scale = "300 deg/s"')
    .replace('"0.5 deg/sqrt(h)"', '"2 deg/sqrt(h)"')
    .replace('"5 deg/h"', '"60 deg/h"')
    .replace('reading_noise = "1 arcsec"', 'reading_noise = "0.02 deg"\nstandstill_offset = "0.1 deg"')
)
STEPS = parse_spec(CONSTANT)
RATES = parse_spec(
    CONSTANT[: CONSTANT.index("[plan]")]
    .replace('"2 deg/sqrt(h)"', '"6 deg/sqrt(h)"')
    .replace('max_rate = "300 deg/s"', 'max_rate = "720 deg/s"')
    .replace('standing = "read"', 'standing = "read"\nrate_accuracy = "500 ppm"')
    + """[plan]
method = "standard"
temperatures = ["20 degC"]
soak = "1 s"
rates = ["60 deg/s", "120 deg/s", "180 deg/s", "240 deg/s", "360 deg/s", "540 deg/s", "720 deg/s"]
integration = "5 s"
"""
)
AT = Options(temperature_c=22.0)
RUNS = ("rate_nofilt1", "rate_nofilt2", "rate_filt1", "rate_filt2")


def scale_factor(channel):
    """What the sensor says of one degree, and its standard deviation: (1 + b00) times the truth."""
    at = channel.built.model.names().index(f"{channel.built.model.channels[0].name}.b00")
    row = channel.built.model.to_reported[at : at + 1]
    return 1.0 + float((row @ channel.solution.parameters)[0]), float(channel.solution.known.deviations(row)[0])


def steps(run, axis):
    """The log of a step run. Standstills are found in the rates; how many of the equal steps lie between two of them,
    the sensor itself says well enough."""
    with np.load(FOLDER / "rimu_jig_rate_and_steps.npz") as source:
        time = source[f"{run}_t"].astype(float)
        rate = np.radians(source[f"{run}_giro_bno_raw"].astype(float) * SCALE)
    number = find_standstills(rate, 0.01, shortest_s=2.0)
    angle, done, before = np.full(len(time), np.nan), 0, None
    for k in range(number.max() + 1):
        rows = np.flatnonzero(number == k)
        if before is not None:
            done += round(float(rate[before + 1 : rows[0] + 1, axis].sum()) * 0.01 / STEP)
        angle[rows], before = done * STEP, rows[-1]
    log = Log(
        time_s=time,
        rate_rad_per_s=rate[None],
        units=("BNO055",),
        axes=("x", "y", "z"),
        table_axes=("top",),
        table_angle_rad=angle[:, None],
        standstill=number,
    )
    return log, done


def rates(run):
    """The log of a rate run: where the smoothed rate is within 2 % of a commanded one, that is the table's."""
    with np.load(FOLDER / "rimu_jig_rate_and_steps.npz") as source:
        time = source[f"{run}_t"].astype(float)
        rate = np.radians(source[f"{run}_giro_bno_raw"].astype(float) * SCALE)
        told = np.radians(np.abs(source[f"{run}_cmd_top_speed_dps"].astype(float)))
    smooth = uniform_filter1d(rate[:, 1], 200)
    near = np.abs(smooth[:, None] / told[None] - 1.0) < 0.02
    table = np.where(near.any(axis=1), told[np.argmax(near, axis=1)], 0.0)
    return Log(
        time_s=time,
        rate_rad_per_s=rate[None],
        units=("BNO055",),
        axes=("x", "y", "z"),
        table_axes=("top",),
        table_rate_rad_per_s=table[:, None],
    )


@pytest.mark.parametrize(
    ("run", "axis", "told", "scale"), [("steps_pitch", 1, -36, 1.0006), ("steps_yaw", 2, 36, 1.0001)]
)
def test_steps_of_the_jig_give_the_scale_factor(run, axis, told, scale):
    """The published ratios of integrated to commanded angle, within error bars that the residuals bear out: the drive's
    microstep and its vibration leave about one part in a thousand, not in ten thousand."""
    log, done = steps(run, axis)
    assert done == told
    report = estimate_log(STEPS, [log], axis="xyz"[axis], options=AT)
    (channel,) = report.sensors
    value, std = scale_factor(channel)
    assert 5e-4 < std < 1.5e-3
    assert value == pytest.approx(scale, abs=2.0 * std)
    assert value == pytest.approx(1.0013, abs=1e-3)
    assert 0.7 < channel.solution.noise_scale < 1.4
    assert channel.tests.get("heating against cooling", channel.solution.test).passed
    assert sum(channel.counts.values()) == log.rows_read
    assert not log.simulated
    assert not report.calibrations[0].simulated


def test_rate_runs_agree_with_one_another():
    """1.0035 to 1.0039 of *commanded* rates; the step runs say 1.0014 ± 0.0007 of commanded angles. What parts them is
    the drive: a rate is told to it as a count of clock ticks between microsteps, which nobody measured."""
    result = [estimated(RATES, rates(run), axis="y", options=AT)[0] for run in RUNS]
    values, deviations = np.array([scale_factor(channel) for channel in result]).T
    assert np.all((values > 1.0033) & (values < 1.0041))
    assert np.all(deviations < 5e-4)
    assert np.all(np.abs(values - values.mean()) < 2.0 * deviations)
    for channel in result:
        assert np.count_nonzero(channel.solution.used) >= 7
        assert channel.solution.noise_scale < 2.0
