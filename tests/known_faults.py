"""Which specs today's code is known to predict wrongly, and why. What is mended is struck out here."""

import jax.numpy as jnp
import numpy as np
from gradcal_jax.api.knowledge import timeline_of
from gradcal_jax.errormodel import Polynomial

from gradcal_jax.api.build import assemble
from gradcal_jax.files import Spec
from gradcal_jax.files.schedule import StandardSchedule

SHARED = "standard points share the run"
SMOOTHNESS = "smoothness with one polynomial axis"
TURNING = "bins or B-spline: a turning point within a panel is missed"
AXES = "several axes, read while others turn"
LAG = "the lag's decay within a piece is longer than its quadrature follows"

INTEGRALS = {TURNING, LAG}
"""Where the program does not do what its timeline says; with the others its timeline agrees."""


def changing(spec: Spec) -> list[str]:
    """Why the number of a spec is known to be wrong as the code stands; empty where it is right."""
    sensor, built = spec.sensor, assemble(spec)
    standard = isinstance(spec.schedule, StandardSchedule)
    found = []
    if standard and built.model.processes.count and len(spec.schedule.points) > 1:
        found.append(SHARED)
    if not standard and spec.gradient_schedule.cycle is not None:
        cycle = spec.gradient_schedule.cycle
        if len(built.channels) > 1 and cycle.other_read_every is not None:
            found.append(AXES)
    maps = [m for m in (built.model.bias, built.model.scale) if m is not None]
    if any(m.has_smoothness and _polynomial_axes(m) == 1 and m.rate is not None for m in maps):
        found.append(SMOOTHNESS)
    lag = sensor.thermal_lag
    for channel in built.channels:
        line = timeline_of(built, channel)
        if TURNING not in found and any(_missed(line, m, np.asarray(line.moving)) for m in maps):
            found.append(TURNING)
        if LAG not in found and lag is not None and _coarse(line):
            found.append(LAG)
    return found


def _polynomial_axes(of) -> int:
    return sum(isinstance(b, Polynomial) for b in (of.temperature, of.rate))


def _missed(line, of, moving: np.ndarray) -> bool:
    """Whether a panel of the quadrature crosses a break more often than its ends say."""
    rate_breaks = () if of.rate is None else of.rate.breaks
    pieces = np.flatnonzero(moving) if of.rate is not None else np.arange(len(moving))
    panels = 8 if rate_breaks else 1
    fine = np.linspace(0.0, 1.0, panels * 64 + 1)
    grid = jnp.broadcast_to(jnp.asarray(fine), (len(pieces), len(fine)))
    for variable, breaks in ((line.temperature, of.temperature.breaks), (line.rate, rate_breaks)):
        if not breaks or not len(pieces):
            continue
        values = np.asarray(variable(grid, pieces))
        for level in breaks:
            crossings = np.diff((values >= level).astype(int), axis=1) != 0
            if np.any(crossings.reshape(len(pieces), panels, 64).sum(axis=2) > 1):
                return True
    return False


def _coarse(line) -> bool:
    """Whether 16 Gauss-Legendre nodes a piece miss a lagged temperature's cube by more than rounding."""
    whole = []
    for count in (16, 64):
        x, w = np.polynomial.legendre.leggauss(count)
        nodes = jnp.broadcast_to(jnp.asarray((x + 1.0) / 2.0), (line.piece_count, count))
        whole.append((np.asarray(line.temperature(nodes)) / 50.0) ** 3 @ (w / 2.0))
    return bool(
        np.max(np.abs(whole[0] - whole[1])[~np.isin(np.arange(line.piece_count), line.gap_pieces.values)]) > 1e-12
    )
