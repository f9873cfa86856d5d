"""A spec as a pure function of its figures: the numbers of `predict`, and their derivatives, under JAX's transforms."""

from pathlib import Path

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from search_problem import SPEC

import gradcal_jax as gj
from gradcal_jax.information.prediction import predict
from gradcal_jax.spec.changes import changed
from gradcal_jax.spec.spec import parse_spec

# Everything that has a figure of its own: walk, lag, offset, clock.
MORE = {
    "sensor.gyro.rate_random_walk": "2 deg/h/sqrt(h)",
    "sensor.thermal_lag": "90 s",
    "sensor.sample_clock_error": "20 ppm",
    "sensor.clock": "sensor",
    "rig.table.axis[0].angle.standstill_offset": "20 arcsec",
    "rig.table.axis[0].angle.timing_error": "1 ms",
}


@pytest.fixture(scope="module")
def spec():
    return changed(parse_spec(SPEC), MORE)


@pytest.fixture(scope="module")
def residual(spec):
    return gj.differentiable(spec)


@pytest.fixture(scope="module")
def slopes(residual):
    return jax.jit(jax.grad(lambda q: residual(q)["full range"]))(residual.quantities)


def said(spec) -> float:
    (row,) = predict(spec).requirements
    assert row.mean_of_max is not None
    return row.mean_of_max


def test_its_value_is_what_predict_says_and_jit_changes_nothing(spec, residual):
    assert residual({})["full range"] == pytest.approx(said(spec), rel=1e-13)
    compiled = jax.jit(lambda q: residual(q)["full range"])(residual.quantities)
    assert float(compiled) == pytest.approx(said(spec), rel=1e-11)


@pytest.mark.parametrize(
    ("name", "key", "nominal", "unit"),
    [
        ("angle random walk", "sensor.gyro.angle_random_walk", 0.1, "deg/sqrt(h)"),
        ("bias instability", "sensor.gyro.drift[0].standard_deviation", 1.0, "deg/h"),
        ("rate random walk", "sensor.gyro.rate_random_walk", 2.0, "deg/h/sqrt(h)"),
        ("thermal lag", "sensor.thermal_lag", 90.0, "s"),
        ("sample clock", "sensor.sample_clock_error", 20.0, "ppm"),
        ("standstill offset", "rig.table.axis[0].angle.standstill_offset", 20.0, "arcsec"),
        ("timing error", "rig.table.axis[0].angle.timing_error", 1.0, "ms"),
    ],
)
def test_slopes_are_differences_of_predictions_of_changed_files(spec, residual, slopes, name, key, nominal, unit):
    step = 1e-3
    more, less = (said(changed(spec, {key: f"{nominal * (1 + s)!r} {unit}"})) for s in (step, -step))
    elasticity = float(np.sum(slopes[name] * residual.quantities[name]))
    assert elasticity == pytest.approx((more - less) / (2 * step), rel=1e-4, abs=1e-7)


def test_a_plan_is_moved_as_its_file_would(spec, residual, slopes):
    """The second move's rate; and the ramp, whose time the file derives from its gradient."""
    moves = [
        {"rest": "10 s", "read_every": "5 s"},
        {"duration": "50 s", "peak_rate": "190 deg/s", "shape": "cosine ramps"},
    ]
    moves += [moves[0], {"duration": "50 s", "peak_rate": "-150 deg/s", "shape": "cosine ramps"}]
    slower = residual.quantities["peak rates"].copy()
    slower[1] *= 0.95
    ramp = residual({"peak rates": slower})["full range"]
    made = changed(spec, {"plan.cycle.moves": moves})
    assert ramp == pytest.approx(said(made), rel=1e-3)
    direction = {n: np.random.default_rng(1).standard_normal(v.shape) * v for n, v in residual.quantities.items()}
    at = lambda h: residual({n: v + h * direction[n] for n, v in residual.quantities.items()})["full range"]  # noqa: E731
    along = sum(float(np.sum(slopes[n] * direction[n])) for n in direction)
    assert along == pytest.approx((at(1e-6) - at(-1e-6)) / 2e-6, rel=1e-4)


def test_a_plan_without_turns_is_a_function_of_the_chambers_course():
    spec = parse_spec(gj.presets.text("paper-static-gradient"))
    (row,) = predict(spec).requirements
    assert gj.differentiable(spec)({})[row.name] == pytest.approx(row.decisive, rel=1e-13)


def test_many_at_once_are_one_after_the_other(residual):
    rates = residual.quantities["peak rates"] * np.linspace(0.7, 1.0, 5)[:, None]
    together = jax.jit(jax.vmap(lambda r: residual({"peak rates": r})["full range"]))(jnp.asarray(rates))
    alone = [float(residual({"peak rates": r})["full range"]) for r in rates]
    assert np.ptp(alone) > 0.01
    np.testing.assert_allclose(together, alone, rtol=1e-10)


def test_what_the_spec_has_not_is_said(spec, residual):
    with pytest.raises(ValueError, match="has no 'angle random wlak': it has angle random walk"):
        residual({"angle random wlak": 1.0})
    with pytest.raises(ValueError, match="no \\[\\[requirement\\]\\]"):
        gj.differentiable(changed(spec, {"requirement": [], "design": None}))


TURNS = [("spin", 720), ("spin", -700), ("tilt", 50), ("spin", 40), ("tilt", 450), ("tilt", -500), ("spin", 300)]


def imu_moves(turns) -> list[dict[str, str]]:
    """Steepest trapezoids, and rests."""
    moves = []
    for (axis, _), degrees, rate in zip(TURNS, turns, (100, 250, 60, 80, 200, 150, 40), strict=True):
        duration = abs(degrees) / rate + rate / 400.0
        ramped = {"peak_rate": f"{rate} deg/s", "duration": f"{duration:.12g} s", "shape": "linear ramps"}
        moves += [{"turn": f"{degrees:.12g} deg", "axis": axis} | ramped, {"rest": "25 s"}]
    return moves


@pytest.fixture(scope="module")
def imu():
    """A gyro and an accelerometer triad on two axes."""
    line = {"basis": "polynomial", "degree": 1, "centre": "20 degC", "scale": "50 K"}
    spec = gj.read_spec(Path(__file__).parents[2] / "experiments" / "imu" / "hand2.toml")
    moves = imu_moves([t for _, t in TURNS])
    maps = {f"sensor.{t}.{m}.temperature": line for t in ("gyro", "accelerometer") for m in ("bias", "scale_factor")}
    maps["sensor.gyro.scale_factor.rate"] = {"basis": "polynomial", "degree": 1, "scale": "300 deg/s"}
    kept = [
        r.model_dump(mode="json", exclude_unset=True) | {"grid": [21] * len(r.grid)}
        for r in spec.requirement
        if "scale" in r.name
    ]
    return changed(spec, maps | {"sensor.gyro.axes": ["x"], "plan.cycle.moves": moves, "requirement": kept})


@pytest.mark.long
def test_an_imu_is_a_function_of_its_cycle(imu):
    """Its value is what `predict` says, also of other numbers, its gradient the difference, and `vmap` changes
    nothing."""
    residual = gj.differentiable(imu)
    rng, own = np.random.default_rng(0), residual.quantities
    turns = own["turns"] + np.array([0.3, -0.2, 0.1, 0.1, 0.2, -0.3, -0.2])  # of each axis the same in all
    moves = imu_moves(np.degrees(turns))
    assert own["turns"].shape == own["peak rates"].shape == own["rests"].shape == (len(TURNS),)
    call = jax.jit(lambda q: residual(q))
    for numbers, spec in ((own, imu), ({**own, "turns": turns}, changed(imu, {"plan.cycle.moves": moves}))):
        found, expected = call(numbers), {r.name: r.decisive for r in predict(spec).requirements}
        assert found.keys() == expected.keys()
        for name, value in expected.items():
            assert float(found[name]) == pytest.approx(value, rel=1e-2)
    name = "gyro scale factor"
    together = jax.jit(jax.vmap(jax.value_and_grad(lambda q: residual(q)[name])))
    many = {key: value * (1.0 + 0.05 * rng.standard_normal((3, len(TURNS)))) for key, value in own.items()}
    values, slopes = together(many)
    for k in range(3):
        one = {key: value[k] for key, value in many.items()}
        assert float(values[k]) == pytest.approx(float(call(one)[name]), rel=1e-9)
    for key, step in (("turns", 1e-3), ("peak rates", 1e-4), ("rests", 1e-2)):
        moved = [{**one, key: one[key] + sign * step * np.eye(len(TURNS))[2]} for sign in (1.0, -1.0)]
        difference = np.subtract(*(float(call(q)[name]) for q in moved)) / (2.0 * step)
        assert float(slopes[key][2, 2]) == pytest.approx(difference, rel=1e-4, abs=1e-7)
    with pytest.raises(ValueError, match="has no 'rest': it has turns"):
        residual({"rest": 1.0})
