"""A mission: the error of the integrated rate after a calibration, and the contribution of the sensor's own noise.

A calibration reduces the rate error `B(T) + M(T, ω)·ω` to `ψᵀ(β − β̂)`, and its integral along a mission to

    ∫ δω dt = cᵀ(β − β̂),    c = ∫ ψ(T, ω)·(1 or ω) dt,    σ² = cᵀ C c:

one linear functional of the maps, computed by the same columns as the plan's readings (`model.terms`), with
those of a discrepancy (`residual.Contrasts`). What the sensor's own noise adds, no calibration removes.
"""

from itertools import pairwise
from typing import NamedTuple

import numpy as np
from jaxtyping import Float

from gradcal_jax.information.residual import Contrasts
from gradcal_jax.model import AXIS_NAMES, Channel, Discrepancy, GradientOfBias, Map, Nodes, SharedNodes
from gradcal_jax.motion import quadrature

# Gauss nodes on each straight line: exact for quintic by quintic maps times the rate.
_NODES = 6
# Least number of lines in a mission (maps bend along a line); number of lines that are summed at once.
_LINES, _AT_ONCE = 256, 8192


class Flight(NamedTuple):
    """Straight lines between `time` s (from 0, increasing), `rate` rad/s, `temperature` °C of the sensor."""

    time: Float[np.ndarray, " n"]
    rate: Float[np.ndarray, " n"]
    temperature: Float[np.ndarray, " n"]


def mission_rows(channel: Channel, flight: Flight, at: Float[np.ndarray, " k"]) -> Float[np.ndarray, "k p"]:
    """Contribution of each parameter's unit to the integrated rate since the begin at times `at` (s, increasing). Terms
    of forces, of other axes' rates and of the temperature's path have none."""
    own = [t for t in channel.terms if isinstance(t, Map | GradientOfBias | Discrepancy) and t.of_own_input]
    kept = flight.time[flight.time < at[-1]]
    breaks = np.unique(np.concatenate([kept, at, np.linspace(0.0, at[-1], _LINES + 1)]))
    rate, temperature = (np.interp(breaks, flight.time, of) for of in (flight.rate, flight.temperature))
    ends = np.searchsorted(breaks, at)
    cuts = np.unique(np.concatenate([[0], ends, np.arange(0, ends[-1], _AT_ONCE)]))
    nodes, weights = quadrature(_NODES)
    rows, signal = np.zeros((len(cuts), channel.size)), f"rate {AXIS_NAMES[channel.axis]}"
    for number, (first, last) in enumerate(pairwise(cuts), 1):
        here = slice(first, last)
        along = lambda of, here=here: of[here, None] + np.diff(of)[here, None] * nodes  # noqa: E731
        lasting, each = np.diff(breaks)[here, None] * weights, np.arange(last - first)
        rates, signals = along(rate), {signal: along(rate)}
        group = SharedNodes(each, each, along(temperature), lasting, rates, signals, np.eye(_NODES))
        of_lines = Nodes((group,), np.diff(temperature)[here])
        for term in own:
            rows[number, channel.where(term.name)] = np.sum(np.asarray(term.columns(of_lines)), axis=0)
    return np.cumsum(rows, axis=0)[np.searchsorted(cuts, ends)]


def mission_contrasts(channel: Channel, rows: Float[np.ndarray, "k p"]) -> Contrasts:
    """Contrasts of errors that are these combinations of the parameters, with the discrepancy's part set apart."""
    alone, beyond = np.zeros_like(rows), np.zeros(len(rows))
    for term in channel.terms:
        if isinstance(term, Discrepancy):
            where = channel.where(term.name)
            alone[:, where] = rows[:, where]
            beyond += float(term.std) ** 2 * np.sum(rows[:, where] ** 2, axis=1)
    return Contrasts(rows, alone, beyond)
