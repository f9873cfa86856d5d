"""Known answers of whole units: closed forms, and figures of an independent prototype to the digits that it gives.

Noise unless said: gyro 0.15 deg/√h, drift 1 deg/h of 120 s; accelerometer 0.05 m/s/√h, drift 50 µg of 200 s; encoder
5 arcsec white and 5 arcsec at each standstill. Where a figure says "worst" or is one of several, the bias, the scale
factor and the second order are means over the three axes, misalignments the root mean square of the six.
"""

from itertools import product

import numpy as np
import pytest
from helpers import NoEarth
from imu_helpers import (
    ARCSEC,
    DEG,
    EAST,
    FIVE_ARCSEC,
    FORCE_WHITE,
    GYRO_DRIFT,
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


def prints(value: float, figure: str) -> None:
    """The value rounds to the figure as it is printed."""
    digits = len(figure.partition(".")[2])
    assert f"{value:.{digits}f}" == figure, f"{value:.7g} is not {figure}"


def of_symbol(found: dict[str, float], kind: str, symbol: str) -> np.ndarray:
    return np.array([v for k, v in found.items() if k.startswith(kind) and k.split(".")[1].startswith(symbol)])


def tumble(steps, terms, *, drift=(), installation=(), noise=None, start=(0.0, 0.0)):
    """Bias µg, scale factor ppm, misalignment µrad and second order µg/g² of three accelerometers."""
    triad = [accelerometer(k, terms, drift=drift) for k in range(3)]
    found = sigmas(motion_of(two_axes(), steps, start=start), unit(triad, installation, noise))
    each = [of_symbol(found, "acc", symbol) for symbol in ("b", "s", "m_", "k2")]
    rms = lambda v: np.sqrt(np.mean(v**2))  # noqa: E731
    values = [(rms if i == 2 else np.mean)(v) if len(v) else np.nan for i, v in enumerate(each)]
    return np.array(values) * _G


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
    found = tumble(steps, "b s m", start=angles[0])
    np.testing.assert_allclose(found[:3], np.array([1.0, np.sqrt(3), np.sqrt(3)]) * one, rtol=1e-9)
    found = tumble(steps, "b s m k2", start=angles[0])
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
    prints(lasting, "7.1781")
    noise = encoder(1, FIVE_ARCSEC)
    found = sigmas(motion, unit([gyro(0, "b m"), gyro(2, "b s")], (), noise, axes=1))
    assert found["gyro_x.m_z"] == pytest.approx(GYRO_WHITE * np.sqrt(lasting / 40) / (1800 * DEG), rel=1e-9)
    prints(found["gyro_z.b00"] * 1e6, "0.6363")


def test_two_axes_see_the_inner_encoder_in_the_cross_terms():
    """±5 turns about z, and about x and y with the outer axis, for 1600 s with rests of 20 s between them."""
    cycle = [rest(20.0), *back_and_forth(1, 20.0), *back_and_forth(0, 20.0), turn(1, 90.0), rest(20.0)]
    cycle += [*back_and_forth(0, 20.0), turn(1, -90.0)]
    lasting = sum(step.move.duration for step in cycle)
    motion = motion_of(two_axes(), cycle * int(1600.0 / lasting))
    triad = [gyro(k, drift=GYRO_DRIFT) for k in range(3)]
    found = {k: v * 1e6 for k, v in sigmas(motion, unit(triad, (), encoder(2, FIVE_ARCSEC))).items()}
    prints(found["gyro_z.b00"], "1.06")
    prints(found["gyro_z.m_x"], "1.00")
    prints(found["gyro_z.m_y"], "1.00")
    prints(found["gyro_x.m_y"], "8")
    prints(found["gyro_y.m_x"], "8")
    # With an inner encoder that knows, they are as good as the others.
    exact = sigmas(
        motion, unit(triad, (), model.EncoderNoise(np.array([FIVE_ARCSEC, 0.0]), *np.zeros((1, 2)), np.ones(2)))
    )
    assert exact["gyro_x.m_y"] * 1e6 < 1.1


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


@pytest.mark.parametrize("degrees", [90.0, 180.0, 360.0])
def test_an_encoders_harmonic_in_the_scale_factor(degrees):
    """Order 1 of 10 arcsec, back and forth over Δ: A√(2(1 − cos Δ))/Δ."""
    steps = [rest(5.0), *back_and_forth(0, 5.0, degrees) * 4]
    error = [model.AxisHarmonics(np.full(2, 10.0 * ARCSEC), (1,), 0, "spin")]
    of = unit([gyro(2, "s", white=1e-10)], error, axes=1)
    found = sigmas(motion_of(table(UP, kind=NoEarth), steps), of)["gyro_z.b00"]
    delta = degrees * DEG
    wanted = 10.0 * ARCSEC * np.sqrt(2.0 * (1.0 - np.cos(delta))) / delta
    assert found == pytest.approx(wanted, rel=1e-6, abs=1e-9)
