"""A spec of one axis in the general form: its recipe, its tables, and what has no such form."""

import copy

import numpy as np
import pytest
import recorded

from gradcal_jax.formulas import reading_times
from gradcal_jax.recipe.rounding import rounded, steps_of
from gradcal_jax.recipe.tracks import tracks_of
from gradcal_jax.spec.axis_as_imu import convert, turned_axes
from gradcal_jax.spec.spec import spec_of
from gradcal_jax.tables.problems import SpecError

KEPT = recorded.read("predictions")


@pytest.mark.parametrize("name", sorted(name for name in KEPT if KEPT[name]["tables"]["rig"].get("chamber")))
def test_an_axis_has_the_same_recipe_as_an_imu(name):
    """What the chamber and the table are told."""
    tables = KEPT[name]["tables"]
    if len(turned_axes(tables)) > 1:
        pytest.skip("no table turns several axes of a sensor alone")
    told = []
    for spec in (spec_of(tables), spec_of(convert(tables)[0])):
        made = rounded(spec)
        step = steps_of(made.spec).acceleration
        chamber, blocks = tracks_of(made.spec, None if step is None else float(step))
        rows = [block.model_dump(exclude={"start", "read_every_after"}) for block in blocks]
        for row, block in zip(rows, blocks, strict=True):
            standing = block.standing_after if block.read_every_after is not None and block.standing_after else None
            row["read_at"] = standing and reading_times(float(standing), float(block.read_every_after))
            row["angles"] = [float(np.degrees(move.angle)) for move in block.moves if move.angle is not None]
            row["moves"] = [move | {"axis": "", "angle": ""} for move in row["moves"]]
        told.append((chamber, rows, made.notes))
    # The angles of an IMU's table are rounded, not those of its turns, so that errors do not add up.
    for one, other in zip(told[0][1], told[1][1], strict=True):
        assert one.pop("angles") == pytest.approx(other.pop("angles"), abs=1.001e-3)
    assert told[0] == told[1]


def test_several_axes_that_turn_alone_are_no_table():
    with pytest.raises(SpecError, match="turns sensor axes x, z as if each had a separate table"):
        spec_of(KEPT["any 0"]["tables"])


def test_the_tables_of_an_axis_stay_and_become_those_of_an_imu():
    axis = copy.deepcopy(KEPT["preset tactical-mems"]["tables"])
    axis["sensor"]["uncertain"] = {"turn_on_bias": "factor 2", "sample_clock_error": "factor 3"}
    axis["rig"]["earth_rate"] = "7.5 deg/h"
    before = copy.deepcopy(axis)
    imu = spec_of(convert(axis)[0])
    assert axis == before
    assert set(imu.sensor.uncertain_figures()) == {"sensor.gyro.turn_on_bias", "sensor.sample_clock_error"}
    # The axis points up where the Earth turns about it at that rate.
    assert np.degrees(imu.rig.site.latitude_rad) == pytest.approx(29.91, abs=0.01)
    assert imu.is_one_axis
