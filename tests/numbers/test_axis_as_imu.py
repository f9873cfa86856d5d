"""One gyro along the only axis of a table predicts what a spec of one axis does.

Every recorded prediction of an axis, converted to the general form: statistics of all requirements and the standard
deviations of all parameters. What another program recorded is compared, so that both stay right together.
"""

import copy

import numpy as np
import pytest
import recorded

from gradcal_jax.api import predict
from gradcal_jax.api.timeline import unit_timeline
from gradcal_jax.files import SpecError, spec_of
from gradcal_jax.files.axis_as_imu import axis_as_imu, turned_axes
from gradcal_jax.files.rounding import rounded, steps_of
from gradcal_jax.files.spec import spec_of
from gradcal_jax.files.tracks import tracks_of
from gradcal_jax.formulas import reading_times

KEPT = recorded.read("predictions")
# Apart by 2e-12. The program of one axis shifts the edges of bins in rate by a hundred rounding errors; and unweighted
# least squares with a nearly singular fit moves by as much where a noise figure changes in its last digit.
ROUNDED = {"tactical 1", "any 5"}
ALWAYS = {
    "static gradient 2",  # bins, turn-on bias
    "static standard 1",
    "dynamic standard 1",
    "dynamic gradient 4",  # dB/dT
    "dynamic gradient 8",
    "tactical 2",  # readings on the move, harmonics, splines, smoothness
    "tactical 3",  # unread rests
    "consumer 7",  # a slope for each cycle, other axes
    "hand 1",
    "any 1",  # three axes
    "any 5",  # unweighted least squares
    "leftover",
    "moves without rest",
    "preset paper-static-gradient",
    "preset tactical-mems",
    "experiments/designs/headline.toml",
}


def _cases() -> list:
    assert set(KEPT) >= ALWAYS
    return [pytest.param(name, id=name, marks=() if name in ALWAYS else pytest.mark.evidence) for name in sorted(KEPT)]


def _same(found: float | None, expected: float | None, tolerance: float) -> None:
    assert (found is None) == (expected is None)
    assert found is None or found == pytest.approx(expected, rel=tolerance, abs=0.0)


@pytest.mark.parametrize("name", _cases())
def test_an_axis_predicts_the_same_as_an_imu(name):
    tables, kept, tolerance = KEPT[name]["tables"], KEPT[name], 1e-9 if name in ROUNDED else 1e-12
    for axis in turned_axes(tables):
        answer = predict(spec_of(axis_as_imu(tables, axis)))
        for row, found in recorded.rows(answer).items():
            for statistic, value in kept["requirements"][row].items():
                _same(found[statistic], value, tolerance)
        found = {p.name: p.std for p in answer.parameters}
        for key, std in kept["parameters"].items():
            parameter, _, of = key.partition(" / ")
            if of == axis:
                _same(found[f"gyro_{axis}.{parameter}"], std, 10.0 * tolerance)


@pytest.mark.parametrize("name", sorted({"static gradient 2", "tactical 2", "dynamic standard 1"}))
def test_an_axis_is_judged_the_same_as_an_imu(name):
    """With all that the spec omits, at its class's typical figures, and in another run."""
    tables = KEPT[name]["tables"]
    axis, imu = predict(spec_of(tables)), predict(spec_of(axis_as_imu(tables)))
    assert sorted(t.typical for t in axis.omitted) == sorted(t.typical for t in imu.omitted)
    for one, other in zip(axis.requirements, imu.requirements, strict=True):
        assert one.verdict == other.verdict
        for field in ("with_typical", "another_run", "worst", "specific_risk"):
            _same(getattr(other, field), getattr(one, field), 1e-12)


@pytest.mark.parametrize("name", ["dynamic standard 5", "preset tactical-mems", "static gradient 3", "tactical 10"])
def test_an_axis_notices_the_same_as_an_imu(name):
    """The power of the tests for more structure of the maps."""
    tables = KEPT[name]["tables"]
    axis, imu = (predict(s, notices=True).notices for s in (spec_of(tables), spec_of(axis_as_imu(tables))))
    assert len(axis) > 0
    for one, other in zip(axis, imu, strict=True):
        assert one.model_copy(update={"sure_from": None, "power": None}) == other.model_copy(
            update={"sure_from": None, "power": None}
        )
        _same(other.sure_from, one.sure_from, 1e-9)
        _same(other.power, one.power, 1e-9)


@pytest.mark.parametrize("name", sorted(name for name in KEPT if KEPT[name]["tables"]["rig"].get("chamber")))
def test_an_axis_has_the_same_recipe_as_an_imu(name):
    """What the chamber and the table are told."""
    tables = KEPT[name]["tables"]
    if len(turned_axes(tables)) > 1:
        pytest.skip("no table turns several axes of a sensor alone")
    told = []
    for spec in (spec_of(tables), spec_of(axis_as_imu(tables))):
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


def test_a_timeline_of_an_imu_is_one_of_a_plain_cycle():
    with pytest.raises(ValueError, match="needs a plan with a cycle"):
        unit_timeline(spec_of(axis_as_imu(KEPT["tactical 3"]["tables"])))


def test_several_axes_that_turn_alone_are_no_table():
    with pytest.raises(SpecError, match="turns sensor axes x, z as if each had a table of its own"):
        axis_as_imu(KEPT["any 0"]["tables"])


def test_the_tables_of_an_axis_stay_and_become_those_of_an_imu():
    axis = copy.deepcopy(KEPT["preset tactical-mems"]["tables"])
    axis["sensor"]["uncertain"] = {"turn_on_bias": "factor 2", "sample_clock_error": "factor 3"}
    axis["rig"]["earth_rate"] = "7.5 deg/h"
    before = copy.deepcopy(axis)
    imu = spec_of(axis_as_imu(axis))
    assert axis == before
    assert set(imu.sensor.uncertain_figures()) == {"sensor.gyro.turn_on_bias", "sensor.sample_clock_error"}
    # The axis points up where the Earth turns about it at that rate.
    assert np.degrees(imu.rig.site.latitude_rad) == pytest.approx(29.91, abs=0.01)
    assert imu.is_one_axis
