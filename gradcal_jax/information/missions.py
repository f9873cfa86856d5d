"""A mission: the error of the integrated rate after a calibration.

A calibration reduces the rate error `B(T) + M(T, ω)·ω` to `ψᵀ(β − β̂)`, and its integral along a mission to

    ∫ δω dt = cᵀ(β − β̂),    c = ∫ ψ(T, ω)·(1 or ω) dt,    σ² = cᵀ C c:

one linear functional of the maps, computed by the same columns as the plan's readings (`model.terms`). What the
sensor's own noise adds, no calibration removes.
"""

import numpy as np
from jaxtyping import Float

from gradcal_jax.model import AXIS_NAMES, Channel, Discrepancy, GradientOfBias, Map, Nodes, SharedNodes
from gradcal_jax.motion import quadrature

# Gauss nodes on each straight line: exact for quintic by quintic maps times the rate.
_NODES = 6
# Least number of lines in a mission (maps bend along a line); number of lines that are summed at once.
_LINES, _AT_ONCE = 256, 8192


def mission_row(
    channel: Channel,
    time: Float[np.ndarray, " n"],
    rate: Float[np.ndarray, " n"],
    temperature: Float[np.ndarray, " n"],
) -> Float[np.ndarray, " p"]:
    """Contribution of each parameter's unit to the integrated rate of straight lines between `time` s (from 0,
    increasing), `rate` rad/s, `temperature` °C of the sensor. Terms of forces, of other axes' rates and of the
    temperature's path have none."""
    own = [t for t in channel.terms if isinstance(t, Map | GradientOfBias | Discrepancy) and t.of_own_input]
    breaks = np.unique(np.concatenate([time, np.linspace(0.0, time[-1], _LINES + 1)]))
    rate, temperature = (np.interp(breaks, time, of) for of in (rate, temperature))
    nodes, weights = quadrature(_NODES)
    row, signal = np.zeros(channel.size), f"rate {AXIS_NAMES[channel.axis]}"
    for first in range(0, len(breaks) - 1, _AT_ONCE):
        ends = slice(first, first + _AT_ONCE + 1)
        lasting = np.diff(breaks[ends])[:, None] * weights
        rates, temperatures = (of[ends][:-1, None] + np.diff(of[ends])[:, None] * nodes for of in (rate, temperature))
        each = np.arange(len(lasting))
        group = SharedNodes(each, each, temperatures, lasting, rates, {signal: rates}, np.eye(_NODES))
        of_lines = Nodes((group,), np.diff(temperature[ends]))
        for term in own:
            row[channel.where(term.name)] += np.sum(np.asarray(term.columns(of_lines)), axis=0)
    return row
