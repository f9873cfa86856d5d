"""A polish ends at the best point that it saw, wherever SLSQP goes."""

import numpy as np
import scipy.optimize

from gradcal_jax.design.search import Compiled, Slopes, polish

LOWEST = np.array([1.0, -0.5])


class Well(Compiled):
    """A well with a flat plain about it: the gradient vanishes at its bottom, and far away at the largest value."""

    def __init__(self):
        self.size = 2

    def __call__(self, z, sharpness=np.inf):
        apart = z - LOWEST
        inside = np.exp(-apart @ apart)
        return Slopes(np.array([1.0 - inside]), 2.0 * inside * apart[None], np.zeros((1, 0)))


def test_a_leap_onto_the_plain_is_not_the_end(monkeypatch):
    def leaps(fun, begin, **options):
        fun(begin + 1e-3 * -fun(begin)[1])
        return fun(begin + 1e4)

    begin = LOWEST + 0.6
    before = float(np.exp(Well()(begin).logs[0]))
    monkeypatch.setattr(scipy.optimize, "minimize", leaps)
    optimum = polish(Well(), begin, rounds=1)
    assert optimum.value < before
    assert 0.0 < np.max(np.abs(optimum.point - begin)) < 0.6
