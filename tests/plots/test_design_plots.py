"""Pictures of designs."""

from gradcal_jax import plots
from gradcal_jax.information.sensitivity import Elasticity, Sensitivities


def test_sensitivities_are_bars_for_what_matters():
    rows = (Elasticity("full range", "reading noise", 0.8), Elasticity("full range", "timing error", 1e-4))
    figure = plots.draw_sensitivities(Sensitivities(rows, {"full range": (3.3, "ppm")}))
    (axes,) = figure.axes
    assert [bar.get_width() for bar in axes.patches] == [0.8]
    assert [t.get_text() for t in axes.get_yticklabels()] == ["reading noise"]
