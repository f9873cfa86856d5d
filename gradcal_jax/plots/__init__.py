"""Figures. Functions draw one picture on `ax`, or on a new figure, label axes with units, return their artists and
never call `show`. Some draw figures of several panels: requirements, maps, axes."""

from gradcal_jax.plots import calibration
from gradcal_jax.plots.calibration import draw_residuals_over_time
from gradcal_jax.plots.calibration_maps import (
    draw_calibrated_scale_factor,
    draw_calibrated_term,
)
from gradcal_jax.plots.identification import draw_allan
from gradcal_jax.plots.residual import draw_curves, draw_map
from gradcal_jax.plots.spec import (
    draw_comparison,
    draw_poses,
    draw_prediction,
    draw_temperature,
)
from gradcal_jax.plots.style import save, style_of
from gradcal_jax.plots.sweep import draw_frontier, draw_sensitivities, draw_sweep

__all__ = [
    "draw_allan",
    "draw_calibrated_scale_factor",
    "draw_calibrated_term",
    "draw_comparison",
    "draw_curves",
    "draw_frontier",
    "draw_map",
    "draw_poses",
    "draw_prediction",
    "draw_residuals_over_time",
    "draw_sensitivities",
    "draw_sweep",
    "draw_temperature",
    "save",
    "style_of",
]
