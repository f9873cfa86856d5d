"""Regressors against adaptive quadrature, shape by shape and basis by basis."""

from itertools import pairwise

import numpy as np
import pytest
from helpers import (
    DEG,
    Act,
    Bins,
    BSpline,
    Polynomial,
    Scene,
    core,
    engine_of,
    panels,
    rate_at,
    reported_functions,
    sensor_temperature,
    walk,
)
from scipy.integrate import quad

from gradcal_jax.information import at_readings
from gradcal_jax.model import TEMPERATURE_GRADIENT, gyro_model, make_map
from gradcal_jax.motion import gauss_nodes

ACTS = [
    Act("cosine ramps", 45.45, 10 * DEG, ramp=3.0),
    Act("linear ramps", 6.0, -250 * DEG, ramp=3.0),
    Act("cosine ramps", 8.0, 300 * DEG, ramp=4.0),
    Act("hand", 9.0, -280 * DEG),
    Act("hand", 40.0, 60 * DEG, unevenness=0.3),
]
POLYNOMIALS = (Polynomial(3, 20.0, 50.0), Polynomial(3, 0.0, 300 * DEG))
HIGH = (Polynomial(4, 20.0, 50.0), Polynomial(7, 0.0, 300 * DEG))
SPLINES = (BSpline((-40.0, -11.0, 80.0), 3), BSpline((-6.0, -2.0, 1.0, 6.0), 2))
BINS = (Bins((-40.0, -11.0, 80.0)), Bins((-6.0, -2.0, 1.0, 6.0)))


def by_quad(scene: Scene) -> np.ndarray:
    """Each column's integral over the whole scene, by SciPy's adaptive rule between the breaks."""
    result = walk(scene)
    edges = panels(scene, result)

    def integral(f):
        return sum(quad(f, a, b, epsabs=0, epsrel=2e-14, limit=200)[0] for a, b in pairwise(edges))

    def values(basis, x):
        return reported_functions(basis, np.array(x))

    columns = []
    for i in range(scene.bias.size):
        columns.append(integral(lambda t, i=i: values(scene.bias, sensor_temperature(scene, np.array([t]))[0])[i]))
    for i in range(scene.scale[0].size):
        for j in range(scene.scale[1].size):

            def weighted(t, i=i, j=j):
                omega = rate_at(result, np.array([t]))[0]
                of_t = values(scene.scale[0], sensor_temperature(scene, np.array([t]))[0])[i]
                return of_t * values(scene.scale[1], omega)[j] * omega

            columns.append(integral(weighted))
    return np.array(columns)


def compare(scene: Scene, tolerance: float = 1e-12) -> None:
    plan, model = core(scene)
    result = engine_of(plan, model, scene.lag).columns[-1] @ np.linalg.inv(model.to_reported)
    wanted = by_quad(scene)
    # The scale of a column: the same integral of absolute values is at most its time times its largest rate.
    size = np.full_like(wanted, sum(duration for duration, _ in scene.stretches))
    size[scene.bias.size :] *= max(abs(a.peak) for a in scene.moves)
    np.testing.assert_allclose(result / size, wanted / size, rtol=0, atol=tolerance)


@pytest.mark.filterwarnings("ignore::scipy.integrate.IntegrationWarning")
@pytest.mark.parametrize("bases", [POLYNOMIALS, BINS], ids=["polynomials", "bins"])
@pytest.mark.parametrize("act", ACTS, ids=lambda a: a.shape)
def test_every_shape(act, bases):
    compare(Scene(-12.0, ((act.duration, 0.05),), (act,), bias=bases[0], scale=bases))


@pytest.mark.long
@pytest.mark.filterwarnings("ignore::scipy.integrate.IntegrationWarning")
def test_splines_high_degrees_and_a_lagging_sensor():
    curve, turn = ACTS[3], ACTS[2]
    compare(Scene(-12.0, ((9.0, 0.1),), (curve,), bias=SPLINES[0], scale=SPLINES))
    compare(Scene(-12.0, ((9.0, 0.1),), (curve,), bias=HIGH[0], scale=HIGH))
    # The chamber turns round within the move; the sensor follows with a lag shorter than the stretches.
    both = ((12.0, 0.5), (30.0, -0.4))
    compare(Scene(-12.0, both, (turn, Act("rest", 32.0)), lag=3.0, bias=POLYNOMIALS[0], scale=POLYNOMIALS))


def test_the_sensitivity_to_gradients_is_the_change_of_temperature():
    scene = Scene(0.0, ((20.0, 0.1), (30.0, -0.2)), (ACTS[2],), lag=5.0, read_every=4.0, gradient=True, bias=BINS[0])
    plan, model = core(scene)
    line = plan.trajectory(5.0)
    ends = np.asarray(line.start + line.duration)
    result = np.asarray(at_readings(line, model))[:, model.where(TEMPERATURE_GRADIENT)][:, 0]
    np.testing.assert_allclose(result, sensor_temperature(scene, ends), atol=1e-13)


def test_the_discrepancys_functions_are_the_polynomials_left_out():
    scene = Scene(-12.0, ((8.0, 0.5),), (ACTS[2],), bias=POLYNOMIALS[0], scale=POLYNOMIALS)
    line = core(scene)[0].trajectory()
    legendre = np.polynomial.legendre.legval
    bases = (Polynomial(1, 20.0, 50.0), Polynomial(2, 0.0, 300 * DEG))
    beyond = make_map(*bases, discrepancy=(1e-3, 2, 4))
    made = gyro_model(None, beyond, 1e-5)
    assert beyond.beyond.size == 1 * 5 + 2 * 2 == made.size - beyond.size
    result = made.columns(gauss_nodes(line, made))[:, made.where("scale_factor_discrepancy")].sum(0)
    pairs = [(2, j) for j in range(5)] + [(i, j) for i in range(2) for j in (3, 4)]
    time, act = walk(scene), ACTS[2]

    def weighted(t, i, j, time=time):
        omega = rate_at(time, np.array([t]))[0]
        x, y = (sensor_temperature(scene, np.array([t]))[0] - 20.0) / 50.0, omega / (300 * DEG)
        return omega * legendre(x, np.eye(3)[i]) * legendre(y, np.eye(5)[j])

    wanted = [quad(weighted, 0, act.duration, args=p, epsabs=1e-13)[0] for p in pairs]
    np.testing.assert_allclose(result, wanted, atol=1e-11)
    values = beyond.beyond.values(np.array([70.0]), np.array([300 * DEG]))
    np.testing.assert_allclose(values, 1.0, rtol=1e-13)
