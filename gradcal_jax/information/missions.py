"""A mission: the error of the integrated rate after a calibration, and the contribution of the sensor's own noise.

A calibration reduces the rate error `B(T) + M(T, ω)·ω` to `ψᵀ(β − β̂)`, and its integral along a mission to

    ∫ δω dt = cᵀ(β − β̂),    c = ∫ ψ(T, ω)·(1 or ω) dt,    σ² = cᵀ C c:

one linear functional of the maps, computed by the same columns as the plan's readings (`model.terms`), with
those of a discrepancy (`residual.Contrasts`). A calibration does not remove noise: the angle random walk N√t and, for
every process x that drives the angle at the rate g(t)·x (`model.noise`), the variance of `∫ g x dt` over a mission
that begins with the process in its stationary state.
"""

from collections.abc import Sequence
from itertools import pairwise
from typing import NamedTuple

import numpy as np
from jaxtyping import Float, Int

from gradcal_jax.information.residual import Contrasts
from gradcal_jax.model import AXIS_NAMES, Channel, Discrepancy, GradientOfBias, Map, Nodes, Processes, SharedNodes
from gradcal_jax.motion import quadrature

# Gauss nodes on each straight line: exact for quintic by quintic maps times the rate.
_NODES = 6
# Least number of lines in a mission (maps bend along a line); number of lines that are summed at once.
_LINES, _AT_ONCE = 256, 8192
# Cells in which a process's gain is constant: least number, number per correlation time, largest number.
_CELLS, _A_TIME, _MOST_CELLS = 2000, 20.0, 200_000


class Flight(NamedTuple):
    """Straight lines between `time` s (from 0, increasing), `rate` rad/s, `temperature` °C of the sensor."""

    time: Float[np.ndarray, " n"]
    rate: Float[np.ndarray, " n"]
    temperature: Float[np.ndarray, " n"]

    def angle(self, at: Float[np.ndarray, " k"]) -> Float[np.ndarray, " k"]:
        """`∫ω dt` from the beginning to the times `at`, rad."""
        whole = np.concatenate([[0.0], np.cumsum(np.diff(self.time) * (self.rate[1:] + self.rate[:-1]) / 2.0)])
        k = np.clip(np.searchsorted(self.time, at, side="right") - 1, 0, len(self.time) - 2)
        rate = np.interp(at, self.time, self.rate)
        return whole[k] + (at - self.time[k]) * (rate + self.rate[k]) / 2.0


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


def own_variance(
    flight: Flight, processes: Processes, members: Sequence[int] | Int[np.ndarray, " m"], time: float
) -> float:
    """Variance (rad²) that processes add to the integrated rate from the mission's beginning to `time` (s)."""
    from scipy.signal import lfilter

    at = np.array(members, dtype=int)
    fastest = float(np.max(np.asarray(processes.decay)[at], initial=0.0))
    count = int(np.clip(_A_TIME * time * fastest, _CELLS, _MOST_CELLS))
    edges = np.linspace(0.0, time, count + 1)
    step, turned = time / count, np.diff(flight.angle(edges))
    variance = 0.0
    for k in at:
        gain = float(processes.bias_gain[k]) + float(processes.rate_gain[k]) * turned / step
        initial, decay, drive = (float(of[k]) for of in (processes.initial_std, processes.decay, processes.diffusion))
        if decay == 0.0:
            still = np.cumsum(gain[::-1])[::-1] - gain / 2.0
            variance += (initial * step * np.sum(gain)) ** 2 + drive**2 * step**3 * float(still @ still)
            continue
        kept = np.exp(-decay * step)
        earlier = np.asarray(lfilter([0.0, 1.0], [1.0, -kept], gain))
        within, between = 2.0 * (decay * step - 1.0 + kept), 2.0 * (1.0 - kept) ** 2
        variance += (initial / decay) ** 2 * float(within * gain @ gain + between * gain @ earlier)
    return variance
