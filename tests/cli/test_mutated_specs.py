"""Random slips in good specs: `check` answers 0 or 2, names the key, and never shows a traceback."""

import copy
import tomllib

import tomlkit
from hypothesis import HealthCheck, example, given, settings
from hypothesis import strategies as st

from gradcal_jax.cli import main
from gradcal_jax.spec import presets
from gradcal_jax.tables.problems import dotted

GOOD = {name: tomllib.loads(presets.text(name)) for name in presets.names()}


def leaves(value, key=()):
    """Every key of a document, tables and lists included."""
    found = [key] if key else []
    if isinstance(value, dict):
        for name, entry in value.items():
            found += leaves(entry, (*key, name))
    elif isinstance(value, list):
        for i, entry in enumerate(value):
            found += leaves(entry, (*key, i))
    return found


KEYS = {name: leaves(document) for name, document in GOOD.items()}
junk = st.one_of(
    st.text(max_size=12),
    st.integers(-(10**30), 10**30),
    st.floats(),
    st.booleans(),
    st.just([]),
    st.just({}),
    st.lists(st.text(max_size=4), max_size=3),
    st.dictionaries(st.text(min_size=1, max_size=4), st.integers(-9, 9), max_size=2),
    st.sampled_from(["nan deg", "-1 deg", "0 s", "1e300 s", "1e-300 deg", "1 K", "5 min", "-5 degC", "1 deg/s", "∞"]),
)
slips = st.one_of(
    st.just(("delete", "")),
    st.tuples(st.just("misspell"), st.text("abcdefghijklmnopqrstuvwxyz_", min_size=1, max_size=3)),
    st.tuples(st.just("set"), junk),
)


def at(document, key):
    for part in key:
        document = document[part]
    return document


def slip_into(document, key, kind, detail):
    """Make one slip; returns the key that a message must name if the slip is a fault for certain, else None."""
    parent, last = at(document, key[:-1]), key[-1]
    if kind == "set":
        parent[last] = copy.deepcopy(detail)
    elif kind == "delete" or not isinstance(last, str) or last + detail in parent:
        del parent[last]
    else:
        parent[last + detail] = parent.pop(last)
        return (*key[:-1], last + detail)
    return None


@settings(max_examples=60, deadline=None, suppress_health_check=[HealthCheck.function_scoped_fixture])
@given(st.sampled_from(sorted(GOOD)), st.integers(0, 10_000), slips)
@example("ferraris", 0, ("misspell", "_"))
def test_slips_are_named_or_harmless_and_never_a_traceback(tmp_path, capsys, name, place, slip):
    document = copy.deepcopy(GOOD[name])
    certain = slip_into(document, KEYS[name][place % len(KEYS[name])], *slip)
    path = tmp_path / "slip.toml"
    path.write_text(tomlkit.dumps(document), encoding="utf-8", errors="replace")
    status = main(["check", "--files-only", str(path)])
    out, err = capsys.readouterr()
    assert status in (0, 2)
    assert "Traceback" not in out + err
    if status == 0:
        assert err == ""
        assert "the spec has no errors" in out
    else:
        assert out == ""
        assert str(path) in err
    if certain is not None:
        assert status == 2
        assert dotted(certain) in err
