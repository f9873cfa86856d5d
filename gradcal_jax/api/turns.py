"""Turns by hand in a log: from a list of the turns, the table angle and the standstills that `estimate` needs.

Standstills are detected in the rates; the integrated rate between two of them must agree with the listed turns, in
their order, to a fifth. The angle at rest is then the sum of the listed turns; during a turn it is not known.
"""

import itertools
from collections.abc import Sequence
from dataclasses import replace
from typing import NamedTuple

import numpy as np

from gradcal_jax import estimation
from gradcal_jax.files.log import Log, LogError

# Relative tolerance of the sensed turn; smallest angle between two rests that is a turn, rad.
_LIKE, _JOLT = 0.2, np.radians(5.0)


class Turn(NamedTuple):
    """One turn from rest to rest (s): its listed angle, and the integrated rate less its bias (rad)."""

    begin_s: float
    end_s: float
    listed_rad: float
    sensed_rad: float


def with_turns(
    log: Log, turns_rad: Sequence[float], *, axis: str | int = 0, unit: str | int = 0
) -> tuple[Log, list[Turn]]:
    """The log with the table's angle about an axis and its standstills, and the turns of `turns_rad` with their times.

    **Raises:** `LogError` where the record has other turns than `turns_rad`, with a list of its turns.
    """
    index, column = log.unit_index(unit), log.axis_index(axis)
    name, usable = log.axes[column], log.usable(index)
    number = estimation.find_standstills(log.rate_rad_per_s[index], log.sample_interval_s, valid=usable)
    rate = np.nan_to_num(log.rate_rad_per_s[index, :, column])
    rest_rows = [np.flatnonzero(number == k) for k in range(int(number.max()) + 1)]
    turned = np.cumsum(rate * np.diff(log.time_s, prepend=log.time_s[0]))
    angle = np.full(len(rate), np.nan)
    angle[rest_rows[0]] = total = 0.0
    turns: list[Turn] = []
    unlike = None
    for before, after in itertools.pairwise(rest_rows):
        first, last = int(before[-1]), int(after[0])
        bias = float(np.mean(rate[np.concatenate([before, after])]))
        sensed = float(turned[last] - turned[first] - bias * (log.time_s[last] - log.time_s[first]))
        if abs(sensed) > _JOLT:
            listed_rad = float(turns_rad[len(turns)]) if len(turns) < len(turns_rad) else 0.0
            turns.append(Turn(float(log.time_s[first]), float(log.time_s[last]), listed_rad, sensed))
            if unlike is None and not abs(sensed - listed_rad) <= _LIKE * abs(listed_rad):
                unlike = len(turns)
            total += listed_rad
        angle[after] = total
    if len(turns) != len(turns_rad) or unlike is not None:
        listed = ", ".join(f"{np.degrees(turn.sensed_rad):.0f} deg at {turn.begin_s:.4g} s" for turn in turns[:40])
        wrong = (
            f"turn {unlike} is listed as {np.degrees(turns[unlike - 1].listed_rad):.0f} deg"
            if unlike is not None and unlike <= len(turns_rad)
            else f"{len(turns_rad)} turns are listed"
        )
        raise LogError(f"{wrong}, and about {name} the sensor has {listed or 'none'}: are order, signs and axis right?")
    marked = replace(
        log, table_axes=(name,), table_angle_rad=angle[:, None], table_rate_rad_per_s=None, standstill=number
    )
    return marked, turns
