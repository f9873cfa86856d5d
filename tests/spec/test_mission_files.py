"""Missions of a requirement: their tables, what is wrong with them in words, and that a spec holds them once read."""

import copy
import math

import pytest
from pydantic import ValidationError

import gradcal_jax as gj
from gradcal_jax.recipe.recipe import spec_in
from gradcal_jax.spec import presets
from gradcal_jax.spec.changes import changed, tables_of
from gradcal_jax.spec.mission import Mission
from gradcal_jax.spec.spec import read_spec, spec_of
from gradcal_jax.tables.problems import SpecError, from_validation
from gradcal_jax.tables.schemas import schema
from gradcal_jax.tables.writing import to_toml

HEAD = "time (s), rate (deg/s), temperature (degC)"
TABLE = f"# a flight\n{HEAD}\n\n0, 0, 20\n60, 30, 25.5\n"
REQUIREMENT = '[[requirement]]\nname = "flight"\nquantity = "mission_heading"\nmission = {}\n[plan]\n'


def spec_text(mission: str = '"flight.csv"', more: str = "") -> str:
    text = presets.text("tactical-mems")
    return text.replace("[plan]\n", REQUIREMENT.format(mission + more), 1)


@pytest.fixture
def folder(tmp_path):
    (tmp_path / "flight.csv").write_text(TABLE, encoding="utf-8")
    (tmp_path / "spec.toml").write_text(spec_text(), encoding="utf-8")
    return tmp_path


def rows_of(table: str):
    try:
        return Mission(file="flight.csv", table=table).rows
    except ValidationError as error:
        raise SpecError(from_validation(error)) from None


def test_a_table_is_read_in_si_from_its_first_row_on():
    rows = rows_of("temperature (degF), other, time (min), rate (rpm)\n50, x, 2, 1\n68, y, 2.5, -1e0\n")
    assert rows.time == (0.0, 30.0)
    assert rows.rate == pytest.approx((2 * math.pi / 60, -2 * math.pi / 60))
    assert rows.temperature == pytest.approx((10.0, 20.0))


@pytest.mark.parametrize(
    ("table", "said"),
    [
        ("", "a header and two or more rows"),
        ("time, rate (deg/s), temperature (degC)\n0,0,0\n1,0,0", r"'time \(s\)'"),
        ("time (s), rate (deg), temperature (degC)\n0,0,0\n1,0,0", "deg"),
        ("time (s);rate (deg/s);temperature (degC)\n0;0;0\n1;0;0", "is not understood"),
        (f"{HEAD}\n0, 0, 20\n1, nan, 20", "line 3"),
        (f"{HEAD}\n0, 0, 20\n1, 3 deg/s, 20", "line 3"),
        (f"{HEAD}\n0, 0, 20\n1, 0, -300", "line 3"),
        (f"{HEAD}\n0, 0, 20\n2, 0, 20\n1, 0, 20", "line 4: rows must be in order of time"),
    ],
)
def test_a_table_that_cannot_be_read_names_file_and_line(table, said):
    with pytest.raises(SpecError, match=said) as error:
        rows_of(table)
    assert "requirement[2]" in str(error.value) or "flight.csv" in str(error.value)


def test_a_spec_holds_its_missions_once_read(folder, tmp_path_factory, monkeypatch):
    spec = read_spec(folder / "spec.toml")
    (mission,) = spec.requirement[2].mission
    assert (mission.file, mission.table) == ("flight.csv", TABLE)
    # From another folder, without the file: tables, text and changes stand alone.
    monkeypatch.chdir(tmp_path_factory.mktemp("elsewhere"))
    assert spec_in(folder / "spec.toml").requirement == spec.requirement
    (folder / "flight.csv").unlink()
    again = gj.parse_spec(to_toml(spec))
    assert again.requirement[2].mission == spec.requirement[2].mission
    assert spec_of(copy.deepcopy(tables_of(spec))).requirement[2].rate == spec.requirement[2].rate
    with pytest.raises(SpecError, match=r"flight\.csv.*does not exist"):
        read_spec(folder / "spec.toml")


def test_the_form_of_one_and_of_several_missions(folder):
    for written in ('["flight.csv", "flight.csv"]', '[{ file = "flight.csv" }, "flight.csv"]'):
        (folder / "spec.toml").write_text(spec_text(written), encoding="utf-8")
        assert len(read_spec(folder / "spec.toml").requirement[2].mission) == 2
    assert "file" in str(schema("spec")["$defs"]["Mission"])


@pytest.mark.parametrize(
    ("mission", "more", "said"),
    [
        ('"fligth.csv"', "", 'does not exist; nearest: "flight.csv"'),
        ("[]", "", "expected at least 1 entries"),
        ("3", "", "expected a list"),
        ('"flight.csv"', '\nstatistic = "mean of max"', 'expected "rms" or "max"'),
        ('"flight.csv"', '\ntemperature = ["0 degC", "1 degC"]', "this key is unknown"),
    ],
)
def test_what_is_wrong_with_the_requirement_is_said(folder, mission, more, said):
    (folder / "spec.toml").write_text(spec_text(mission, more), encoding="utf-8")
    with pytest.raises(SpecError) as error:
        read_spec(folder / "spec.toml")
    assert said in str(error.value)
    assert "requirement[2]" in str(error.value) or "flight.csv" in str(error.value)


@pytest.mark.parametrize(
    ("row", "said"),
    [
        (
            "120, 0, 80",
            "the temperature goes from 20 degC to 80 degC, outside the range of the plan, -35 degC to 75 degC",
        ),
        ("120, 0, -36", "from -36 degC to 25.5 degC"),
    ],
)
def test_a_mission_beyond_the_plans_temperatures_is_refused(folder, row, said):
    (folder / "flight.csv").write_text(f"{TABLE}{row}\n", encoding="utf-8")
    with pytest.raises(SpecError) as error:
        read_spec(folder / "spec.toml")
    assert said in str(error.value)


def test_a_mission_beyond_a_basis_is_refused(folder):
    knots = ["-60 deg/s", "0 deg/s", "29 deg/s"]
    spec = read_spec(folder / "spec.toml")
    rate = {"knots": knots}
    with pytest.raises(SpecError, match=r"to 30 deg/s, outside the range of the rate basis, -60 deg/s to 29 deg/s"):
        changed(spec, {"sensor.gyro.scale_factor.rate": rate, "requirement[0].rate": ["-20 deg/s", "20 deg/s"]})
