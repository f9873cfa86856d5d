"""`gradcal start`: ten answers give files that are sound, predict, and know their error budget."""

import io

import numpy as np
import pytest

import gradcal_jax as gj
from gradcal_jax.cli import main
from gradcal_jax.design.plan_objective import ExactObjective
from gradcal_jax.hardware.setup import configs_of
from gradcal_jax.records.importers import parse_column_map
from gradcal_jax.spec.absent import absent_terms
from gradcal_jax.spec.begin import PRESETS, files_of
from gradcal_jax.spec.rig import parse_rig

USUAL = PRESETS["drone-gyro"]
IMUS = ("drone-imu", "bmi088", "tactical-imu")
SENSOR = "my {}\n{}\n\n0.2 deg/sqrt(h)\n500 deg/s\n\n\n"
"""Answers on a sensor: its name, its kind, its noise and full scale."""


@pytest.fixture
def answered(tmp_path, monkeypatch, capsys):
    """`answered(text)`: the status of `gradcal start` with these answers, what it wrote and said."""

    def start(text):
        monkeypatch.setattr("sys.stdin", io.StringIO(text))
        status = main(["start", "-o", str(tmp_path / "mine")])
        return status, tmp_path / "mine", *capsys.readouterr()

    return start


def sound(texts):
    spec = gj.parse_spec(texts["spec.toml"])
    assert absent_terms(spec) == []
    assert (spec.design is not None) == spec.turns_one_gyro
    rig = parse_rig(texts["rig.toml"])
    assert rig.axis
    configs_of(rig)
    assert parse_column_map(texts["columns.toml"]).name
    return spec


def written(folder, most_lines):
    texts = {path.name: path.read_text(encoding="utf-8") for path in folder.iterdir()}
    assert len(texts["spec.toml"].splitlines()) <= most_lines
    return sound(texts)


@pytest.mark.parametrize("preset", ["drone-gyro", "tactical-gyro"])
def test_a_preset_asks_nothing_and_its_files_are_sound_and_met(preset, tmp_path, capsys):
    out = tmp_path / "mine"
    assert main(["start", "--preset", preset, "-o", str(out)]) == 0
    assert f"gradcal predict {out / 'spec.toml'}" in capsys.readouterr().out
    spec = written(out, 40)
    prediction = gj.predict(spec)
    assert [row.verdict for row in prediction.requirements] == ["met", "met"]
    assert prediction.omitted == ()
    assert not any("observ" in s or "beyond" in s for s in prediction.warnings), prediction.warnings
    assert ExactObjective(spec).name_and_unit()[0] == "gyro scale factor (mean of max)"
    # Nothing is overwritten unasked.
    assert main(["start", "--preset", preset, "-o", str(out)]) == 2
    assert "exists" in capsys.readouterr().err


def test_without_an_encoder_a_person_and_gravity_do(tmp_path, capsys):
    assert main(["start", "--preset", "no-encoder", "-o", str(tmp_path)]) == 0
    assert f"gradcal optimise {tmp_path / 'spec.toml'} --steps 0" in capsys.readouterr().out
    spec = gj.read_spec(tmp_path / "spec.toml")
    assert spec.rig.table.by_gravity
    assert [row.verdict for row in gj.predict(spec).requirements] == ["met"] * 4
    (axis,) = parse_rig((tmp_path / "rig.toml").read_text(encoding="utf-8")).axis
    assert axis.options["angle"] == "none"


@pytest.mark.parametrize("preset", IMUS)
def test_an_imu_is_started_with_a_plan_that_meets_its_limits_on_its_own_hardware(preset, tmp_path, capsys):
    out = tmp_path / "mine"
    assert main(["start", "--preset", preset, "-o", str(out)]) == 0
    said = capsys.readouterr().out
    spec = written(out, 60 if PRESETS[preset]["axes"] == "1" else 80)
    assert (len(spec.sensor.gyro.axes), len(spec.sensor.accelerometer.axes)) == (3, 3)
    prediction = gj.predict(spec)
    assert [row.verdict for row in prediction.requirements] == ["met"] * 4
    rig, answers = gj.read_rig(out / "rig.toml"), PRESETS[preset]
    assert [axis.driver for axis in rig.axis] == ["lines"] * len(spec.rig.table.axis)
    # An IMU that logs by itself has no entry; its recording is in the next commands, or cannot be used.
    assert (rig.imu == ()) == (answers["stream"] == "own")
    several = len(spec.rig.table.mounting) > 1
    assert ("--recording" in said) == (answers["stream"] == "own" and not several)
    assert ("in one mounting" in said) == (answers["stream"] == "own" and several)
    assert (rig.chamber is None) == (answers["makes"] == "none")
    reach = float(spec.rig.table.axis[0].travel)
    if reach < 3.0:  # the whole of a short travel is used
        angles = [step.move.angle for step in spec.schedule.steps]
        assert max(map(abs, angles)) > 0.99 * 2.0 * reach


def test_the_sheet_is_the_sensor_s_own(answered):
    """Its figures are in the budget and in the prior; nothing of another sensor is."""
    answers = "my imu\nimu\n\n0.3 deg/sqrt(h)\n400 deg/s\n2 deg/s, 0.02 deg/s/K, 80 ppm/K\n100 deg/h\n"
    answers += "0.05 m/s/sqrt(h), 10 mg, 0.1 mg/K\ntext\naerosmith-like\n2\n" + "\n" * 10
    status, folder, *_ = answered(answers)
    assert status == 0
    gyro = gj.read_spec(folder / "spec.toml").sensor.gyro
    assert (str(gyro.turn_on_bias), str(gyro.temperature_error.bias_slope)) == ("100 deg/h", "0.02 deg/s/K")
    constant, slope, *_ = gyro.bias.prior
    half = float(gyro.bias.temperature.scale)
    assert np.degrees(constant) == pytest.approx(2.0)
    assert np.degrees(slope) == pytest.approx(0.02 * half, rel=1e-3)


def test_without_a_table_gravity_calibrates(answered):
    status, folder, out, _ = answered(SENSOR.format("box", "imu") + "0.06 m/s/sqrt(h), 20 mg, 0.2 mg/K\nown\nnone\n")
    assert status == 0
    assert "--gravity" in out
    assert [path.name for path in folder.iterdir()] == ["columns.toml"]


def test_questions_are_asked_enter_takes_what_is_usual_and_back_goes_back(answered):
    given = "my gyro\nimu\n<\ngyro\n\n0.2 deg/sqrt(h)\n500 deg/s\n" + "\n" * 10 + "500 ppm, 50 deg/h\n"
    status, folder, asked, _ = answered(given)
    assert status == 0
    assert all(f"{n}. " in asked for n in range(1, 17))
    assert "17. " not in asked
    assert "accelerometers'" not in asked
    spec = gj.read_spec(folder / "spec.toml")
    assert spec.title.startswith("my gyro: ")
    assert (spec.sensor.gyro.axes, str(spec.requirement[0].target)) == (("x",), "500 ppm")
    assert str(spec.rig.table.axis[0].max_rate) == USUAL["rate"]


@pytest.mark.parametrize(
    ("given", "said"),
    [
        ("", "the answers ended at question 1"),
        ("x\n\nconsummer\n", "nearest: 'consumer'"),
        ("x\n\n\n\n", "expected an answer such as '0.1 deg/sqrt(h)'"),
        (SENSOR.format("x", "imu") + "\n", "expected 3 answers, separated by commas, such as '0.1 m/s/sqrt(h), "),
        (SENSOR.format("x", "gyro").replace("500", "-5"), "more than zero"),
        ('a"b\n', "without quotes"),
        (SENSOR.format("x", "gyro") + "\n" * 7 + "20 degC, 25 degC, 1 K/min\n\n", "at least 10 K"),
        (SENSOR.format("x", "gyro") + "\n\n\n\nnone" + "\n" * 9, "gradcal start --preset no-encoder"),
        (SENSOR.format("x", "imu") + "0.1 m/s/sqrt(h), 10 mg, 0.1 mg/K\n\nhand\n", "gimbal-by-hand"),
    ],
)
def test_answers_that_are_not_understood_are_sentences_and_nothing_is_written(given, said, answered):
    status, folder, _, err = answered(given)
    assert status == 2
    assert said in err
    assert not folder.exists()


@pytest.mark.parametrize("travel", ["25 deg", "400 deg"])
@pytest.mark.parametrize("preset", ["drone-imu", "tactical-imu"])
def test_the_plan_of_an_imu_fits_any_travel(preset, travel):
    assert sound(files_of({**PRESETS[preset], "travel": travel})).schedule.steps


@pytest.mark.parametrize(
    ("rate", "travel", "grade"), [("30 deg/s", "unlimited", "navigation"), ("2000 deg/s", "90 deg", "consumer")]
)
def test_files_are_sound_for_any_bench(rate, travel, grade):
    """The file's own checks hold travel, acceleration, rates and the chamber against the plan."""
    spec = sound(files_of(USUAL | {"rate": rate, "travel": travel, "grade": grade}))
    assert spec.gradient_schedule.steps


@pytest.mark.parametrize("name", [n for n in gj.presets.names() if "# [design]" in gj.presets.text(n)])
def test_presets_carry_a_design_to_uncomment(name):
    text = gj.presets.text(name)
    head, block = text.split("# [design]", 1)
    lines = ["[design]" + block.splitlines()[0], *(line.removeprefix("# ") for line in block.splitlines()[1:])]
    spec = gj.parse_spec(head + "\n".join(lines))
    assert spec.design.minimise == spec.requirement[0].name
    assert ExactObjective(spec).name_and_unit()[1] in ("ppm", "deg/h")


def test_files_that_would_be_overwritten_are_named_before_the_first_question(tmp_path, answered):
    (tmp_path / "mine").mkdir()
    (tmp_path / "mine" / "spec.toml").write_text("mine", encoding="utf-8")
    status, _, asked, err = answered("")
    assert (status, asked) == (2, "")
    assert "spec.toml exists" in err
