"""A spec as a pure function of its figures: the numbers of `predict`, and their derivatives, under JAX's transforms."""

from pathlib import Path

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from search_problem import SPEC, coarse

import gradcal_jax as gj
from gradcal_jax.information.plan_information import plan_information
from gradcal_jax.information.prediction import predict
from gradcal_jax.model.build import build_imu
from gradcal_jax.spec.changes import changed, tables_of
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
    slower = residual.quantities["peak rates"].copy()
    slower[1] *= 0.95
    ramp = residual({"peak rates": slower})["full range"]
    angle = float(spec.plan.cycle.moves[1].turn) * 180.0 / np.pi
    made = changed(
        spec, {"plan.cycle.moves[1].turn": f"{0.95 * angle!r} deg", "plan.cycle.moves[1].peak_rate": "190 deg/s"}
    )
    assert ramp == pytest.approx(said(made), rel=1e-3)
    direction = {n: np.random.default_rng(1).standard_normal(v.shape) * v for n, v in residual.quantities.items()}
    at = lambda h: residual({n: v + h * direction[n] for n, v in residual.quantities.items()})["full range"]  # noqa: E731
    along = sum(float(np.sum(slopes[n] * direction[n])) for n in direction)
    assert along == pytest.approx((at(1e-6) - at(-1e-6)) / 2e-6, rel=1e-4)


@pytest.mark.parametrize("preset", gj.presets.names())
def test_its_value_is_the_prediction_of_every_preset(preset):
    spec = parse_spec(gj.presets.text(preset))
    residual = gj.differentiable(spec)({})
    factor = plan_information(build_imu(spec))[0].factor
    # It multiplies (RᵀR)⁻¹ out, whose rounding grows with the square of R's condition number; 3000 without an encoder.
    rounding = 4.0 * np.finfo(float).eps * np.linalg.cond(factor) ** 2
    for row in predict(spec).requirements:
        assert row.decisive is not None
        assert float(residual[row.name]) == pytest.approx(row.decisive, rel=max(1e-9, rounding)), row.name


def test_at_a_random_point_it_is_the_prediction_of_that_file():
    """Other rests, whose changes the last standing takes up."""
    spec = parse_spec(gj.presets.text("accelerometer-six-positions"))
    residual = gj.differentiable(spec)
    own = residual.quantities["move durations"]
    rests = np.flatnonzero((residual.quantities["peak rates"] == 0.0) & (own > 0.0))
    shorter = own.copy()
    shorter[rests] *= np.random.default_rng(0).uniform(0.9, 1.0, len(rests))
    moves = tables_of(spec)["plan"]["cycle"]["moves"]
    resting = [k for k, move in enumerate(moves) if "rest" in move]
    assert len(resting) == len(rests)
    keys = {f"plan.cycle.moves[{k}].rest": f"{float(shorter[at])!r} s" for k, at in zip(resting, rests, strict=True)}
    found = residual({"move durations": shorter})
    for row in predict(changed(spec, keys)).requirements:
        assert row.decisive is not None
        assert float(found[row.name]) == pytest.approx(row.decisive, rel=1e-9)


def test_many_at_once_are_one_after_the_other(residual):
    rates = residual.quantities["peak rates"] * np.linspace(0.7, 1.0, 5)[:, None]
    together = jax.jit(jax.vmap(lambda r: residual({"peak rates": r})["full range"]))(jnp.asarray(rates))
    alone = [float(residual({"peak rates": r})["full range"]) for r in rates]
    assert np.ptp(alone) > 0.01
    np.testing.assert_allclose(together, alone, rtol=1e-10)


def test_what_the_spec_has_not_is_said(spec, residual):
    with pytest.raises(ValueError, match="has no 'angle random wlak': it has angle random walk"):
        residual({"angle random wlak": 1.0})
    bins = {"sensor.gyro.scale_factor.rate": {"knots": ["-300 deg/s", "0 deg/s", "300 deg/s"], "degree": 0}}
    divided = gj.differentiable(changed(spec, bins))
    assert "peak rates" not in divided.quantities
    with pytest.raises(ValueError, match=r"'peak rates' moves the plan across the edges of bins.*polynomial"):
        divided({"peak rates": divided.own["peak rates"]})
    with pytest.raises(ValueError, match="no \\[\\[requirement\\]\\]"):
        gj.differentiable(changed(spec, {"requirement": [], "design": None}))


@pytest.fixture(scope="module")
def imu():
    """A gyro and an accelerometer triad on two axes whose gears have errors."""
    line = {"degree": 1, "centre": "20 degC", "scale": "50 K"}
    spec = gj.read_spec(Path(__file__).parents[2] / "experiments" / "imu" / "hand2.toml")
    moves = []
    for axis, angle in (("spin", 720), ("tilt", 50), ("spin", -720), ("tilt", -50)):
        moves += [{"turn": f"{angle} deg", "axis": axis, "peak_rate": "60 deg/s"}, {"rest": "25 s"}]
    maps = {f"sensor.{t}.{m}.temperature": line for t in ("gyro", "accelerometer") for m in ("bias", "scale_factor")}
    maps["sensor.gyro.scale_factor.rate"] = {"degree": 1, "scale": "300 deg/s"}
    gears = {f"rig.table.axis[{k}].angle.scale_error": "20 ppm" for k in (0, 1)}
    gears |= {f"rig.table.axis[{k}].angle.backlash": "30 arcsec" for k in (0, 1)}
    kept = coarse(spec, *(r.name for r in spec.requirement if "scale" in r.name))
    course = {"plan.temperature": ["20 degC", "30 degC"], "plan.gradient": "1 K/min"}
    return changed(
        spec, maps | gears | course | {"sensor.gyro.axes": ["x"], "plan.cycle.moves": moves, "requirement": kept}
    )


@pytest.mark.long
def test_an_imu_is_differentiated_with_its_gears(imu):
    """The gradient is the difference, in every quantity; compiled, its value is the prediction."""
    residual = gj.differentiable(imu)
    name = imu.requirement[0].name
    value, slopes = jax.jit(jax.value_and_grad(lambda q: residual(q)[name]))(residual.quantities)
    assert float(value) == pytest.approx(predict(imu).requirements[0].decisive, rel=1e-9)
    rng = np.random.default_rng(0)
    for key, own in residual.quantities.items():
        way = 1e-5 * own * rng.standard_normal(own.shape)
        more, less = (float(residual({key: own + sign * way})[name]) for sign in (1.0, -1.0))
        along = float(np.sum(slopes[key] * way))
        assert along == pytest.approx(0.5 * (more - less), rel=1e-2, abs=1e-11 * float(value)), key
