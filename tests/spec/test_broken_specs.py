"""The corpus of broken specs: each file's first line says which keys must be named, and nothing else may be."""

from pathlib import Path

import pytest

from gradcal_jax.cli import main
from gradcal_jax.spec import spec as spec_file
from gradcal_jax.tables.problems import SpecError

BROKEN = sorted((Path(__file__).parent / "broken").glob("*.toml"))


def expected(path):
    first = path.read_text(encoding="utf-8").splitlines()[0]
    assert first.startswith("# expect:")
    return {key.strip() for key in first.removeprefix("# expect:").split(",")}


def test_the_corpus_is_there():
    assert len(BROKEN) > 90


@pytest.mark.parametrize("path", BROKEN, ids=lambda path: path.stem)
def test_every_fault_is_named_by_its_key_and_nothing_else_is(path):
    with pytest.raises(SpecError) as caught:
        spec_file.read_spec(path)
    assert {problem.dotted for problem in caught.value.problems} == expected(path)
    for problem in caught.value.problems:
        assert len(problem.message) > 10


@pytest.mark.parametrize("path", BROKEN[::30], ids=lambda path: path.stem)
def test_the_command_line_says_them_with_status_2(path, capsys):
    assert main(["check", str(path)]) == 2
    out, err = capsys.readouterr()
    assert out == ""
    for key in expected(path):
        assert key in err
    assert "Traceback" not in err


WHY = {
    "rig_max_rate_misspelt": 'nearest: "max_rate"',
    "requirement_statistic_misspelt": 'nearest: "mean of max"',
    "programme_item_unknown": 'nearest: "ramp_to"',
    "design_minimises_nothing_known": 'nearest: "full"',
    "design_frees_unknown": 'nearest: "cycle"',
    "basis_centre_in_kelvin": "degC",
    "rig_max_rate_too_low": 'max_rate of axis "x", 90 deg/s',
    "plan_gradient_too_steep": "rig.chamber.max_heating, 2 K/min",
    "standard_soak_too_short": "25 min",
    "move_contradictory": "3.6 s",
    "rig_travel_wound_up": "in cycle",
    "section_unknown": 'nearest: "sensor"',
    "syntax_bare_value": "line",
    "format_from_the_future": "gradcal-spec/1",
}


@pytest.mark.parametrize(("stem", "words"), WHY.items())
def test_messages_say_what_was_expected(stem, words):
    with pytest.raises(SpecError) as caught:
        spec_file.read_spec(Path(__file__).parent / "broken" / f"{stem}.toml")
    assert words in str(caught.value)
