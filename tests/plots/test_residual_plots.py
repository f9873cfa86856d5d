"""Residuals of a calibration: drawn as counted, beside what the model expects."""

import numpy as np
import pytest
from report_samples import calibration, recipe

from gradcal_jax.estimation.calibration_of_fit import residuals_of
from gradcal_jax.plots.calibration import draw_residuals


@pytest.fixture(scope="module")
def channel():
    return calibration(recipe()).channel[0]


def test_every_residual_is_counted_where_it_lies():
    counted = residuals_of(np.array([-9.0, -4.0, -0.1, 0.0, 0.4, 3.9, 4.0, 17.0]))
    assert sum(counted.counts) == 8
    # Below -4; -4 … -3.5; -0.5 … 0; 0 … 0.5; 3.5 … 4 (its end included, as NumPy has it for the last finite bin only).
    assert [k for k, n in enumerate(counted.counts) if n] == [0, 1, 8, 9, 16, 17]
    assert counted.rms == ()
    walk = np.repeat(np.arange(1.0, 11.0), 50)
    assert residuals_of(walk).rms == pytest.approx(np.arange(1.0, 11.0))


def test_the_pictures_show_the_counts_and_what_is_expected(channel):
    white = np.random.default_rng(2).standard_normal(5000)
    made = channel.model_copy(update={"residuals": residuals_of(white)})
    ax, line = draw_residuals(made)
    heights = [bar.get_height() for bar in ax.patches]
    assert heights == list(made.residuals.counts)
    # The curve is the number that a bar of half a standard deviation would have.
    assert np.max(np.abs(np.interp(np.arange(-3.75, 4.0, 0.5), *line.get_data()) - heights[1:17])) < 80.0
