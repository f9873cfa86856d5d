"""gradcal-sweep/1: which values the axes take, and what a wrong file is told."""

import pytest

from gradcal_jax.spec import presets
from gradcal_jax.sweeps.sweep import changes_of
from gradcal_jax.sweeps.sweep_file import parse_sweep, read_sweep
from gradcal_jax.tables.problems import SpecError
from gradcal_jax.tables.schemas import schema

HEAD = 'format = "gradcal-sweep/1"\nbase = "paper-dynamic-gradient"\n'
GRADIENT = '[[axis]]\nkey = "plan.gradient"\nstart = "0.5 K/min"\nstop = "2 K/min"\n'
RESTS = '[[axis]]\nname = "rest"\nkeys = ["plan.cycle.moves[0].rest", "plan.cycle.moves[4].rest"]\n'


def values(text):
    return parse_sweep(HEAD + text).file.axis[0].listed()


@pytest.mark.parametrize(
    ("text", "expected"),
    [
        (GRADIENT + "count = 4", ("0.5 K/min", "1 K/min", "1.5 K/min", "2 K/min")),
        (GRADIENT + 'count = 3\nspacing = "logarithmic"', ("0.5 K/min", "1 K/min", "2 K/min")),
        (RESTS + 'values = ["5 s", "1 min"]', ("5 s", "1 min")),
        ('[[axis]]\nkey = "sensor.gyro.scale_factor.rate.degree"\nstart = 1\nstop = 3\ncount = 3', (1, 2, 3)),
        ('[[axis]]\nkey = "sensor.gyro.scale_factor.temperature.centre"\nstart = "0 degC"\nstop = "20 degC"\ncount = 3',
         ("0 degC", "10 degC", "20 degC")),
    ],
)  # fmt: skip
def test_the_values_of_an_axis(text, expected):
    found = values(text)
    assert found == expected
    assert [type(value) for value in found] == [type(value) for value in expected]


def test_the_example_is_a_sweep():
    assert parse_sweep(presets.template("sweep.toml")).file.count == 15


def test_a_grid_is_every_combination_with_the_last_axis_fastest():
    job = parse_sweep(HEAD + GRADIENT + "count = 3\n" + RESTS + 'values = ["5 s", "10 s"]')
    points = changes_of(job)
    assert len(points) == 6
    assert points[1] == {
        "plan.gradient": "0.5 K/min",
        "plan.cycle.moves[0].rest": "10 s",
        "plan.cycle.moves[4].rest": "10 s",
    }
    assert points[5] == points[1] | {"plan.gradient": "2 K/min"}


@pytest.mark.parametrize(
    ("text", "said"),
    [
        (GRADIENT, '"start", "stop" and "count"'),
        (GRADIENT + "count = 1", "at least 2"),
        (GRADIENT.replace("2 K/min", "2 s") + "count = 3", "that is a time"),
        (GRADIENT.replace('"2 K/min"', "2") + "count = 3", "both be texts with a unit"),
        (GRADIENT.replace("plan.gradient", "plan.gradent") + "count = 3", 'nearest: "gradient"'),
        (RESTS.replace("[4]", "[14]") + 'values = ["5 s"]', "its list is shorter"),
        ('[[axis]]\nvalues = ["1 s"]', 'give exactly one of "key", "keys"'),
        ('[[axis]]\nkey = "plan..gradient"\nvalues = ["1 K/min"]', "is not a key"),
        (GRADIENT + "count = 3\n" + GRADIENT + "count = 3", "another axis also sets this key"),
        (GRADIENT + "count = 3\n[[axis]]\n" + 'key = "plan.soak"\nname = "gradient"\nvalues = ["1 h"]',
         'give one of them a different "name"'),
        (GRADIENT + "cuont = 3", 'nearest: "count"'),
        (GRADIENT + "count = 2000\n" + RESTS + 'start = "5 s"\nstop = "25 s"\ncount = 2000', "at most 1000000"),
        (
            '[change]\n"sensor.gyro.drift[3].standard_deviation" = "1 deg/h"\n' + GRADIENT + "count = 3",
            "its list is shorter",
        ),
    ],
)  # fmt: skip
def test_a_wrong_file_is_told_what_to_do(text, said):
    with pytest.raises(SpecError) as caught:
        parse_sweep(HEAD + text, "mine.toml")
    assert str(caught.value).startswith("mine.toml: ")
    assert said in str(caught.value)


def test_other_kinds_of_files_and_missing_bases_are_refused(tmp_path):
    with pytest.raises(SpecError, match='expected "gradcal-sweep/1"'):
        parse_sweep('format = "gradcal-spec/1"\n')
    with pytest.raises(SpecError, match="neither a preset nor a file"):
        parse_sweep(HEAD.replace("paper-dynamic", "paper-dinamic") + GRADIENT + "count = 3")
    with pytest.raises(SpecError, match="does not exist"):
        read_sweep(tmp_path / "none.toml")


def test_a_base_is_found_beside_the_file_and_changed(tmp_path):
    from gradcal_jax.spec import presets

    (tmp_path / "deep").mkdir()
    (tmp_path / "mine.toml").write_text(presets.text("paper-dynamic-gradient"), encoding="utf-8")
    text = HEAD.replace("paper-dynamic-gradient", "../mine.toml") + '[change]\n"plan.soak" = "30 min"\n'
    (tmp_path / "deep" / "sweep.toml").write_text(text + GRADIENT + "count = 3\n", encoding="utf-8")
    job = read_sweep(tmp_path / "deep" / "sweep.toml")
    assert float(job.base.plan.soak) == 1800.0
    assert job.file.count == 3


def test_the_schema_names_every_key():
    found = schema("sweep")
    assert found["$id"] == "gradcal-sweep/1"
    assert {"base", "axis", "change", "do"} <= set(found["properties"])
