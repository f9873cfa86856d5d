"""Figures. Functions take `ax=None`, label axes with units, return their artists and never call `show`."""

from gradcal_jax.plots import calibration
from gradcal_jax.plots.calibration import draw_loop
from gradcal_jax.plots.calibration_maps import draw_calibrated_scale_factor
from gradcal_jax.plots.design import draw_frontier, draw_sensitivities
from gradcal_jax.plots.identification import draw_drift
from gradcal_jax.plots.lot import draw_lot
from gradcal_jax.plots.poses import draw_poses
from gradcal_jax.plots.residual import draw_curves, draw_map, draw_over_temperature, draw_worst_over_temperature
from gradcal_jax.plots.spec import draw_comparison, draw_heading, draw_prediction
from gradcal_jax.plots.style import save, style_of
from gradcal_jax.plots.sweep import draw_sweep
from gradcal_jax.plots.tracks import draw_temperature

__all__ = [
    "draw_calibrated_scale_factor",
    "draw_comparison",
    "draw_curves",
    "draw_drift",
    "draw_frontier",
    "draw_heading",
    "draw_loop",
    "draw_lot",
    "draw_map",
    "draw_over_temperature",
    "draw_poses",
    "draw_prediction",
    "draw_sensitivities",
    "draw_sweep",
    "draw_temperature",
    "draw_worst_over_temperature",
    "save",
    "style_of",
]
