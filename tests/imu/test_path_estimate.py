"""Estimates of units with a loop over temperature: what is said and written."""

from dataclasses import replace
from functools import lru_cache

import numpy as np
import pytest
from loop_laws import draw_with_loops
from loop_scene import WIDTHS, recorded, spec_of

from gradcal_jax.calibration.correction import apply, temperature_slope
from gradcal_jax.calibration.exports import export
from gradcal_jax.calibration.file import (
    CalibratedChannel,
    PathCoefficient,
    build_term,
    read_calibration,
    write_calibration,
)
from gradcal_jax.cli.estimate import text_of_estimate
from gradcal_jax.estimation.estimate import SensorEstimate, estimate_sensors
from gradcal_jax.hardware.simulate.imu import ImuTruth
from gradcal_jax.records.log import Log

HOUR = np.pi / 180.0 / 3600.0


@lru_cache
def estimated(*, ways: int = 2, plays: bool = True) -> tuple[SensorEstimate, ImuTruth]:
    """A unit with relays of tens of deg/h in the place of a play."""
    truth = draw_with_loops(spec_of(ways=ways, size=40.0), 36, 4)
    spec = spec_of(ways=ways, size=40.0, plays=plays)
    (report,) = estimate_sensors(spec, [recorded(truth, spec, ways=ways, seed=7)])
    return report, truth


def test_a_loop_that_the_spec_lacks_is_said():
    report, truth = estimated(plays=False)
    assert "heating against cooling" in report.calibration.contradicted
    assert np.max(np.abs(truth.triads["gyro"].loops[0].size)) / HOUR > 20.0
    assert any("the errors depend on past temperatures" in message for message in report.messages)


def test_with_plays_the_fit_is_far_better_and_the_calibration_states_them(tmp_path):
    """Not perfect: relays of tens of deg/h are no plays, and the drift is half a deg/h."""
    report, without = estimated()[0], estimated(plays=False)[0]
    assert report.solution.noise_scale < 0.5 * without.solution.noise_scale
    path = report.calibration.path
    assert [(one.channel, one.width) for one in path if one.width is not None] == [
        (f"gyro_{axis}", width) for axis in "xyz" for width in WIDTHS
    ]
    assert not any("start" in one.name for one in path)
    write_calibration(report.calibration, tmp_path / "calibration.toml")
    assert read_calibration(tmp_path / "calibration.toml").path == path
    for target in ("px4", "csv"):
        notes = " ".join(export(report.calibration, target).notes)
        assert "gyro x hysteresis 10K" in notes
    assert "gyro x hysteresis 10K" in text_of_estimate(report)


def without_a_loop() -> tuple[Log, np.ndarray, np.ndarray]:
    """The log of a unit without a loop, its temperatures, and how far a play of 10 K is behind them, stepped sample by
    sample."""
    truth = draw_with_loops(spec_of(ways=2, size=1e-6), 36, 9)
    log = recorded(truth, spec_of(ways=2), ways=2, seed=11)
    assert log.temperature_c is not None
    temperature, state = log.temperature_c[0], float(log.temperature_c[0, 0]) + 10.0
    behind = np.empty_like(temperature)
    for k, t in enumerate(temperature):
        state = max(t - 10.0, min(t + 10.0, state))
        behind[k] = state - t
    return log, temperature, behind


def test_an_exact_play_is_recovered():
    """A play of 10 K, on top of a unit without a loop."""
    spec, (log, _, behind) = spec_of(ways=2), without_a_loop()
    given = np.array([0.8, -0.3, 0.0]) * HOUR
    (report,) = estimate_sensors(
        spec, [replace(log, rate_rad_per_s=log.rate_rad_per_s + behind[None, :, None] * given)]
    )
    assert report.calibration.contradicted == ()
    found = {(one.channel, float(one.width)): one for one in report.calibration.path if one.width is not None}
    for axis, value in zip("xyz", given, strict=True):
        for width in WIDTHS:
            one = found[f"gyro_{axis}", width]
            expected = value if width == 10.0 else 0.0
            assert abs(one.value - expected) < 4.0 * one.standard_deviation, (axis, width)
            assert one.standard_deviation < 0.4 * HOUR


def test_what_follows_dt_dt_is_taken_off_exactly_and_plays_are_named():
    """Of rates that were made by the definition: `measured = ω(1 + b + d·Ṫ) + c·Ṫ`."""
    channel = CalibratedChannel(
        kind="gyro", axis="x", valid_temperature=("-60 degC", "90 degC"), valid_rate=("-300 deg/s", "300 deg/s"),  # pyright: ignore[reportArgumentType]
        term=(build_term("scale_factor", "1", ("rate x",), {"b00": 1e-3}),),
    )  # fmt: skip
    on_path = [
        {"name": "hysteresis_8K", "value": 4e-5, "unit": "rad/s/K", "width": "8 K"},
        {"name": "temperature_gradient", "value": 3e-2, "unit": "rad/K"},
        {"name": "scale_factor_temperature_gradient", "value": 2e-2, "unit": "s/K"},
    ]
    path = [PathCoefficient(channel="gyro_x", standard_deviation=1e-6, **of) for of in on_path]  # pyright: ignore[reportArgumentType]
    calibration = estimated()[0].calibration.model_copy(update={"channel": (channel,), "path": tuple(path)})
    time = np.arange(4000.0)
    temperature = 20.0 + 30.0 * np.sin(2.0 * np.pi * time / 2500.0)
    true = 2.0 * np.sin(time / 7.0)
    slope = temperature_slope(temperature, time)
    rate = true * (1.0 + 1e-3 + 2e-2 * slope) + 3e-2 * slope
    done = apply(calibration, Log(time, rate[None, :, None], ("u",), ("x",), temperature[None]))
    assert done.log.rate_rad_per_s[0, :, 0] == pytest.approx(true, rel=1e-12, abs=1e-12)
    assert done.left_in == ("gyro_x.hysteresis_8K",)
