"""Figures of pages, commands and notebooks. Functions draw one picture on `ax`, or on a new figure, label axes with
units, return what they drew and never call `show`; those with `figure` draw a panel for each requirement or channel."""

from gradcal_jax.plots.calibration import draw_calibrated_scale_factor, draw_calibrated_term, draw_residuals
from gradcal_jax.plots.noise import draw_noise
from gradcal_jax.plots.residual import draw_curves, draw_map
from gradcal_jax.plots.spec import draw_comparison, draw_poses, draw_temperature
from gradcal_jax.plots.style import save, style_of
from gradcal_jax.plots.sweep import draw_sensitivities, draw_sweep

__all__ = [
    "draw_calibrated_scale_factor",
    "draw_calibrated_term",
    "draw_comparison",
    "draw_curves",
    "draw_map",
    "draw_noise",
    "draw_poses",
    "draw_residuals",
    "draw_sensitivities",
    "draw_sweep",
    "draw_temperature",
    "save",
    "style_of",
]
