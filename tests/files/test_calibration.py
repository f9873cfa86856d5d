"""gradcal-calibration/1: round trips, the solve to rounding, what a broken file is told, and the contract of logs."""

import re

import jsonschema
import numpy as np
import pytest
import xarray
from calibration_samples import BINS_W, HEAD, POLYNOMIAL_T, POLYNOMIAL_W, SPLINE_T, WHOLE, axis_text
from described_logs import contents
from hypothesis import given, settings
from hypothesis import strategies as st

from gradcal_jax.files import schema
from gradcal_jax.files.calibration import (
    Calibration,
    parse_calibration,
    read_calibration,
    scale_factor_names,
    write_calibration,
)
from gradcal_jax.files.correction import apply, bias, correct, measured, scale_factor
from gradcal_jax.files.log import Log, LogError, Reason, read_log, write_log
from gradcal_jax.files.problems import SpecError
from gradcal_jax.files.quantity import Quantity
from gradcal_jax.files.writing import to_toml


def log_of(calibration, rows=500, seed=0, **more):
    """What the calibration's sensor says of known rates inside its range; the truth beside it."""
    rng = np.random.default_rng(seed)
    truth = np.radians(rng.uniform(-299, 299, (rows, 3)))
    temperature = np.linspace(-29.0, 69.0, rows)
    said = np.stack([measured(a, truth[:, k], temperature) for k, a in enumerate(calibration.axis)], axis=-1)
    log = Log(np.arange(rows) * 0.01, said[None], ("SN-7",), ("x", "y", "z"), temperature_c=temperature[None], **more)
    return log, truth


def test_a_file_comes_back_as_it_was(tmp_path):
    found = parse_calibration(WHOLE)
    write_calibration(found, tmp_path / "cal.toml")
    again = read_calibration(tmp_path / "cal.toml")
    assert again == found
    assert "SIMULATED" in (tmp_path / "cal.toml").read_text(encoding="utf-8")
    assert to_toml(again) == to_toml(found)
    jsonschema.validate(found.model_dump(mode="json", exclude_unset=True), schema("calibration"))


@pytest.mark.parametrize(
    "text",
    [WHOLE, HEAD + "".join(axis_text(n, SPLINE_T, POLYNOMIAL_W, n_t=6) for n in "xyz")],
    ids=["polynomials", "splines"],
)
def test_what_was_measured_is_solved_to_rounding(text, tmp_path):
    found = parse_calibration(text)
    log, truth = log_of(found)
    corrected = apply(found, log)
    np.testing.assert_allclose(corrected.log.rate_rad_per_s[0], truth, rtol=4e-15, atol=4e-15)
    assert corrected.outside_temperature == corrected.outside_rate == 0
    assert corrected.log.simulated  # the calibration is
    write_log(corrected.log, tmp_path / "corrected.nc")
    np.testing.assert_array_equal(read_log(tmp_path / "corrected.nc").rate_rad_per_s, corrected.log.rate_rad_per_s)


def test_the_maps_are_the_textbooks():
    found = parse_calibration(WHOLE).axis_of("y")
    t, w = np.array([-12.0, 55.0]), np.radians(np.array([-250.0, 120.0]))
    u, v = (t - 20.0) / 50.0, w / np.radians(300.0)
    b = sum(found.bias.coefficients[f"a{i}"] * u**i for i in range(4))
    m = sum(found.scale_factor.coefficients[f"b{j}{i}"] * v**j * u**i for i in range(4) for j in range(4))
    np.testing.assert_allclose(bias(found, t), b, rtol=1e-13)
    np.testing.assert_allclose(scale_factor(found, t, w), m, rtol=1e-13)
    names = scale_factor_names(found.scale_factor.temperature, found.scale_factor.rate)
    assert names[:5] == ["b00", "b10", "b20", "b30", "b01"]


def test_bins_jump_and_are_solved_within_the_jump():
    found = parse_calibration(HEAD + axis_text("x", POLYNOMIAL_T, BINS_W, n_w=2)).axis[0]
    truth = np.radians(np.linspace(-290.0, 290.0, 401))
    at = np.full_like(truth, 33.0)
    np.testing.assert_allclose(correct(found, measured(found, truth, at), at), truth, atol=1e-4)


def test_outside_its_range_the_edge_holds_and_is_counted():
    found = parse_calibration(WHOLE)
    log, _ = log_of(found, 100)
    hot = Log(log.time_s, log.rate_rad_per_s * 1.2, log.units, log.axes, temperature_c=log.temperature_c + 20.0)
    corrected = apply(found, hot)
    assert corrected.outside_temperature == 3 * np.count_nonzero(hot.temperature_c > 70.0)
    assert corrected.outside_rate > 10
    assert np.isfinite(corrected.log.rate_rad_per_s).all()


def test_masked_rows_stay_masked_and_missing_temperatures_are_bridged():
    found = parse_calibration(WHOLE)
    log, truth = log_of(found, 200)
    status = np.zeros((1, 200), np.uint16)
    status[0, 50:53] = Reason.MISSING_TEMPERATURE
    temperature = log.temperature_c.copy()
    temperature[0, 50:53] = np.nan
    holed = Log(log.time_s, log.rate_rad_per_s, log.units, log.axes, temperature_c=temperature, status=status)
    corrected = apply(found, holed).log
    np.testing.assert_allclose(corrected.rate_rad_per_s[0], truth, rtol=1e-9)
    assert corrected.counts() == {"used": 197, "missing temperature": 3}


def test_what_is_applied_lags_within_a_stretch_and_not_across_hours():
    found = parse_calibration(HEAD + axis_text("x"))
    axis = found.axis[0].model_copy(update={"thermal_lag": Quantity.read("2 min", "time")})
    found = found.model_copy(update={"axis": (axis,)})
    hour = np.arange(0.0, 3600.0, 1.0)
    behind = 120.0 / 60.0 * -np.expm1(-hour / 120.0)  # of a ramp of 1 K/min
    temperature = np.concatenate([hour / 60.0, 60.0 - hour / 60.0])
    truth = np.full_like(temperature, 0.3)
    said = measured(axis, truth, temperature + np.concatenate([-behind, behind]))
    time = np.concatenate([hour, 3.0 * 3600.0 + hour])
    starts = np.array([0, len(hour)])
    log = Log(time, said[None, :, None], ("SN-7",), ("x",), temperature_c=temperature[None], stretch_starts=starts)
    np.testing.assert_allclose(apply(found, log).log.rate_rad_per_s[0, :, 0], truth, rtol=1e-9)


def test_a_log_that_does_not_fit_is_a_sentence():
    found = parse_calibration(WHOLE)
    other = Log(np.arange(5.0), np.zeros((1, 5, 1)), ("SN-7",), ("roll",))
    with pytest.raises(LogError, match="none of the calibration's"):
        apply(found, other)
    with pytest.raises(LogError, match="no temperature"):
        apply(found, Log(np.arange(5.0), np.zeros((1, 5, 1)), ("SN-7",), ("x",)))


def test_a_map_too_steep_to_invert_is_refused():
    text = re.sub(r"^b10 = .*$", "b10 = -3.0", axis_text("x"), flags=re.M)
    steep = parse_calibration(HEAD + text).axis[0]
    with pytest.raises(ValueError, match="too steep"):
        correct(steep, np.radians(np.linspace(-300, 300, 61)), np.full(61, 70.0))


@pytest.mark.parametrize(
    ("old", "new", "sentence"),
    [
        ("gradcal-calibration/1", "gradcal-calibration/9", "this version of the program reads"),
        ('quantity = "gyro"', 'quantity = "gyros"', "quantity"),
        ("a0 = ", "a9 = ", "lacks a0"),
        ("b33 = ", "b44 = ", "lacks b33"),
        ('name = "y"', 'name = "x"', "two axes have the same name"),
        ('["-30 degC", "70 degC"]', '["70 degC", "-30 degC"]', "must be above"),
        ("simulated = true", "simulated = 1", "simulated"),
        ("serial_number", "serialnumber", 'nearest: "serial_number"'),
        ("frame = ", "[broken\nframe = ", "not valid TOML"),
    ],
)
def test_a_broken_file_is_told_what_is_wrong(old, new, sentence):
    assert old in WHOLE
    with pytest.raises(SpecError, match=re.escape(sentence)):
        parse_calibration(WHOLE.replace(old, new, 1))


def test_a_covariance_must_be_square_and_of_known_names():
    more = axis_text("x") + '[axis.covariance]\nnames = ["a0", "q"]\nmatrix = [[1.0, 0.0], [0.0]]\n'
    with pytest.raises(SpecError, match="2 rows of 2 numbers"):
        parse_calibration(HEAD + more)
    with pytest.raises(SpecError, match="does not have: q"):
        parse_calibration(HEAD + more.replace("[0.0]]", "[0.0, 1.0]]"))


@given(content=st.text(max_size=400), at=st.integers(0, len(WHOLE) - 1), length=st.integers(0, 60))
@settings(max_examples=60, deadline=None)
def test_arbitrary_texts_get_a_sentence(content, at, length):
    for text in (content, WHOLE[:at] + content + WHOLE[at + length :]):
        try:
            found = parse_calibration(text)
        except SpecError:
            continue  # a sentence
        assert isinstance(found, Calibration)


@given(content=st.binary(max_size=300), honest=st.booleans())
@settings(max_examples=60, deadline=None)
def test_arbitrary_bytes_get_a_sentence(tmp_path_factory, content, honest):
    path = tmp_path_factory.mktemp("bytes") / "cal.toml"
    path.write_bytes(WHOLE.encode() + content if honest else content)
    try:
        found = read_calibration(path)
    except SpecError:
        return
    assert found == parse_calibration(WHOLE)  # what was added was a comment, or nothing


def test_a_log_is_what_its_contract_says(tmp_path):
    found = parse_calibration(WHOLE)
    log, _ = log_of(found, 60, standstill=np.zeros(60, np.int64), host_time_s=np.arange(60.0), simulated=True)
    write_log(log, tmp_path / "log.nc")
    with xarray.open_dataset(tmp_path / "log.nc", engine="h5netcdf", decode_times=False) as opened:
        described = contents(opened)
    jsonschema.validate(described.model_dump(mode="json", exclude_none=True), schema("log"))
    assert described.rows == described.rows_read == 60
    assert described.variables.rate.units == "rad s-1"
    assert described.simulated == 1
