"""A log from arrays or a DataFrame is the one that a recording's import gives."""

import numpy as np
import pytest

import gradcal_jax as gj
from gradcal_jax.records.log import LogError

TIME = np.arange(2000) / 50.0
RATES = np.random.default_rng(0).standard_normal((2000, 3)) * 0.3  # deg/s
WARM = 20.0 + TIME / 60.0
ANGLE = 10.0 * np.sin(TIME)
MAP = """\
format = "gradcal-columns/1"
time = { column = "t", unit = "s" }
temperature = { column = "temp", unit = "degC" }
[rate]
x = { column = "gx", unit = "deg/s" }
y = { column = "gy", unit = "deg/s" }
z = { column = "gz", unit = "deg/s" }
[table_angle]
inner = { column = "angle", unit = "deg" }
"""
NAMES = {"t": TIME, "gx": RATES[:, 0], "gy": RATES[:, 1], "gz": RATES[:, 2], "temp": WARM, "angle": ANGLE}


@pytest.fixture(scope="module")
def imported(tmp_path_factory):
    path = tmp_path_factory.mktemp("log") / "log.npz"
    np.savez(path, **NAMES)
    return gj.import_log(path, MAP)


def same(log, imported):
    assert (log.axes, log.table_axes) == (imported.axes, imported.table_axes)
    for name in ("time_s", "rate_rad_per_s", "temperature_c", "table_angle_rad"):
        np.testing.assert_allclose(getattr(log, name), getattr(imported, name), rtol=1e-12, atol=1e-15)


def test_columns_of_a_data_frame_with_units(imported):
    pandas = pytest.importorskip("pandas")
    frame = pandas.DataFrame(NAMES)
    log = gj.log_from(
        frame.t, frame[["gx", "gy", "gz"]], temperature=frame.temp, angle={"inner": frame.angle},
        units={"rate": "deg/s", "angle": "deg"},
    )  # fmt: skip
    same(log, imported)
    stamps = pandas.to_datetime(1.7e9 + TIME, unit="s")
    stamped = gj.log_from(stamps, frame.gx, units={"rate": "deg/s"})
    np.testing.assert_allclose(stamped.time_s, TIME, atol=1e-6)


@pytest.mark.parametrize(
    ("arguments", "said"),
    [
        ((TIME, RATES[:100]), "the shape"),
        ((TIME, np.zeros((2000, 4))), "expected"),
        (([], np.zeros((0, 3))), "time has no values"),
        ((TIME, 1j * RATES), "rate has no numbers"),
        ((TIME, RATES.astype(str)), "rate has no numbers"),
        ((TIME, RATES, {"standstill": np.ones(9)}), "standstill has the shape"),
        ((TIME, RATES, {"standstill": True}), "standstill has the shape"),
        ((TIME, RATES, {"standstill": np.full(len(TIME), None)}), "standstill has no numbers"),
        ((TIME, RATES, {"sensor": ""}), "sensor: '' is no name"),
        ((TIME, RATES, {"simulated": "yes"}), "simulated: 'yes' is not True or False"),
        ((TIME, RATES, {"angle": {"": TIME}}), "angle has an axis without a name"),
    ],
)
def test_what_does_not_fit_is_a_sentence(arguments, said):
    time, rates, *options = arguments
    with pytest.raises(LogError, match=said):
        gj.log_from(time, rates, **dict(*options))
    with pytest.raises(LogError, match="nearest: 'rate'"):
        gj.log_from(TIME, RATES, units={"rates": "deg/s"})


def test_the_allan_deviation_of_an_array_is_that_of_its_log():
    rate = 1e-4 * np.random.default_rng(1).standard_normal(50_000)
    deviation, fit = gj.allan(rate, rate=100.0)
    of_log, _ = gj.allan(gj.log_from(np.arange(50_000) / 100.0, rate))
    np.testing.assert_allclose(deviation.deviation, of_log.deviation, rtol=1e-12)
    # White noise of 1e-4 rad/s at 100 Hz.
    assert fit.angle_random_walk.value == pytest.approx(1e-5, rel=0.05)
    with pytest.raises(ValueError, match="samples per second"):
        gj.allan(rate)
