"""One step's F and Q against the covariance equation solved by brute force, and the series for cancellations."""

from decimal import Decimal, getcontext
from itertools import pairwise

import jax.numpy as jnp
import numpy as np
import pytest
from helpers import DEG, Act, Noise, Polynomial, Scene, core, engine_of, textbook_rate
from scipy.integrate import solve_ivp

from gradcal_jax.information import noise_steps
from gradcal_jax.information.noise_steps import _chi, _phi1

NOISES = (
    Noise("drift", 2.0, 30.0),
    Noise("drift", 5.0, 0.7),
    Noise("drift", 1.0, 1e9),
    Noise("walk", 0.3),
    Noise("constant", 2.0, bias_gain=0.5, rate_gain=2.0),
    Noise("scale", 3.0, 12.0, 0.0, 1.0),
    Noise("both", 1.5, 40.0, 0.7, -1.3),
)
ACTS = [
    Act("rest", 7.0, every=7.0),
    Act("cosine ramps", 6.0, 3.0, ramp=2.0),
    Act("linear ramps", 6.0, -3.0, ramp=3.0),
    Act("hand", 12.0, 2.0, unevenness=0.3),
]


def system(noise: Noise):
    """(decay, diffusion², gains) of a process, from its kind's definition."""
    if noise.kind == "walk":
        return 0.0, noise.size**2, (1.0, 0.0)
    gains = (noise.bias_gain, noise.rate_gain)
    if noise.kind == "constant":
        return 0.0, 0.0, gains
    return 1.0 / noise.tau, 2.0 * noise.size**2 / noise.tau, gains


@pytest.mark.parametrize("act", ACTS, ids=lambda a: a.shape)
def test_one_move_against_the_covariance_equation(act):
    """`Ṗ = AP + PAᵀ + D` and `Ḟ = AF` from 0 and 1, for angle and process, integrated by an adaptive solver."""
    scene = Scene(0.0, ((act.duration, 0.1),), (act,), arw=0.2, noises=NOISES, scale=(Polynomial(0, 0.0, 1.0),) * 2)
    plan, model = core(scene)
    steps = engine_of(plan, model).steps
    n = 1 + len(NOISES)
    onward, spread = np.eye(n), np.zeros((n, n))
    for f, q in zip(np.asarray(steps.transition), np.asarray(steps.covariance), strict=True):
        onward, spread = f @ onward, f @ spread @ f.T + q
    edges = {"cosine ramps": [0, 2, 4, 6], "linear ramps": [0, 3, 6]}.get(act.shape)
    edges = edges or [0, act.duration]
    for k, noise in enumerate(NOISES, start=1):
        decay, diffusion, gains = system(noise)

        def slope(t, y, decay=decay, diffusion=diffusion, gains=gains):
            c = gains[0] + gains[1] * float(textbook_rate(act, np.array(t)))
            _, kept, _, q_ax, q_xx = y
            return [
                c * kept,
                -decay * kept,
                2 * c * q_ax,
                c * q_xx - decay * q_ax,
                diffusion - 2 * decay * q_xx,
            ]

        y = np.array([0.0, 1.0, 0.0, 0.0, 0.0])
        for a, b in pairwise(edges):
            y = solve_ivp(slope, (a, b), y, method="DOP853", rtol=3e-13, atol=1e-15).y[:, -1]
        result = [onward[0, k], onward[k, k], np.nan, spread[0, k], spread[k, k]]
        size = np.array([act.duration, 1.0, 1.0, noise.size**2 * act.duration, noise.size**2])
        for i in (0, 1, 3, 4):
            assert result[i] / size[i] == pytest.approx(y[i] / size[i], abs=1e-9), (noise, i)
        alone = spread[0, 0]
        noise_only = Scene(0.0, scene.stretches, (act,), arw=0.0, noises=(noise,), scale=scene.scale)
        if k in (2, 6):
            alone_plan, alone_model = core(noise_only)
            total = np.zeros((2, 2))
            made = engine_of(alone_plan, alone_model).steps
            for f, q in zip(np.asarray(made.transition), np.asarray(made.covariance), strict=True):
                total = f @ total @ f.T + q
            assert total[0, 0] == pytest.approx(y[2], rel=1e-9)
            assert alone > total[0, 0]


def exact(x: float, what: str) -> Decimal:
    getcontext().prec = 60
    d = Decimal(x)
    if what == "phi1":
        return (1 - (-d).exp()) / d
    return (2 * d - 3 + 4 * (-d).exp() - (-2 * d).exp()) / (2 * d**3)


@pytest.mark.parametrize("x", [1e-12, 9.9e-9, 1.01e-8, 1e-5, 1e-3, 0.1, 0.2999999, 0.3, 0.3000001, 1.0, 30.0, 500.0])
def test_the_series_meet_the_closed_forms(x):
    assert float(_phi1(np.asarray(x))) == pytest.approx(float(exact(x, "phi1")), rel=1e-14)
    assert float(_chi(np.asarray(x))) == pytest.approx(float(exact(x, "chi")), rel=1e-12)


def test_the_limits_at_zero():
    assert float(_phi1(np.asarray(0.0))) == 1.0
    assert float(_chi(np.asarray(0.0))) == pytest.approx(1 / 3, rel=1e-15)


def test_angle_random_walk_alone_is_its_variance_times_time():
    scene = Scene(0.0, ((36.0, 0.1),), (), read_every=9.0, arw=0.1 * DEG / 60, bias=Polynomial(0, 0.0, 1.0))
    plan, model = core(scene)
    steps = noise_steps(plan.trajectory(), model)
    # The paper's eq. 3: 0.1 deg/sqrt(h) needs 36 s for 1 deg/h.
    total = float(jnp.sum(steps.covariance[:, 0, 0]))
    assert np.sqrt(total) / 36.0 / (DEG / 3600) == pytest.approx(1.0, rel=1e-12)
