"""Known answers of whole units: closed forms, in white noise of 0.15 deg/√h (gyros) and 0.05 m/s/√h."""

from itertools import product

import numpy as np
import pytest
from helpers import NoEarth
from imu_helpers import (
    ARCSEC,
    DEG,
    EAST,
    FORCE_WHITE,
    GYRO_WHITE,
    UP,
    G,
    accelerometer,
    back_and_forth,
    encoder,
    gyro,
    known,
    motion_of,
    poses,
    rest,
    sigmas,
    table,
    turn,
    two_axes,
    unit,
    up_along,
)

from gradcal_jax import model

FACES = [(0, 0, 1), (0, 0, -1), (0, 1, 0), (0, -1, 0), (1, 0, 0), (-1, 0, 0)]
TETRAHEDRON = [(1, 1, 1), (1, -1, -1), (-1, 1, -1), (-1, -1, 1)]
EDGES = [v for v in product((-1, 0, 1), repeat=3) if sum(map(abs, v)) == 2]
_GOLD = (1.0 + np.sqrt(5.0)) / 2.0
ICOSAHEDRON = [v for a in (-1, 1) for b in (-_GOLD, _GOLD) for v in ((0, a, b), (a, b, 0), (b, 0, a))]
_G = np.array([1e6 / G, 1e6, 1e6, 1e6 * G])


def tumble(steps, terms, start):
    """Bias µg, scale factor ppm, misalignment µrad and second order µg/g² of three accelerometers."""
    found = sigmas(motion_of(two_axes(), steps, start=start), unit([accelerometer(k, terms) for k in range(3)]))
    each = [
        [v for name, v in found.items() if name.split(".")[1].startswith(symbol)] for symbol in ("b", "s", "m_", "k2")
    ]
    return np.array([np.sqrt(np.mean(np.square(v))) if v else np.nan for v in each]) * _G


# --- the tumble -------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("directions", "with_second_order"),
    [
        (TETRAHEDRON, None),
        (FACES, (np.sqrt(6) / 2, np.sqrt(4.5))),
        (EDGES, (np.sqrt(3), np.sqrt(18))),
        (ICOSAHEDRON, (1.5, np.sqrt(11.25))),
    ],
    ids=["tetrahedron", "faces", "edges", "icosahedron"],
)
def test_a_tumble_in_white_noise_has_closed_forms(directions, with_second_order):
    """No set of equal windows beats six faces; all of them give σ_T, √3σ_T, √3σ_T."""
    angles = up_along(directions)
    steps, one = poses(angles, 720.0 / len(angles), move=2.0), FORCE_WHITE / np.sqrt(720.0) / G * 1e6
    found = tumble(steps, "b s m", angles[0])
    np.testing.assert_allclose(found[:3], np.array([1.0, np.sqrt(3), np.sqrt(3)]) * one, rtol=1e-9)
    found = tumble(steps, "b s m k2", angles[0])
    if with_second_order is None:
        assert np.isinf(found[0])
        assert np.isinf(found[3])
        return
    np.testing.assert_allclose(found[[0, 3]], np.array(with_second_order) * one, rtol=1e-9)
    np.testing.assert_allclose(found[1:3], np.sqrt(3) * one, rtol=1e-9)


# --- gyros at one temperature -----------------------------------------------------------------------------------------


def observable(geometry, steps, channels) -> int:
    """Rank of what the rows alone tell; all priors are flat."""
    motion = motion_of(geometry, steps)
    return known(motion, unit(channels, axes=geometry.axis_count)).spread.shape[1]


def test_ranks_of_a_gyro_triad_without_the_earth():
    triad = [gyro(k) for k in range(3)]
    vertical = [rest(5.0), *back_and_forth(0, 5.0, 720.0)] * 2
    assert observable(table(UP, kind=NoEarth), vertical, triad) == 6
    faces = [rest(5.0), *[step for _ in range(4) for step in (turn(0, 90.0), rest(5.0))]] * 2
    assert observable(table(EAST, kind=NoEarth), faces, triad) == 12
    # All 21 want both axes of a two-axis table, and faces.
    steps = [rest(5.0), *back_and_forth(1, 5.0), *back_and_forth(0, 5.0), turn(1, 90.0), *back_and_forth(0, 5.0)]
    steps += poses([(0, 90), (90, 90), (90, 180), (180, 180)], 5.0)
    assert observable(two_axes(kind=NoEarth), steps, triad) == 21


def test_misalignment_and_scale_factor_of_turns_back_and_forth():
    """`σ_m = N√(D/n)/A` for n = 40 moves of ±1800° at 300 deg/s; the scale factor has each standstill's 5″ besides."""
    steps = [rest(1e-6), *back_and_forth(0, 1e-6) * 20]
    motion = motion_of(table(UP), steps)
    (lasting,) = {round(step.move.duration, 12) for step in steps if step.axis == 0}
    found = sigmas(motion, unit([gyro(0, "b m"), gyro(2, "b s")], (), encoder(1, 5.0 * ARCSEC), axes=1))
    assert found["gyro_x.m_z"] == pytest.approx(GYRO_WHITE * np.sqrt(lasting / 40) / (1800 * DEG), rel=1e-9)
    assert found["gyro_z.b00"] * 1e6 == pytest.approx(0.6363, abs=5e-5)


def test_a_reversal_tells_misalignment_from_non_orthogonality():
    """At spins of 0° and 90° the outer turns see m_zx + δ and m_zy + δ only; 180° separates them, as closed forms."""
    pairs, free = 8, [model.NonOrthogonality(np.array([np.inf]), ("tilt", "spin"))]
    triad = [gyro(k, "s m") for k in range(3)]
    once = back_and_forth(0, 5.0) * pairs
    two = [*once, turn(1, 90.0), *once]
    confounded = sigmas(motion_of(two_axes(kind=NoEarth), two), unit(triad, free))
    assert np.isinf(confounded["gyro_z.m_x"])
    assert np.isinf(confounded["gyro_z.m_y"])
    assert np.isinf(confounded["orthogonality_tilt_spin"])
    # The Earth's rate tells them apart, a thousand times worse than the turns: tens of milliradians.
    by_earth = sigmas(motion_of(two_axes(), two), unit([gyro(k, "b s m g") for k in range(3)], free))
    assert 5e-3 < by_earth["gyro_z.m_x"] < 0.1
    assert by_earth["gyro_z.m_x"] == pytest.approx(by_earth["orthogonality_tilt_spin"], rel=1e-3)
    lasting = once[0].move.duration
    each = GYRO_WHITE * np.sqrt(lasting / (2 * pairs)) / (1800.0 * DEG)
    three = sigmas(motion_of(two_axes(kind=NoEarth), [*two, turn(1, 90.0), *once]), unit(triad, free))
    wanted = each * np.array([np.sqrt(0.5), np.sqrt(1.5), np.sqrt(0.5)])
    found = [three[name] for name in ("gyro_z.m_x", "gyro_z.m_y", "orthogonality_tilt_spin")]
    # (The turns of 90° add a ten-thousandth.)
    np.testing.assert_allclose(found, wanted, rtol=1e-3)
