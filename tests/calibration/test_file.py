"""The calibration file: round trips, what a broken file is told, and the contract of logs."""

import re

import jsonschema
import pytest
import tomlkit
from calibration_samples import HEAD, WHOLE, a_truth, axis_text, calibration_of, document
from hypothesis import given, settings
from hypothesis import strategies as st

from gradcal_jax.calibration import Calibration, parse_calibration, read_calibration, write_calibration
from gradcal_jax.tables.problems import SpecError
from gradcal_jax.tables.schemas import schema
from gradcal_jax.tables.writing import to_toml

IMU = to_toml(calibration_of(a_truth()))


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
        ("a0 = ", "a9 = ", "expected at this position the coefficient that multiplies function"),
        ("b33 = ", "b44 = ", "expected at this position the coefficient that multiplies function"),
        ('axis = "y"', 'axis = "x"', "two channels have the same kind and the same axis"),
        ('["-30 degC", "70 degC"]', '["70 degC", "-30 degC"]', "must be larger than"),
        ("simulated = true", "simulated = 1", "simulated"),
        ("serial_number", "serialnumber", 'nearest: "serial_number"'),
        ("frame = ", "[broken\nframe = ", "not valid TOML"),
    ],
)
def test_a_broken_file_is_told_what_is_wrong(old, new, sentence):
    assert old in WHOLE
    with pytest.raises(SpecError, match=re.escape(sentence)):
        parse_calibration(WHOLE.replace(old, new, 1))


@pytest.mark.parametrize(
    ("change", "said"),
    [
        (lambda d: d["channel"][0]["term"][0]["coefficients"].pop("a3"), "one for each function of the bases"),
        (lambda d: d["channel"][0]["term"][1].update(signals=["rat x"]), "is not a signal"),
        (lambda d: d["channel"].__setitem__(1, d["channel"][0]), "two channels"),
        (lambda d: d["channel"][2].update(valid_temperature=["70 degC", "-30 degC"]), "must be larger than"),
        (lambda d: d.update(covariance={"names": ["gyro_x.a9"], "matrix": [[1.0]]}), "no channel has"),
        (lambda d: d.update(channels=[]), "unknown"),
        (lambda d: d.pop("order"), "missing"),
    ],
)
def test_a_broken_file_is_a_sentence(change, said):
    broken = document(a_truth())
    change(broken)
    with pytest.raises(SpecError, match=said):
        parse_calibration(tomlkit.dumps(broken))


def test_a_covariance_must_be_square_and_of_known_names():
    more = axis_text("x") + '[covariance]\nnames = ["gyro_x.a0", "gyro_x.q"]\nmatrix = [[1.0, 0.0], [0.0]]\n'
    with pytest.raises(SpecError, match="2 rows of 2 numbers"):
        parse_calibration(HEAD + more)
    with pytest.raises(SpecError, match=r"no channel has: gyro_x\.q"):
        parse_calibration(HEAD + more.replace("[0.0]]", "[0.0, 1.0]]"))


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
