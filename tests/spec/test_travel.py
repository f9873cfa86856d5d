"""Plans beyond the travel of a table: every move is named, and `optimise` begins with moves that fit."""

import tomllib

import pytest

import gradcal_jax as gj
from gradcal_jax.spec.begin import PRESETS, files_of
from gradcal_jax.spec.travel import lies_in_travel, within_travel
from gradcal_jax.tables.writing import tables_to_toml


def tables(preset, travel, **more):
    document = tomllib.loads(gj.presets.text(preset))
    for axis in document["rig"]["table"]["axis"]:
        axis |= {"travel": travel, **more}
    return document


def problems_of(document, path):
    path.write_text(tables_to_toml(document), encoding="utf-8")
    with pytest.raises(gj.SpecError) as caught:
        gj.read_spec(path)
    return caught.value


def test_all_moves_that_do_not_fit_are_named_at_once(tmp_path):
    error = problems_of(tables("one-axis-table", "170 deg"), tmp_path / "a.toml")
    assert [p.key[-1] for p in error.problems] == [1, 3, 5, 7, 9, 11, 13, 15, 17, 19, 21, 23, 25, 27]
    assert lies_in_travel(error)
    assert 'takes axis "turn" 1080 deg from zero; the travel of this axis is 170 deg in each direction' in str(error)
    # Others than those of the travel are not mended.
    document = tables("one-axis-table", "170 deg")
    document["requirement"][0]["target"] = "nothing"
    assert not lies_in_travel(problems_of(document, tmp_path / "b.toml"))


@pytest.mark.parametrize("preset", ["one-axis-table", "two-axis-table", "gradient-three-axes", "rig-3arcsec"])
@pytest.mark.parametrize("travel", ["60 deg", "170 deg", "400 deg"])
def test_moves_are_made_to_fit(preset, travel):
    spec = gj.parse_spec(tables_to_toml(within_travel(tables(preset, travel))))
    for k, axis in enumerate(spec.rig.table.axis):
        turned = [s.move.angle for s in spec.schedule.every_step if s.axis == k]
        at, seen = spec.schedule.start[k], [spec.schedule.start[k]]
        for angle in turned:
            at += angle
            seen.append(at)
        assert max(map(abs, seen)) <= float(axis.travel) * (1.0 + 1e-9)
        # Nearly the whole travel is used where the plan turned farther.
        if preset == "one-axis-table" and travel != "400 deg":
            assert max(seen) - min(seen) > 1.99 * float(axis.travel)
        assert at == pytest.approx(spec.schedule.start[k], abs=1e-6)


@pytest.mark.parametrize("travel", ["60 deg", "100 deg"])
def test_a_start_beyond_the_travel_is_moved_into_it(travel):
    document = tomllib.loads(files_of(PRESETS["bmi088"])["spec.toml"])
    (axis,) = document["rig"]["table"]["axis"]
    axis["travel"] = travel
    spec = gj.parse_spec(tables_to_toml(within_travel(document)))
    assert spec.schedule.start[0] == pytest.approx(-float(spec.rig.table.axis[0].travel))
