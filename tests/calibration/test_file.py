"""The calibration file: round trips, files of version 1, what a broken file is told, and the contract of logs."""

import re

import jsonschema
import numpy as np
import pytest
import tomlkit
import xarray
from calibration_samples import HEAD, WHOLE, a_truth, axis_text, calibration_of, document
from described_logs import contents
from hypothesis import given, settings
from hypothesis import strategies as st

from gradcal_jax.calibration import Calibration, is_calibration, parse_calibration, read_calibration, write_calibration
from gradcal_jax.calibration.correction import correct
from gradcal_jax.records.log import Log
from gradcal_jax.records.log_file import write_log
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


EVIDENCE = """thermal_lag = "12 s"
bias_temperature_gradient = 2e-6
contradicted = ["whiteness"]
unobservable = ["b33"]
covariance = { names = ["b00", "a1"], matrix = [[4.0, 1.0], [1.0, 9.0]] }
[[axis.unseen]]
name = "clock"
coefficients = { b00 = 1e-6 }
[[axis.fit]]
name = "whiteness"
statistic = 9.0
degrees = 1
chance = 0.003
"""


def test_what_version_1_says_of_each_axis_is_of_its_channel():
    assert is_calibration(tomlkit.parse(WHOLE))
    found = parse_calibration(HEAD + "".join(axis_text(name, more=EVIDENCE) for name in "xz"))
    assert [c.name for c in found.channel] == ["gyro_x", "gyro_z"]
    assert [t.name for t in found.channel[1].term] == ["bias", "scale_factor", "bias_temperature_gradient"]
    assert found.channel[1].term[1].signals == ("rate z",)
    assert found.channel[1].thermal_lag == 12.0
    assert found.values()["gyro_z.bias_temperature_gradient"] == 2e-6
    assert found.covariance.names == ("gyro_x.b00", "gyro_x.a1", "gyro_z.b00", "gyro_z.a1")
    expected = np.kron(np.eye(2), [[4.0, 1.0], [1.0, 9.0]])
    np.testing.assert_array_equal(found.covariance.matrix, expected)
    assert [e.coefficients for e in found.unseen] == [{"gyro_x.b00": 1e-6}, {"gyro_z.b00": 1e-6}]
    assert [t.name for t in found.fit] == ["gyro_x: whiteness", "gyro_z: whiteness"]
    assert found.unobservable == ("gyro_x: b33", "gyro_z: b33")
    assert found.contradictions_of(found.channel[0]) == ("gyro_x: whiteness",)


def test_coefficients_of_version_1_may_stand_in_any_order():
    lines = WHOLE.splitlines()
    first = next(k for k, line in enumerate(lines) if line.startswith("b00"))
    mixed = [*lines[:first], *reversed(lines[first : first + 16]), *lines[first + 16 :]]
    found = parse_calibration("\n".join(mixed))
    assert found.channel[0].term == parse_calibration(WHOLE).channel[0].term
    assert list(found.channel[0].term[1].coefficients)[:5] == ["b00", "b10", "b20", "b30", "b01"]


def test_version_1_of_an_imu_has_one_range_for_all_channels():
    today = document(a_truth())
    shared = {key: today["channel"][0][key] for key in ("valid_temperature", "valid_rate")}
    channels = [{k: v for k, v in c.items() if k not in shared} for c in today["channel"]]
    old = today | shared | {"format": "gradcal-calibration/1", "quantity": "unit", "channel": channels}
    second = today | {"format": "gradcal-calibration/2"}
    found = parse_calibration(tomlkit.dumps(old))
    assert found == parse_calibration(tomlkit.dumps(second))
    assert {c.valid_rate for c in found.channel} == {calibration_of(a_truth()).channel[0].valid_rate}


@pytest.mark.parametrize("scale", [0.003, 15.0], ids=["SI", "counts"])
def test_misalignments_of_version_2_are_divided_by_the_scale_factor(scale):
    """Version 2 added them: at the middle temperature the correction is the same, by its own formula."""
    truth = a_truth()
    truth |= {f"gyro_{a}.b00": scale for a in "xyz"} | {f"accelerometer_{a}.s0": scale for a in "xyz"}
    for name in truth:
        if name.endswith(("m_y1", "m_x1", "m_z1")) or (".b" in name and name[-3:] != "b00"):
            truth[name] = 0.0
    known = {"covariance": {"names": ["gyro_x.b00", "gyro_x.m_y0"], "matrix": [[1e-8, 2e-9], [2e-9, 4e-8]]}}
    found = parse_calibration(tomlkit.dumps(document(truth) | known | {"format": "gradcal-calibration/2"}))
    assert found.format == "gradcal-calibration/3"
    rng = np.random.default_rng(1)
    rate, force = rng.uniform(-3.0, 3.0, (2, 50, 3))
    matrix = np.array([[float(a == b) * (1.0 + scale) or truth[f"gyro_{a}.m_{b}0"] for b in "xyz"] for a in "xyz"])
    bias = np.array([truth[f"gyro_{a}.a0"] for a in "xyz"])
    felt = np.array([[truth[f"gyro_{a}.g_{b}"] for b in "xyz"] for a in "xyz"])
    gyros = [channel for channel in found.channel if channel.kind == "gyro"]
    said = dict(zip(("rate x", "rate y", "rate z"), (rate @ matrix.T + bias + force @ felt.T).T, strict=True))
    forces = dict(zip(("force x", "force y", "force z"), force.T, strict=True))
    there = correct(gyros, said | forces, np.full(50, 20.0))
    assert np.max(np.abs(np.stack([there[f"rate {a}"] for a in "xyz"], axis=1) - rate)) < 1e-12
    # A standard deviation of a misalignment is divided, too.
    assert found.covariance is not None
    by = 1.0 / (1.0 + scale)
    assert (
        np.max(np.abs(np.array(found.covariance.matrix) / [[1e-8, 2e-9 * by], [2e-9 * by, 4e-8 * by**2]] - 1)) < 1e-12
    )
    # What was read is today's form, and stays as it is.
    assert parse_calibration(to_toml(found)) == found


@pytest.mark.parametrize(
    ("old", "new", "sentence"),
    [
        ("gradcal-calibration/1", "gradcal-calibration/9", "this version of the program reads"),
        ('quantity = "gyro"', 'quantity = "gyros"', "quantity"),
        ("a0 = ", "a9 = ", "expected at this position the coefficient that multiplies function"),
        ("b33 = ", "b44 = ", "expected at this position the coefficient that multiplies function"),
        ('name = "y"', 'name = "x"', "two channels have the same kind and the same axis"),
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
    more = axis_text("x") + '[axis.covariance]\nnames = ["a0", "q"]\nmatrix = [[1.0, 0.0], [0.0]]\n'
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


def test_a_log_is_what_its_contract_says(tmp_path):
    log = Log(
        np.arange(60.0), np.ones((1, 60, 3)), ("SN-7",), ("x", "y", "z"), temperature_c=np.full((1, 60), 20.0),
        standstill=np.zeros(60, np.int64), host_time_s=np.arange(60.0), simulated=True,
    )  # fmt: skip
    write_log(log, tmp_path / "log.nc")
    with xarray.open_dataset(tmp_path / "log.nc", engine="h5netcdf", decode_times=False) as opened:
        described = contents(opened)
    jsonschema.validate(described.model_dump(mode="json", exclude_none=True), schema("log"))
    assert described.rows == described.rows_read == 60
    assert described.variables.rate.units == "rad s-1"
    assert described.simulated == 1
