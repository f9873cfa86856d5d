"""The bias of a sensor in a record over the path of its temperature."""

from typing import NamedTuple

import numpy as np

from gradcal_jax.estimation import ImuEstimate, ImuReadings
from gradcal_jax.information import segments_of
from gradcal_jax.model import BIAS, OwnTerm


class BiasCurve(NamedTuple):
    """The bias of a channel at the rows at rest, in order of time, `(n,)`, SI: as `measured`, less all other terms of
    the model; by the `model` with its path terms; the model's standard deviation `std` by the fit; the `map` alone."""

    channel: str
    si_unit: str
    temperature_c: np.ndarray
    measured: np.ndarray
    model: np.ndarray
    std: np.ndarray
    map: np.ndarray


def bias_curves(readings: ImuReadings, solution: ImuEstimate) -> tuple[BiasCurve, ...]:
    """The bias of every channel with a bias term, over the path of the temperature. Errors: none."""
    model, motion = readings.model, readings.done.motion
    at, line = segments_of(motion, model), motion.line
    apart = readings.observed - readings.expected(solution.parameters)
    lasting, warm = at.sums(line.duration), at.sums(line.duration * np.mean(line.ends(), axis=0))
    curves: list[BiasCurve] = []
    for i, (c, columns) in enumerate(zip(model.channels, model.own_columns(readings.nominal()), strict=True)):
        terms = [t for t in c.terms if t.name == BIAS or (isinstance(t, OwnTerm) and not t.signals)]
        rows = solution.used & (at.row_channel == i) & (at.axis[at.row_segment] < 0)
        if not terms or not np.any(rows):
            continue
        kept, where = np.zeros(c.size, bool), model.where(c.kind, c.axis)
        for term in terms:
            kept[c.where(term.name)] = True
        segments = at.row_segment[rows]
        mean = at.sums(columns * kept)[segments] / lasting[segments, None]
        fitted = mean @ solution.parameters[where]
        std = np.linalg.norm(mean @ solution.known.spread[where], axis=1)
        unit = "rad/s" if c.kind == "gyro" else "m/s^2"
        measured = fitted + apart[rows] / lasting[segments]
        of_map = np.zeros(c.size, bool)
        of_map[c.where(BIAS)] = True
        alone = (mean * of_map) @ solution.parameters[where]
        curves.append(BiasCurve(c.name, unit, warm[segments] / lasting[segments], measured, fitted, std, alone))
    return tuple(curves)
