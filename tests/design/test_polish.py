"""A polish without limits: it ends where the gradient vanishes, in flat valleys too, and never at a worse point."""

import equinox as eqx
import jax.numpy as jnp
import numpy as np

from gradcal_jax.design.search import CONVERGED, Compiled, polish

LOWEST = np.array([1.0, -0.5])


class Objective(eqx.Module):
    """Without limits."""

    shape: np.ndarray

    @property
    def cost(self) -> int:
        return 0

    @property
    def limited(self) -> bool:
        return False


class Well(Objective):
    """A well with a flat plain about it: the gradient vanishes at its bottom, and far away at the largest value."""

    def value(self, z, sharpness):
        del sharpness
        return jnp.exp(1.0 - jnp.exp(-jnp.sum((z - self.shape) ** 2))), jnp.zeros(0)


class Valley(Objective):
    """A valley that is a million times flatter along than across, askew to the coordinates."""

    def value(self, z, sharpness):
        del sharpness
        return jnp.exp(jnp.sum((self.shape @ (z - 1.0)) ** 2)), jnp.zeros(0)


def test_a_polish_finds_the_bottom_and_not_the_plain():
    at = Compiled(Well(LOWEST), 2)
    begin = LOWEST + 0.6
    optimum = polish(at, begin)
    assert optimum.converged
    np.testing.assert_allclose(optimum.point, LOWEST, atol=1e-5)
    # Of the plain there is nothing to gain: the point stays.
    far = polish(at, LOWEST + 30.0)
    assert far.value <= float(np.exp(at(LOWEST + 30.0).logs[0]))


def test_a_polish_goes_along_a_flat_valley():
    turned = np.linalg.qr(np.random.default_rng(0).standard_normal((8, 8)))[0]
    at = Compiled(Valley(np.logspace(-2.5, 0.5, 8)[:, None] * turned), 8)
    optimum = polish(at, np.zeros(8))
    assert optimum.gradient_norm < CONVERGED
    np.testing.assert_allclose(optimum.point, 1.0, atol=0.05)


def test_entries_that_pad_a_point_change_nothing():
    alone = polish(Compiled(Well(LOWEST), 2), LOWEST + 0.6)

    class Padded(Well):
        def value(self, z, sharpness):
            return Well.value(self, z[1:], sharpness)

    padded = polish(Compiled(Padded(LOWEST), 3, np.array([1, 2])), LOWEST + 0.6)
    np.testing.assert_allclose(padded.point, alone.point, rtol=1e-9)


def test_without_limits_the_program_of_all_slopes_is_not_compiled(monkeypatch):
    at = Compiled(Well(LOWEST), 2)
    begin = LOWEST + 0.6
    merit, _ = at(begin).merit()
    values, slopes = (np.asarray(x) for x in at._program(at._leaves, begin, np.inf))
    np.testing.assert_allclose([merit, *at(begin).of_z[0]], [*values, *slopes[0]], rtol=1e-12)

    def refuse(*_):
        raise AssertionError("the second program was called")

    monkeypatch.setattr(at, "_program", refuse)
    assert polish(at, begin).converged


def test_a_descent_that_gains_little_ends_early():
    at = Compiled(Valley(np.logspace(-2.5, 0.5, 8)[:, None] * np.eye(8)), 8)
    value = lambda z: float(at(z, 1000.0).logs[0])  # noqa: E731
    begin = np.zeros(8)
    whole, brief = (at.descend(begin, 1000.0, 400, gain=gain) for gain in (0.0, 1e-2))
    # (Blocks of twenty evaluations: the first one never ends a descent.)
    first = at.descend(begin, 1000.0, 20, gain=1.0)
    assert value(whole) < value(brief) <= value(first) < value(begin)
    assert value(brief) - value(whole) < 0.1
