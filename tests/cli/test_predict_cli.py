"""`predict`, `compare` and `timeline` as a user meets them: statuses, tables, contracts and pictures."""

import contextlib
import csv
import io
import json
import re
from typing import NamedTuple

import jsonschema
import matplotlib.image
import numpy as np
import pytest

import gradcal_jax as gj
from gradcal_jax.cli import main
from gradcal_jax.tables.schemas import schema

BIAS, TURNS, STANDARD = "paper-static-gradient", "paper-dynamic-gradient", "paper-dynamic-standard"


class Answer(NamedTuple):
    """What one command line gave."""

    status: int
    out: str
    err: str


def gradcal(*arguments):
    out, err = io.StringIO(), io.StringIO()
    with contextlib.redirect_stdout(out), contextlib.redirect_stderr(err):
        status = main([str(argument) for argument in arguments])
    return Answer(status, out.getvalue(), err.getvalue())


@pytest.fixture(scope="module", autouse=True)
def _own_cache(tmp_path_factory):
    """Compiled programs of these tests stay out of the user's cache."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setenv("XDG_CACHE_HOME", str(tmp_path_factory.mktemp("cache")))
        yield


@pytest.fixture(scope="module")
def specs(tmp_path_factory):
    """Files: three of the paper's presets, one of them with a target within reach, and one plan that cannot see all."""
    folder = tmp_path_factory.mktemp("specs")
    texts = {name: gj.presets.text(name) for name in (BIAS, TURNS, STANDARD)}
    texts["reachable"] = texts[TURNS].replace('target      = "80 ppm"', 'target      = "90 ppm"')
    head, moves = texts[TURNS].split("moves = [")
    rest, slow, *_ = moves.strip().splitlines()
    texts["blind"] = f"{head}moves = [\n{rest}\n{slow}\n]\n"
    texts["wrong"] = texts[TURNS].replace("max_rate ", "max_rat ")
    for name, text in texts.items():
        (folder / f"{name}.toml").write_text(text, encoding="utf-8")
    return {name: folder / f"{name}.toml" for name in texts}


@pytest.fixture(scope="module")
def missed(specs):
    return gradcal("predict", specs[TURNS])


@pytest.fixture(scope="module")
def missed_json(specs):
    return gradcal("predict", specs[TURNS], "--json")


def checked(text, name):
    """A contract that another program could read: strict JSON, valid by its schema."""

    def never(constant):
        raise AssertionError(f"{constant} is not JSON")

    document = json.loads(text, parse_constant=never)
    for entry in document if isinstance(document, list) else [document]:
        jsonschema.validate(entry, schema(name), cls=jsonschema.Draft202012Validator)
    return document


def picture(path):
    """A PNG's pixels; a real figure has ink of more than a few colours."""
    assert path.read_bytes().startswith(b"\x89PNG\r\n\x1a\n")
    pixels = matplotlib.image.imread(path)
    assert len(np.unique(pixels.reshape(-1, pixels.shape[-1]), axis=0)) > 20
    return pixels


def test_a_missed_target_is_said_and_is_status_1(missed):
    assert (missed.status, missed.err) == (1, "")
    for words in ("2 h 40 min in all: soak 1 h, motion 1 h 40 min", "84.9", "80 ppm  missed", "reading noise 89%"):
        assert words in missed.out
    assert "nan" not in missed.out


def test_a_target_within_reach_is_met_and_is_status_0(specs):
    answer = gradcal("predict", specs["reachable"], "--json")
    assert answer.status == 0
    full, reduced = checked(answer.out, "prediction")["requirements"]
    assert (full["verdict"], full["target"]) == ("met", pytest.approx(90.0))
    assert (reduced["verdict"], reduced["target"]) == (None, None)


def test_json_says_what_the_table_says(missed, missed_json):
    assert missed_json.status == 1
    document = checked(missed_json.out, "prediction")
    assert document["format"] == "gradcal-prediction/1"
    full = document["requirements"][0]
    assert f"{full['mean_of_max']:.4g} ppm" in missed.out
    assert (full["unit"], full["temperature_c"], full["verdict"]) == ("ppm", [-30.0, 70.0], "missed")
    assert full["rate_dps"] == pytest.approx([-300.0, 300.0])
    deviations = {row["name"]: row["std"] for row in document["parameters"]}
    assert list(deviations) == [f"gyro_x.b{rate}{temperature}" for temperature in range(4) for rate in range(4)]
    np.testing.assert_allclose(np.sqrt(np.diag(document["covariance"])), list(deviations.values()), rtol=1e-12)
    assert re.search(rf"(?m)^b33 .* {deviations['gyro_x.b33'] * 1e6:.4g} +ppm", missed.out)


def test_what_cannot_be_observed_is_null_with_a_warning_and_status_1(specs):
    answer = gradcal("predict", specs["blind"], "--json")
    assert answer.status == 1
    document = checked(answer.out, "prediction")
    assert [row["mean_of_max"] for row in document["requirements"]] == [None, None]
    assert [row["verdict"] for row in document["requirements"]] == ["unobservable", "unobservable"]
    assert any("cannot observe" in warning for warning in document["warnings"])


@pytest.mark.parametrize("command", ["predict", "compare", "timeline"])
def test_a_wrong_file_is_status_2_and_names_the_key(command, specs):
    answer = gradcal(command, specs["wrong"])
    assert (answer.status, answer.out) == (2, "")
    assert "rig.table.axis[0].max_rat" in answer.err
    assert "max_rate" in answer.err
    assert gradcal(command, specs["wrong"].with_name("none.toml")).status == 2


@pytest.mark.parametrize(
    ("arguments", "words"),
    [
        (["predict", BIAS, "--plot", "DIR/figure.txt"], ".png"),
        (["predict", BIAS, "--plot", "DIR/no/figure.png"], "make it first"),
        (["predict", BIAS, "--monte-carlo", "3"], "ask for"),
        (["predict", BIAS, "--monte-carlo", "many"], "many"),
        (["check", BIAS, "--timeline", "segments", "--json", "--csv"], "use only one of them"),
        (["check", BIAS, "--csv", "--timeline", "reading"], "readings"),
        (["compare"], "SPECS"),
    ],
)
def test_slips_get_a_sentence_and_status_2(arguments, words, specs, tmp_path):
    answer = gradcal(*(specs.get(part, part.replace("DIR", str(tmp_path))) for part in arguments))
    assert answer.status == 2
    assert words in answer.err
    assert "Traceback" not in answer.out + answer.err


def test_predict_draws_a_real_picture(specs, tmp_path):
    answer = gradcal("predict", specs[BIAS], "--plot", tmp_path / "bias.png")
    assert answer.status == 0
    assert f"wrote {tmp_path / 'bias.png'}" in answer.out
    height, width, _ = picture(tmp_path / "bias.png").shape
    assert min(height, width) > 400


def test_monte_carlo_stands_beside_the_prediction(specs):
    answer = gradcal("predict", specs[BIAS], "--monte-carlo", "400", "--seed", "1")
    assert answer.status == 0, answer.out + answer.err
    assert "of 400 runs" in answer.out
    of_twins = answer.out.split("simulated  ", 1)[1].splitlines()
    row = next(line for line in of_twins if line.startswith("full range"))
    predicted, simulated = (float(word) for word in row.replace("deg/h", "").split()[2:])
    # 400 runs know a standard deviation to 1/sqrt(800), and the mean over the range better than that.
    assert simulated == pytest.approx(predicted, rel=0.12)
    again = gradcal("predict", specs[BIAS], "--monte-carlo", "400", "--seed", "1")
    assert again.out == answer.out


def test_compare_puts_plans_side_by_side(specs, tmp_path):
    answer = gradcal("predict", specs[STANDARD], specs[BIAS], "--plot", tmp_path / "both.png")
    assert (answer.status, answer.err) == (0, "")
    head, standard, reduced, gradient, wrote = answer.out.splitlines()
    assert head.split() == ["plan", "in", "all", "soak", "motion", "requirement", "residual", "(1σ)", "limited", "by"]
    assert standard.startswith(f"{STANDARD}  9 h ")
    assert "rate accuracy" in standard
    assert reduced.strip().startswith("reduced range (mean of max)")
    assert gradient.startswith(f"{BIAS} ")
    assert "0.4016 deg/h" in gradient
    assert wrote.startswith("wrote ")
    picture(tmp_path / "both.png")


def test_compare_as_json_is_one_prediction_each(specs):
    answer = gradcal("predict", specs[STANDARD], specs[BIAS], "--json")
    assert answer.status == 0
    standard, gradient = checked(answer.out, "prediction")
    assert standard["duration_s"] == pytest.approx(9 * 3600.0)
    assert gradient["duration_s"] == pytest.approx(160 * 60.0)
    assert standard["requirements"][0]["limited_by"].startswith("rate accuracy")


@pytest.mark.parametrize("name", [TURNS, STANDARD])
def test_the_timeline_is_valid_and_its_csv_has_every_row(name, specs):
    document = checked(gradcal("check", specs[name], "--timeline", "segments", "--json").out, "timeline")
    for rows in ("segments", "readings"):
        answer = gradcal("check", specs[name], "--csv", "--timeline", rows)
        assert answer.status == 0
        written = list(csv.DictReader(io.StringIO(answer.out)))
        assert len(written) == len(document[rows])
        for field in ("start", "time", "peak_rate"):
            if field in written[0]:
                said = [str(row[field]) for row in document[rows]]
                assert [row[field] for row in written] == said
    ends = [segment["start"] + segment["duration"] for segment in document["segments"]]
    np.testing.assert_allclose([segment["start"] for segment in document["segments"][1:]], ends[:-1], atol=1e-6)
    times = [reading["time"] for reading in document["readings"]]
    assert times == sorted(times)
    assert times[-1] <= ends[-1] + 1e-6


def test_the_timeline_of_the_gradient_plan_turns_and_warms_as_the_spec_says(specs):
    document = json.loads(gradcal("check", specs[TURNS], "--timeline", "segments", "--json").out)
    turns = [segment for segment in document["segments"] if segment["shape"] == "cosine ramps"]
    assert len(turns) == 17 * 6
    np.testing.assert_allclose([abs(turn["angle"]) for turn in turns], 2.0 * np.pi, rtol=1e-3)
    assert sum(turn["angle"] for turn in turns) == pytest.approx(0.0, abs=1e-9)
    first, last = document["segments"][0], document["segments"][-1]
    assert first["temperature_start"] == pytest.approx(-30.0)
    assert last["temperature_end"] == pytest.approx(70.0)
    assert document["table"][0]["reading_noise"] == pytest.approx(np.radians(0.05), rel=1e-12)


def test_the_timeline_as_a_table_is_short_and_says_what_it_leaves_out(specs):
    segments = gradcal("check", specs[TURNS], "--timeline", "segments")
    readings = gradcal("check", specs[TURNS], "--timeline", "readings")
    assert segments.status == readings.status == 0
    assert "cosine ramps" in segments.out
    assert "+360" in segments.out
    assert "and" in readings.out.splitlines()[-2]
    assert len(readings.out.splitlines()) < 70
    assert segments.out.splitlines()[-1] == readings.out.splitlines()[-1]
