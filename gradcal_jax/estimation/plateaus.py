"""Points of a log of the standard method: stable temperatures with held rates.

A plateau is an unbroken run of rows at a planned rate of the table and a planned temperature of the sensor. The last
`integration` seconds of each run count; before them are the soak and the settling of the table.
The error of the reference rate is common to a plateau; drifts, clock and turn-on bias continue through the run, unless
the plan takes its points as independent.
"""

from itertools import pairwise
from typing import NamedTuple

import numpy as np

from gradcal_jax.estimation.imu_rows import ExecutedImu, ImuRows, executed
from gradcal_jax.motion import Geometry, Trajectory, held
from gradcal_jax.motion.schedule import Points

# Tolerance of a table at a set point: relative, and rad/s.
_RATE_TOLERANCE = (0.02, np.radians(0.5))
_LEAST_SHARE = 0.5


class TablePoints(NamedTuple):
    """The executed points of a table: `line` of `P` pieces, between points gaps; `rows` `(P + 1,)`: piece k is rows
    `rows[k] + 1 … rows[k+1]`. `missing`: planned points (°C, rad/s) that the log lacks."""

    line: Trajectory
    rows: np.ndarray
    missing: tuple[tuple[float, float], ...] = ()

    @property
    def sentences(self) -> list[str]:
        """In words, which planned points the log lacks."""
        if not self.missing:
            return []
        t, w = self.missing[0]
        return [
            f"{len(self.missing)} of the plan's points are not in the log, the first at {t:g} degC and "
            f"{np.degrees(w):.4g} deg/s"
        ]


def plateaus(
    log: ImuRows, planned_c: np.ndarray, planned_rad_per_s: np.ndarray, integration_s: float, points: Points = "one run"
) -> TablePoints:
    """The planned points among a log's rows, which have a `table_rate`. `points`: whether they share the run's noise.
    Errors: `ValueError` where there is none."""
    assert log.table_rate is not None
    time_s, rates = log.time_s, len(planned_rad_per_s)
    warm = _nearest(log.temperature_c, planned_c, _temperature_tolerance(planned_c))
    tolerance = np.maximum(_RATE_TOLERANCE[0] * np.abs(planned_rad_per_s), _RATE_TOLERANCE[1])
    fast = _nearest(log.table_rate, planned_rad_per_s, tolerance)
    label = np.where((warm >= 0) & (fast >= 0), warm * rates + fast, -1)
    begins = np.flatnonzero(np.concatenate([[True], (np.diff(label) != 0) | ~log.usable[1:]]))
    rows, between, present = list[int](), list[bool](), set[int]()
    for a, b in zip(begins.tolist(), (np.append(begins[1:], len(label)) - 1).tolist(), strict=True):
        if label[a] < 0 or time_s[b] - time_s[a] < _LEAST_SHARE * integration_s:
            continue
        start = int(np.searchsorted(time_s[a : b + 1], time_s[b] - integration_s * (1 + 1e-9))) + a
        if not rows or start != rows[-1]:
            between += [True] if rows else []
            rows.append(start)
        rows.append(b)
        between.append(False)
        present.add(int(label[b]))
    if not rows:
        raise ValueError(
            f"the log has none of the plan's points for {_LEAST_SHARE * integration_s:g} s or longer: state the "
            "temperatures, rates and integration time of the recording in the spec"
        )
    missing = tuple(
        (float(planned_c[k // rates]), float(planned_rad_per_s[k % rates]))
        for k in range(len(planned_c) * rates)
        if k not in present
    )
    at, gap = np.array(rows), np.array(between)
    step = np.diff(time_s, prepend=time_s[0])

    def mean(values: np.ndarray) -> np.ndarray:
        return np.array([np.average(values[i + 1 : j + 1], weights=step[i + 1 : j + 1]) for i, j in pairwise(rows)])

    temperature = mean(log.temperature_c)
    line = held(
        time_s[at[:-1]],
        np.diff(time_s[at]),
        np.where(gap, 0.0, mean(log.table_rate)),
        temperature,
        temperature,
        read=~gap,
        at_rest=gap,
        moving=~gap,
        gap=gap,
        rates=True,
        points=points,
    )
    return TablePoints(line, at, missing)


def motion_at_points(points: TablePoints, log: ImuRows, geometry: Geometry) -> ExecutedImu:
    """The motion of the points of the standard method, each at a held rate of the only axis."""
    line = points.line
    moving = np.asarray(line.moving)
    turned = np.where(moving, line.terms[:, 0], 0.0) * line.duration
    ways = tuple(np.linspace(0.0, way, 3) if moves else None for way, moves in zip(turned, moving, strict=True))
    return executed(log, geometry, line, points.rows, np.where(moving, 0, -1), ways, np.zeros(1))


def _temperature_tolerance(planned: np.ndarray) -> np.ndarray:
    """A third of the way to the nearest other planned temperature, 3 K at most."""
    apart = np.abs(planned[:, None] - planned[None])
    apart[apart == 0.0] = np.inf
    return np.minimum(apart.min(axis=1) / 3.0, 3.0)


def _nearest(values: np.ndarray, goals: np.ndarray, tolerance: np.ndarray) -> np.ndarray:
    """The nearest goal that each value is within the tolerance of, or −1."""
    result, nearest = np.full(len(values), -1), np.full(len(values), np.inf)
    for k in range(len(goals)):
        distance = np.abs(values - goals[k])
        closer = (distance <= tolerance[k]) & (distance < nearest)
        result[closer], nearest[closer] = k, distance[closer]
    return result
