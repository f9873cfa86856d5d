"""Pictures of designs show every point, with ticks that can be read."""

from types import SimpleNamespace

import pytest

from gradcal_jax import plots
from gradcal_jax.design.optimise import FrontierPoint
from gradcal_jax.information.sensitivity import Elasticity, Sensitivities


def test_the_frontier_has_a_mark_for_each_plan_and_numbers_on_its_axis():
    points = [
        FrontierPoint(60.0 * t, SimpleNamespace(now=v, unit="ppm", name="full range"), "")
        for t, v in ((50.0, 5.0), (100.0, 3.3), (200.0, 2.5))
    ]
    figure = plots.draw_frontier([*points, FrontierPoint(60.0, None, "too short")], {"full range": 77.0})
    (axes,) = figure.axes
    assert list(axes.lines[0].get_xdata()) == [50.0, 100.0, 200.0]
    figure.canvas.draw()
    low, high = axes.get_ylim()
    shown = [t.get_text() for t in axes.get_yticklabels() if low <= t.get_position()[1] <= high]
    assert len(shown) >= 3
    assert "5" in shown
    with pytest.raises(ValueError, match="there is no plan for any duration"):
        plots.draw_frontier(points[:0], {})


def test_sensitivities_are_bars_for_what_matters():
    rows = (Elasticity("full range", "reading noise", 0.8), Elasticity("full range", "timing error", 1e-4))
    figure = plots.draw_sensitivities(Sensitivities(rows, {"full range": (3.3, "ppm")}))
    (axes,) = figure.axes
    assert [bar.get_width() for bar in axes.patches] == [0.8]
    assert [t.get_text() for t in axes.get_yticklabels()] == ["reading noise"]
