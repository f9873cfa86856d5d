"""Points of a log of the standard method: stable temperatures with held rates.

A plateau is an unbroken run of rows at a planned rate of the table and a planned temperature of the sensor. Unplanned
plateaus are unbroken runs at any held rate and stable temperature (a soak between two temperatures is not stable). The
last `integration` seconds of each run count; before them are the soak and the settling of the table.
The error of the reference rate is common to a plateau; drifts, clock and turn-on bias continue through the run, unless
the plan takes its points as independent.
"""

from itertools import pairwise
from typing import NamedTuple

import numpy as np
from scipy.ndimage import maximum_filter1d, minimum_filter1d, uniform_filter1d

from gradcal_jax.formulas import runs
from gradcal_jax.motion import Trajectory, held
from gradcal_jax.motion.schedule import Points

# Tolerance of a table at a set point: relative, and rad/s.
_RATE_TOLERANCE = (0.02, np.radians(0.5))
_LEAST_SHARE = 0.5
# A held rate stays within the tolerance for this time (s); a stable temperature changes by less than this, K.
_HELD_OVER_S, _STABLE_K = 1.0, 1.0


class TablePoints(NamedTuple):
    """The executed points of a table: `line` of `P` pieces, between points gaps; `rows` `(P + 1,)`: piece k is rows
    `rows[k] + 1 … rows[k+1]`. `missing`: planned points
    (°C, rad/s) that the log lacks; `unplanned`: the number of its points that are not in the plan."""

    line: Trajectory
    rows: np.ndarray
    missing: tuple[tuple[float, float], ...] = ()
    unplanned: int = 0

    @property
    def sentences(self) -> list[str]:
        """In words, where log and plan have other points."""
        said: list[str] = []
        if self.missing:
            t, w = self.missing[0]
            said.append(
                f"{len(self.missing)} of the plan's points are not in the log, the first at {t:g} degC and "
                f"{np.degrees(w):.4g} deg/s"
            )
        if self.unplanned:
            said.append(
                f"the log has {self.unplanned} points, at constant rates and stable temperatures, that are not in "
                "the plan: they are used"
            )
        return said


def plateaus(
    time_s: np.ndarray,
    temperature_c: np.ndarray,
    table_rate_rad_per_s: np.ndarray,
    usable: np.ndarray,
    planned_c: np.ndarray,
    planned_rad_per_s: np.ndarray,
    integration_s: float,
    *,
    points: Points = "one run",
) -> TablePoints:
    """Find the points of a log's rows, arrays `(n,)`: the planned ones, and others at held rates and stable
    temperatures. `points`: whether they share the run's noise. Errors: `ValueError` where there is none.
    """
    warm = _nearest(temperature_c, planned_c, _temperature_tolerance(planned_c))
    fast = _nearest(
        table_rate_rad_per_s,
        planned_rad_per_s,
        np.maximum(_RATE_TOLERANCE[0] * np.abs(planned_rad_per_s), _RATE_TOLERANCE[1]),
    )
    label = np.where((warm >= 0) & (fast >= 0), warm * len(planned_rad_per_s) + fast, -1)
    # If the plan has no point at rest, the table stands only during soaks.
    soaking = (np.abs(table_rate_rad_per_s) < _RATE_TOLERANCE[1]) & bool(np.all(planned_rad_per_s != 0.0))
    others = _held_elsewhere(time_s, table_rate_rad_per_s, (label < 0) & ~soaking)
    label = np.where(others >= 0, others + len(planned_c) * len(planned_rad_per_s), label)
    begins = np.flatnonzero(np.concatenate([[True], (np.diff(label) != 0) | ~usable[1:]]))
    ends = np.append(begins[1:], len(label)) - 1
    first, last = [], []
    for a, b in zip(begins, ends, strict=True):
        if label[a] < 0 or time_s[b] - time_s[a] < _LEAST_SHARE * integration_s:
            continue
        start = int(np.searchsorted(time_s[a : b + 1], time_s[b] - integration_s * (1 + 1e-9))) + int(a)
        if others[b] >= 0 and np.ptp(temperature_c[start : b + 1]) > _STABLE_K:
            continue
        first.append(start)
        last.append(int(b))
    if not first:
        raise ValueError(
            "the log has none of the plan's points, and no rate at a stable temperature for "
            f"{_LEAST_SHARE * integration_s:g} s or longer: state the integration time of the recording in the spec"
        )
    present = {int(label[b]) for b in last}
    missing = tuple(
        (float(planned_c[k // len(planned_rad_per_s)]), float(planned_rad_per_s[k % len(planned_rad_per_s)]))
        for k in range(len(planned_c) * len(planned_rad_per_s))
        if k not in present
    )
    rows, broken = [first[0]], []
    for a, b in zip(first, last, strict=True):
        if a != rows[-1]:
            rows.append(a)
            broken.append(True)
        rows.append(b)
        broken.append(False)
    at, between = np.array(rows), np.array(broken)
    step = np.diff(time_s, prepend=time_s[0])

    def mean(values: np.ndarray) -> np.ndarray:
        return np.array([np.average(values[i + 1 : j + 1], weights=step[i + 1 : j + 1]) for i, j in pairwise(rows)])

    temperature = mean(temperature_c)
    line = held(
        time_s[at[:-1]], np.diff(time_s[at]), np.where(between, 0.0, mean(table_rate_rad_per_s)), temperature,
        temperature, read=~between, at_rest=between, moving=~between, gap=between, rates=True, points=points,
    )  # fmt: skip
    return TablePoints(line, at, missing, int(np.count_nonzero(others[last] >= 0)))


def _held_elsewhere(time: np.ndarray, rate: np.ndarray, free: np.ndarray) -> np.ndarray:
    """`(n,)`: the number of the run of rows at one rate among the free ones, or −1."""
    width = max(round(_HELD_OVER_S * (len(time) - 1) / (time[-1] - time[0])), 2)
    smooth = uniform_filter1d(rate, width)
    high, low = maximum_filter1d(smooth, width), minimum_filter1d(smooth, width)
    tolerance = np.maximum(_RATE_TOLERANCE[0] * np.abs(smooth), _RATE_TOLERANCE[1])
    result = np.full(len(time), -1)
    for number, (start, end) in enumerate(runs(free & (high - low < tolerance))):
        result[start:end] = number
    return result


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
