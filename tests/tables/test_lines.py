"""Faults of a file say on which line they stand."""

import re
import tomllib
from pathlib import Path

import pytest
import tomlkit
from hypothesis import given
from hypothesis import strategies as st

import gradcal_jax as gj
from gradcal_jax.tables.document import lines_of

FILES = [
    *Path(gj.presets.__file__).parent.glob("*.toml"),
    *sorted((Path(__file__).parents[1] / "spec" / "broken").glob("*.toml")),
]


def leaves(value, key=()):
    if isinstance(value, dict):
        for name, entry in value.items():
            yield (*key, name)
            yield from leaves(entry, (*key, name))
    elif isinstance(value, list):
        for number, entry in enumerate(value):
            yield (*key, number)
            yield from leaves(entry, (*key, number))


@pytest.mark.parametrize("path", FILES, ids=lambda path: path.stem)
def test_every_key_of_a_real_file_is_on_its_line(path):
    text = path.read_text(encoding="utf-8")
    try:
        document = tomllib.loads(text)
    except tomllib.TOMLDecodeError:
        return
    known, lines = lines_of(text), text.splitlines()
    for key in leaves(document):
        assert key in known, key
        name = next(part for part in reversed(key) if isinstance(part, str))
        if isinstance(key[-1], str):
            assert name in lines[known[key] - 1], key


NAMES = st.text("abc-_1 .é\"'", min_size=1, max_size=4)
VALUES = st.recursive(
    st.one_of(st.integers(-5, 5), st.booleans(), st.text("a#[]{}=,\"'\\\n é", max_size=6), st.floats(-1, 1)),
    lambda inner: st.one_of(st.lists(inner, max_size=3), st.dictionaries(NAMES, inner, max_size=3)),
    max_leaves=12,
)


@given(st.dictionaries(NAMES, VALUES, max_size=4))
def test_any_toml_is_followed_to_its_end(document):
    text = tomlkit.dumps(document)
    read = tomllib.loads(text)
    known = lines_of(text)
    assert set(leaves(read)) <= set(known)
    assert all(1 <= line <= text.count("\n") + 1 for line in known.values())


def test_an_error_names_the_line_of_its_key_and_of_the_table_that_lacks_one():
    text = gj.presets.text("tactical-mems").replace('"20 ppm"', '"20 pm"', 1).replace("max_rate ", "max_rat ")
    with pytest.raises(gj.SpecError) as caught:
        gj.parse_spec(text, "my.toml")
    lines = text.splitlines()
    said = {problem.dotted: problem.line for problem in caught.value.problems}
    assert '"20 pm"' in lines[said["sensor.sample_clock_error"] - 1]
    assert "max_rat " in lines[said["rig.table.axis[0].max_rat"] - 1]
    assert f"(line {said['rig.table.axis[0].max_rat']})" in str(caught.value)
    missing = [p for p in caught.value.problems if p.dotted == "rig.table.axis[0].max_rate"]
    assert all(re.match(r"\[\[rig\.table\.axis\]\]", lines[p.line - 1]) for p in missing)


def test_a_moves_line_in_a_list_is_its_own():
    text = gj.presets.text("tactical-mems").replace(
        '{ turns = -3, peak_rate = "200 deg/s"', '{ turns = -3, peak_rate = "900 deg/s"'
    )
    with pytest.raises(gj.SpecError) as caught:
        gj.parse_spec(text)
    (problem,) = caught.value.problems
    assert "900 deg/s" in text.splitlines()[problem.line - 1]


@pytest.mark.parametrize("text", ["a = ", "[", "a = 'x", "\x00", "[[[", "a = [1,", '"'])
def test_what_is_no_toml_is_a_sentence(text):
    with pytest.raises(gj.SpecError, match="not valid TOML"):
        gj.parse_spec(text)
