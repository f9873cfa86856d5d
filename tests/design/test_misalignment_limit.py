"""The limit of misalignments on two axes against generalised least squares of turns written from geometry."""

import numpy as np
import pytest

from gradcal_jax.design.misalignment_limit import Standstills, TurnNodes, misalignment_limit

NOISE, OFFSET = 4e-5, 2.4e-5  # rad/√s, rad


def plan(seed, *, standstills=40, accelerometers=0.0):
    """A random plan: angle, time and course of the inner axis's standstills, and the outer turns in each."""
    rng = np.random.default_rng(seed)
    stands = []
    for k in range(standstills):
        turns = [(rng.choice([-1.0, 1.0]) * rng.uniform(3.0, 20.0), rng.uniform(1.0, 5.0)) for _ in range(2)]
        inner = rng.uniform(-20.0, 20.0), rng.uniform(1.0, 5.0)
        course = -1.0 + 2.0 * (k + np.array([0.2, 0.5, 0.8])) / standstills
        stands.append((rng.uniform(0.0, 2.0 * np.pi), turns, inner, course, accelerometers * rng.uniform()))
    return stands


def deviations(stands, at, prior=np.inf):
    """Standard deviations of the six misalignments at ψ = (1, x), `(6, n)`: every row is a turn seen by three gyros."""
    elements = [(0, 1), (1, 0), (2, 0), (2, 1), (0, 2), (1, 2)]
    count, rows = 12 + len(stands), []
    for k, (angle, turns, (turned, lasted), course, seen) in enumerate(stands):
        u = np.array([np.cos(angle), np.sin(angle), 0.0])
        for (theta, time), x in zip(turns, course, strict=False):
            block = np.zeros((3, count))
            for e, (i, j) in enumerate(elements):
                block[i, 2 * e : 2 * e + 2] = theta * u[j] * np.array([1.0, x])
            block[:, 12 + k] = theta * np.cross([0.0, 0.0, 1.0], u)
            rows.append(block / (NOISE * np.sqrt(time)))
        if k + 1 < len(stands):
            block = np.zeros((3, count))
            for e, (i, j) in enumerate(elements):
                block[i, 2 * e : 2 * e + 2] = turned * (j == 2) * np.array([1.0, course[2]])
            block[2, 12 + k : 14 + k] = [-1.0, 1.0]
            rows.append(block / (NOISE * np.sqrt(lasted)))
        rows.append(np.eye(count)[12 + k][None] * np.sqrt(1.0 / OFFSET**2 + seen))
    rows.append(np.eye(count)[:12] / prior)
    whole = np.concatenate(rows)
    covariance = np.linalg.inv(whole.T @ whole)
    return np.array(
        [np.sqrt(np.einsum("ip,pq,iq->i", at, covariance[e : e + 2, e : e + 2], at)) for e in range(0, 12, 2)]
    )


def bound(stands, at, prior=np.inf, noise=NOISE, **how):
    """The limit of all plans with the times, but not the angles, of these turns: here as if each were as large."""
    line = lambda x: np.stack([np.ones_like(x), x], axis=-1)  # noqa: E731
    outer = [
        (x, theta**2 / time, k) for k, s in enumerate(stands) for (theta, time), x in zip(s[1], s[3], strict=False)
    ]
    inner = [(s[3][2], s[2][0] ** 2 / s[2][1], k) for k, s in enumerate(stands[:-1])]
    nodes = [
        TurnNodes(line(np.array([x for x, *_ in of])), np.array([q for _, q, _ in of]), np.array([k for *_, k in of]))
        for of in (outer, inner)
    ]
    information = np.array([1.0 / OFFSET**2 + s[4] for s in stands])
    stood = Standstills(
        line(np.array([s[3][1] for s in stands])), information, np.array([s[2][1] for s in stands[:-1]])
    )
    rows = np.eye(2) / prior if np.isfinite(prior) else np.zeros((0, 2))
    of_outer, of_inner = nodes
    return misalignment_limit(of_outer, of_inner, stood, noise=noise**2, prior=rows, at=at, **how)


@pytest.mark.parametrize("accelerometers", [0.0, 3e9])
@pytest.mark.parametrize("prior", [np.inf, 3e-6])
@pytest.mark.parametrize("seed", range(12))
def test_no_random_plan_lies_below(seed, prior, accelerometers):
    x = np.linspace(-1.0, 1.0, 21)
    at, stands = np.stack([np.ones_like(x), x], axis=-1), plan(seed, accelerometers=accelerometers)
    each = deviations(stands, at, prior)
    for name, over in (("mean", np.mean), ("max", np.max), ("rms", lambda v, axis: np.sqrt(np.mean(v**2, axis)))):
        value = over(each, axis=1)
        for worst, together in ((True, np.max(value)), (False, np.sqrt(np.mean(value**2)))):
            least = bound(stands, at, prior, name=name, worst=worst)
            assert 0.5 * together < least < together * (1.0 + 1e-9), (name, worst)


def test_turns_about_the_diagonals_reach_the_limit():
    """There s is seen along the axis of a turn and ρ across it; two noises together lose a little more than each."""
    stands = []
    for k in range(200):
        course = np.full(3, -1.0 + 2.0 * (k // 2 + 0.5) / 100)
        stands.append((np.pi / 4 + np.pi / 2 * (k % 2), [(15.0, 3.0)], (15.0, 3.0), course, 0.0))
    at = np.array([[1.0, 0.0]])
    each = deviations(stands, at)[:, 0]
    assert 0.97 < bound(stands, at, name="mean", worst=False) / np.sqrt(np.mean(each**2)) < 1.0


def test_without_noise_of_gyros_the_encoder_alone_is_left():
    """ρ is the mean of K draws of the encoder, however the turns are; m_pq and m_qp have its standard deviation."""
    stands = [(a, turns, inner, 0.0 * course, seen) for a, turns, inner, course, seen in plan(1)]
    least = bound(stands, np.array([[1.0, 0.0]]), noise=1e-12, name="mean", worst=True)
    assert least == pytest.approx(OFFSET / np.sqrt(len(stands)), rel=2e-3)
