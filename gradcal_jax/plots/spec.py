"""Figures of a spec: the residuals of its plan, and comparisons of plans."""

from collections.abc import Sequence

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.lines import Line2D

from gradcal_jax.api import UNIT_OF, assemble, posterior_of_plan, residual_map
from gradcal_jax.api.missions import ErrorCurve, error_curves
from gradcal_jax.files import Spec
from gradcal_jax.files.unit_spec import UnitSpec
from gradcal_jax.plots.residual import draw_map, draw_over_temperature, draw_worst_over_temperature
from gradcal_jax.plots.style import from_zero, new_axes, new_panels, style_of


def draw_heading(
    curves: Sequence[tuple[str, ErrorCurve]], *, own: bool = True, first: int = 0, ax: Axes | None = None
) -> tuple[Axes, list[Line2D]]:
    """The heading error after calibrations over time (deg, 1σ), each with a label; with `own`, also the unit's own
    noise and the sum of both. `first`: the index of the first curve's style."""
    ax = new_axes(ax)
    drawn: list[Line2D] = []

    def line(curve: ErrorCurve, values: np.ndarray, label: str) -> None:
        shown = np.where(np.isfinite(values), values, np.nan)
        drawn.extend(ax.plot(curve.time / 60.0, shown, label=label, **style_of(first + len(drawn))))

    for label, curve in curves:
        line(curve, curve.left, label)
    for curve in {c.file: c for _, c in curves}.values() if own else ():
        of = f", {curve.file}" if len({c.file for _, c in curves}) > 1 else ""
        line(curve, curve.own, f"own noise{of}")
        if len(curves) == 1:
            line(curve, np.hypot(curve.left, curve.own), "together")
    ax.set(xlabel="time in the mission, min", ylabel="error of the heading (1σ), deg")
    from_zero(ax)
    ax.legend()
    return ax, drawn


def draw_prediction(spec: Spec) -> Figure:
    """A residual map for each scale-factor requirement, curves for each other requirement, for every axis.

    Errors: `ValueError` for a spec without requirements.
    """
    built = assemble(spec)
    known = {channel: posterior_of_plan(built, channel) for channel in built.channels}
    panels = [(r, c) for r in spec.requirement for c in built.channels]
    if not panels:
        raise ValueError("the spec has no [[requirement]], so there is no residual to draw: add one")
    figure, all_axes = new_panels(len(panels), 1, (6.4, 4.2))
    for axes, (requirement, channel) in zip(all_axes[:, 0], panels, strict=True):
        name = requirement.name if len(built.channels) == 1 else f"{requirement.name}, axis {channel}"
        if requirement.quantity == "heading":
            curves = error_curves(built, known[channel], requirement)
            draw_heading([("calibration" + (f", {c.file}" if len(curves) > 1 else ""), c) for c in curves], ax=axes)
            axes.set_title(name)
            continue
        temperature, rate, values = residual_map(built, known[channel], requirement)
        unit = UNIT_OF[requirement.quantity][0]
        if requirement.quantity.endswith("scale_factor"):
            draw_map(temperature, rate, values, unit, title=name, ax=axes)
        else:
            draw_over_temperature(temperature, values, unit, ax=axes)
            axes.set_title(name)
    if spec.title:
        figure.suptitle(spec.title)
    return figure


def draw_comparison(specs: Sequence[tuple[str, UnitSpec]]) -> Figure:
    """Plans side by side: for each requirement's name, one curve a plan. Errors: `ValueError` without requirements."""
    names = list(dict.fromkeys((r.name, r.quantity) for _, spec in specs for r in spec.requirement))
    if not names:
        raise ValueError("none of the specs has a [[requirement]], so there is no residual to draw: add one")
    figure, all_axes = new_panels(len(names), 1, (6.8, 4.0))
    for axes, (name, quantity) in zip(all_axes[:, 0], names, strict=True):
        for index, (label, spec) in enumerate(specs):
            built = assemble(spec)
            known = posterior_of_plan(built, built.channels[0])
            for requirement in (r for r in spec.requirement if (r.name, r.quantity) == (name, quantity)):
                if requirement.quantity == "heading":
                    curves = error_curves(built, known, requirement)
                    draw_heading([(label, curve) for curve in curves], own=False, first=index, ax=axes)
                    continue
                temperature, rate, values = residual_map(built, known, requirement)
                if quantity.endswith("scale_factor"):
                    draw_worst_over_temperature(rate, values, "ppm", label=label, index=index, ax=axes)
                else:
                    draw_over_temperature(temperature, values, UNIT_OF[quantity][0], label=label, index=index, ax=axes)
        axes.set_title(name)
        axes.legend()
    return figure
