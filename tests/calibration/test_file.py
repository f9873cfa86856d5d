"""The calibration file: round trips, what a broken file is told, and the contract of logs."""

import re

import jsonschema
import pytest
from calibration_samples import WHOLE as AXES
from calibration_samples import a_truth, axis, calibration_of, of
from hypothesis import given, settings
from hypothesis import strategies as st

from gradcal_jax.calibration.file import (
    Calibration,
    PathCoefficient,
    parse_calibration,
    read_calibration,
    write_calibration,
)
from gradcal_jax.tables.problems import SpecError
from gradcal_jax.tables.schemas import schema
from gradcal_jax.tables.writing import to_toml

WHOLE, IMU = to_toml(AXES), to_toml(calibration_of(a_truth()))


@pytest.mark.parametrize("text", [WHOLE, IMU], ids=["axes", "imu"])
def test_a_file_comes_back_as_it_was(text, tmp_path):
    found = parse_calibration(text)
    write_calibration(found, tmp_path / "cal.toml")
    again = read_calibration(tmp_path / "cal.toml")
    assert again == found
    assert "SIMULATED" in (tmp_path / "cal.toml").read_text(encoding="utf-8")
    assert to_toml(again) == to_toml(found)
    jsonschema.validate(found.model_dump(mode="json", exclude_unset=True), schema("calibration"))


@pytest.mark.parametrize(
    ("old", "new", "sentence"),
    [
        ("gradcal-calibration/3", "gradcal-calibration/9", "this version of the program reads"),
        ('kind = "gyro"', 'kind = "gyros"', "kind"),
        ("a0 = ", "a9 = ", "expected here the coefficient that multiplies function"),
        ("b33 = ", "b44 = ", "function 3 and 3"),
        ('axis = "y"', 'axis = "x"', "two channels have the same kind and the same axis"),
        ('["-30 degC", "70 degC"]', '["70 degC", "-30 degC"]', "must be larger than"),
        ("simulated = true", "simulated = 1", "simulated"),
        ("serial_number", "serialnumber", 'nearest: "serial_number"'),
        ("frame = ", "[broken\nframe = ", "not valid TOML"),
        ("order = ", "# order = ", "missing"),
        ('signals = ["rate x"]', 'signals = ["rat x"]', "is not a signal"),
        ("b33 = ", "# b33 = ", "one for each function of the bases"),
    ],
)
def test_a_broken_file_is_told_what_is_wrong(old, new, sentence):
    assert old in WHOLE
    with pytest.raises(SpecError, match=re.escape(sentence)):
        parse_calibration(WHOLE.replace(old, new, 1))


def test_a_covariance_must_be_square_and_of_known_names():
    more = to_toml(of(axis("x"))) + '[covariance]\nnames = ["gyro_x.a0", "gyro_x.q"]\nmatrix = [[1.0, 0.0], [0.0]]\n'
    with pytest.raises(SpecError, match="2 rows of 2 numbers"):
        parse_calibration(more)
    with pytest.raises(SpecError, match=r"no channel has: gyro_x\.q"):
        parse_calibration(more.replace("[0.0]]", "[0.0, 1.0]]"))


def test_a_coefficient_beside_the_maps_has_a_name_for_people():
    known = {"channel": "gyro_x", "value": 1e-7, "standard_deviation": 1e-7, "unit": "s"}
    labels = [PathCoefficient.model_validate(known | {"name": name}).label for name in ("hysteresis_20K", "ww_yz")]
    assert labels == ["gyro x hysteresis 20K", "gyro x bias by rate y times rate z"]


TEXTS = st.one_of(st.text(max_size=400), st.sampled_from(["", "=", "nan", "[", '"', "1e999", "\n", "é", "-"]))


@given(content=TEXTS, at=st.integers(0, len(IMU) - 1), length=st.integers(0, 60))
@settings(max_examples=60, deadline=None)
def test_arbitrary_texts_get_a_sentence(content, at, length):
    cut = [whole[: at % len(whole)] + content + whole[at % len(whole) + length :] for whole in (WHOLE, IMU)]
    for text in (content, *cut):
        try:
            found = parse_calibration(text)
        except SpecError:
            continue  # a sentence
        assert isinstance(found, Calibration)
