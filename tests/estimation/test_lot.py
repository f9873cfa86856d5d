"""`lot`: what calibrations of one type say of it, in words and as priors of a spec."""

import os
import tomllib
from pathlib import Path

import numpy as np
import pytest
from lot_scene import HOUR, MEAN, calibrations, drawn_maps, read_maps, spread_at

import gradcal_jax as gj
from gradcal_jax.calibration import UnseenError
from gradcal_jax.estimation.calibrations import lot, lot_priors
from gradcal_jax.estimation.hand_estimate import estimate_by_hand
from gradcal_jax.estimation.log_rows import Options
from gradcal_jax.information import posterior
from gradcal_jax.information.posterior import square_root
from gradcal_jax.model.imu_build import build_imu
from gradcal_jax.records.importers import import_log, parse_column_map
from gradcal_jax.spec import presets
from gradcal_jax.spec.spec import spec_of


def lot_of(kind, count=16, seed=0, change=None, noise=1.0):
    rng = np.random.default_rng(seed)
    maps = drawn_maps(rng, count, kind)
    if change is not None:
        change(maps)
    return lot(calibrations(*read_maps(rng, maps, noise)))


def only(found):
    (one,) = found.maps
    return one


def test_one_shape_repeats_and_mean_and_spread_are_within_their_intervals():
    one = only(lot_of("one"))
    x = (one.temperature_c - 20.0) / 50.0
    powers = np.stack([x**k for k in range(4)], axis=1)
    assert one.unit == "deg/h"
    assert np.all(np.abs(one.mean - powers @ MEAN) < one.mean_half)
    low, high = one.spread_interval
    true = spread_at("one", powers)
    assert np.all((low < true) & (true < high))
    assert one.shape_count == 1
    assert one.shapes.shape == (1, len(x))
    assert np.abs(one.shapes[0]) == pytest.approx(true, rel=0.6, abs=0.6)
    assert one.shares[0] > 0.95
    # (n - k - 1)(q - k) of 16 IMUs and 4 coefficients.
    assert [(test.shapes, test.degrees) for test in one.tests] == [(0, 60), (1, 42)]
    assert "one shape repeats" in one.findings[0]
    assert one.coefficients["a0"] == pytest.approx(MEAN[0] * HOUR, rel=0.2)


def test_shapes_that_do_not_repeat_are_refused_with_a_sentence():
    found = lot_of("no")
    one = only(found)
    assert one.shape_count is None
    assert one.prior is None
    assert "gyro_x bias: the shapes do not repeat (with three shapes for 16 IMUs" in "\n".join(one.findings)
    with pytest.raises(ValueError, match="no prior is written: gyro_x bias: the shapes do not repeat"):
        lot_priors(found)


def test_alike_imus_have_no_spread():
    one = only(lot_of("alike"))
    assert one.shape_count == 0
    assert np.mean(one.spread_interval[0] == 0.0) > 0.9
    assert "no spread is visible" in one.findings[0]
    assert one.prior is not None


@pytest.mark.parametrize("count", [3, 4, 5])
def test_few_imus_say_what_they_cannot_say(count):
    found = lot_of("no", count)
    assert only(found).prior is None
    assert only(found).shape_count is None
    assert "too few" in " ".join(only(found).findings)
    (note,) = found.notes
    assert note.startswith(f"{count} IMUs are too few to detect outliers")


def test_the_stated_range_of_a_spread_of_few_is_students():
    """Of 4: 95 % of χ² with 3 degrees of freedom is from 0.216 to 9.348."""
    (note,) = lot_of("one", 4).notes
    assert f"{np.sqrt(3 / 9.348):.2g} to {np.sqrt(3 / 0.2158):.2g} times the estimated spread" in note


def test_a_stranger_is_named_and_does_not_count():
    def change(maps):
        maps[5] += np.array([0.0, 30.0, -30.0, 10.0])

    one, without = only(lot_of("one", change=change)), only(lot_of("one"))
    assert [stranger.serial_number for stranger in one.strangers] == ["no. 6"]
    assert one.shape_count == 1
    assert one.mean == pytest.approx(without.mean, abs=3.0)
    assert one.spread_rms < 2.0 * without.spread_rms
    assert any("no. 6 is an outlier" in finding for finding in one.findings)


def test_a_stranger_that_keeps_shapes_from_repeating_is_found():
    def change(maps):
        maps[2] += np.array([-40.0, 30.0, 60.0, -60.0])

    one = only(lot_of("three", 20, change=change))
    assert [stranger.serial_number for stranger in one.strangers] == ["no. 3"]
    assert one.shape_count == 3


def test_groups_are_named_and_refuse_a_prior():
    def change(maps):
        maps[::3] += np.array([10.0, 25.0, -20.0, 15.0])

    one = only(lot_of("one", 24, change=change))
    assert {frozenset(group) for group in one.groups} == {
        frozenset(f"no. {k + 1}" for k in range(0, 24, 3)),
        frozenset(f"no. {k + 1}" for k in range(24) if k % 3),
    }
    assert one.prior is None
    assert any("2 groups" in finding for finding in one.findings)


def test_uncertain_calibrations_write_no_prior():
    one = only(lot_of("one", noise=80.0))
    assert one.prior is None
    assert any("too uncertain" in finding for finding in one.findings)


def test_what_no_residual_shows_does_not_average_out():
    rng = np.random.default_rng(0)
    values, covariances = read_maps(rng, drawn_maps(rng, 16, "one"))
    unseen = (UnseenError(name="of the chamber", coefficients={"gyro_x.a0": 5.0 * HOUR}),)
    plain, wide = (only(lot(calibrations(values, covariances, **extra))) for extra in ({}, {"unseen": unseen}))
    assert np.all(wide.mean_half > 5.0 * 1.95)
    assert np.all(plain.mean_half < 5.0)


def spec_with(change):
    tables = tomllib.loads(presets.text("consumer-mems"))
    del tables["sensor"]["gyro"]["bias"]["smoothness"]
    change(tables["sensor"]["gyro"])
    return spec_of(tables)


def left(spec):
    return np.array([p.std for p in gj.predict(spec).parameters], dtype=float)


def test_independent_shapes_are_the_prior_of_each_coefficient():
    """For both maps of a gyro, with the turn-on bias that is added to the bias's."""

    def shapes(gyro):
        for key, size in (("bias", 6), ("scale_factor", 9)):
            prior = gyro[key].pop("prior")
            zero = "0 deg/s" if key == "bias" else "0 ppm"
            rows = [[prior if i == j else zero for i in range(size)] for j in range(size)]
            gyro[key]["shape"] = [{"coefficients": row} for row in rows]

    assert left(spec_with(shapes)) == pytest.approx(left(spec_with(lambda _: None)), rel=1e-9)


def test_a_shape_of_another_axis_is_no_prior():
    def shapes(gyro):
        prior = gyro["bias"].pop("prior")
        rows = [[prior if i == j else "0 deg/s" for i in range(6)] for j in range(6)]
        gyro["bias"]["shape"] = [{"axis": "y", "coefficients": row} for row in rows]

    flat = left(spec_with(lambda gyro: gyro["bias"].pop("prior")))
    assert left(spec_with(shapes)) == pytest.approx(flat, rel=1e-9)
    assert np.max(flat / left(spec_with(lambda _: None))) > 1.00001


def test_the_prior_of_shapes_is_their_covariance():
    rows = np.concatenate([[[3.0, 2.0, 0.5, -0.5, -2.0, -3.0]], 0.001 * np.eye(6)])

    def shapes(gyro):
        gyro["turn_on_bias"] = "0 dps"
        del gyro["bias"]["prior"]
        gyro["bias"]["shape"] = [{"coefficients": [f"{x} dps" for x in row]} for row in rows.tolist()]

    built = build_imu(spec_with(shapes))
    own = built.model.where("gyro", 0, "bias")
    known = posterior(square_root(np.asarray(built.model.prior_rows())))
    found = known.covariance(built.model.to_reported[own])
    assert np.rad2deg(1.0) ** 2 * found == pytest.approx(rows.T @ rows, rel=1e-7, abs=1e-9)


@pytest.mark.parametrize(
    ("shapes", "sentence"),
    [
        ([["1 dps"] * 5] * 6, "expected 6 coefficients, as many as the map has"),
        ([["1 dps"] * 6] * 6, "the shapes of axis x do not span all 6 coefficients"),
    ],
)
def test_shapes_that_are_no_prior_are_refused(shapes, sentence):
    def change(gyro):
        del gyro["bias"]["prior"]
        gyro["bias"]["shape"] = [{"coefficients": row} for row in shapes]

    with pytest.raises(gj.SpecError, match=sentence):
        spec_with(change)


def test_shapes_beside_a_prior_are_refused():
    def change(gyro):
        rows = [["1 dps" if i == j else "0 dps" for i in range(6)] for j in range(6)]
        gyro["bias"]["shape"] = [{"coefficients": row} for row in rows]

    with pytest.raises(gj.SpecError, match='states the prior of the map, and so does "prior": leave one of them out'):
        spec_with(change)


def test_priors_are_a_part_of_a_spec_and_hold_the_imus_of_the_lot():
    rng = np.random.default_rng(0)
    made = calibrations(*read_maps(rng, drawn_maps(rng, 16, "one")))
    text = lot_priors(lot(made))
    assert text.startswith("# Priors for a type of IMU, from a lot of 16 calibrations, SIMULATED.")
    priors = tomllib.loads(text)
    shapes = np.array(
        [[float(c.split()[0]) for c in s["coefficients"]] for s in priors["sensor"]["gyro"]["bias"]["shape"]]
    )
    assert shapes.shape == (4, 4)
    for one in made[:3]:
        for k, shape in enumerate(priors["sensor"]["gyro"]["bias"]["shape"]):
            assert shape["axis"] == "x", k
        coefficients = np.array(list(one.values().values())) / HOUR
        assert np.linalg.norm(np.linalg.solve(shapes.T, coefficients)) < 4.0
    spec_with(lambda gyro: gyro.update(bias=priors["sensor"]["gyro"]["bias"]))


def test_errors_name_the_cure():
    rng = np.random.default_rng(0)
    made = calibrations(*read_maps(rng, drawn_maps(rng, 4, "one")))
    with pytest.raises(ValueError, match="three or more calibrations, not 2"):
        gj.lot(made[:2])
    with pytest.raises(ValueError, match=r"two calibrations are of the IMU no\. 1:"):
        gj.lot([made[0], *made])
    with pytest.raises(ValueError, match="no map has a covariance"):
        gj.lot([one.model_copy(update={"covariance": None}) for one in made])
    values, covariances = read_maps(rng, drawn_maps(rng, 4, "one"))
    other = calibrations(values[:, :3], covariances[:, :3, :3], serial_number="other")[0]
    with pytest.raises(ValueError, match=r"of no\. 1 and other have different bases"):
        gj.lot([*made, other])
    cold = made[0].channel[0].model_copy(update={"valid_temperature": (-60.0, -40.0)})
    with pytest.raises(ValueError, match="no range of temperature and rate in common"):
        gj.lot([*made[1:], made[0].model_copy(update={"channel": (cold,)})])


def test_a_calibration_that_contradicts_its_model_is_noted():
    rng = np.random.default_rng(0)
    made = calibrations(*read_maps(rng, drawn_maps(rng, 8, "one")))
    found = lot([made[0].model_copy(update={"contradicted": ("gyro_x: whiteness",)}), *made[1:]])
    assert any(note.startswith("no. 1: its data contradict its model") for note in found.notes)


def test_five_real_imus_turned_by_hand():
    """MPU-9150: biases differ from IMU to IMU far more than they are uncertain, sensitivities to g do not."""
    data = Path(os.environ.get("GRADCAL_DATA", Path(__file__).parents[3] / "shared" / "data"))
    recording = data / "mikoff_mpu9150_rotations.npz"
    if not recording.is_file():
        pytest.skip("the recorded data are not here: set GRADCAL_DATA")
    made = []
    for number in range(5):
        text = f'format = "gradcal-columns/1"\nname = "MPU {number}"\nsample_rate = "100 Hz"\n'
        for kind, first, unit in (("rate", 3, "rad/s"), ("force", 0, "m/s^2")):
            for k, axis in enumerate("xyz"):
                text += f'{kind}.{axis} = {{ column = "imu{number}", index = {first + k}, unit = "{unit}" }}\n'
        log = import_log(recording, parse_column_map(text))
        made += [one.calibration for one in estimate_by_hand(log, 9.8155, options=Options(temperature_c=23.0))]
    found = lot(made)
    maps = {(one.channel, one.term): one for one in found.maps}
    assert found.serial_numbers == tuple(f"MPU {number}" for number in range(5))
    assert not found.simulated
    assert any(note.startswith("5 IMUs are too few") for note in found.notes)
    assert all(one.prior is None and not one.strangers and not one.groups for one in found.maps)
    for channel in ("gyro_y", "gyro_z", "accelerometer_z"):
        bias = maps[channel, "bias"]
        assert bias.tests[0].chi_squared > 1e4
        assert bias.spread[0] == pytest.approx(bias.values[:, 0].std(ddof=1), rel=0.01)
        assert bias.spread_interval[0, 0] == pytest.approx(bias.spread[0] * np.sqrt(4 / 11.143), rel=0.02)
    assert all(maps["gyro_z", f"g_sensitivity_{axis}"].shape_count == 0 for axis in "xyz")
