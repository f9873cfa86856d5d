"""A log of turns by hand -> the angle and rest columns that `estimate` wants: the turns are said, their times found.

Standstills are found in the rates; what the sensor turned between two of them must be one of the turns that were said,
in their order, to a fifth. The angle at rest is then the sum of the turns said; on the move it is not known.
"""

import itertools
from collections.abc import Sequence
from dataclasses import replace
from typing import NamedTuple

import numpy as np

from gradcal_jax import estimation
from gradcal_jax.files.log import Log, LogError

# Of a turn, by which the sensor may be off; and rad, of a jolt between two rests that is no turn.
_LIKE, _JOLT = 0.2, np.radians(5.0)


class Turn(NamedTuple):
    """One turn, s and rad: from rest to rest, as it was said and as the sensor has it, its bias taken off."""

    begin_s: float
    end_s: float
    said_rad: float
    sensed_rad: float


def with_turns(
    log: Log, turns_rad: Sequence[float], *, axis: str | int = 0, unit: str | int = 0
) -> tuple[Log, list[Turn]]:
    """The log with the table's angle about an axis and its standstills, and the turns as they were found.

    **Raises:** `LogError` where the record has other turns than those said, with a list of what it has.
    """
    index, column = log.unit_index(unit), log.axis_index(axis)
    name, usable = log.axes[column], log.usable(index)
    number = estimation.find_standstills(log.rate_rad_per_s[index], log.sample_interval_s, valid=usable)
    rate = np.nan_to_num(log.rate_rad_per_s[index, :, column])
    rest_rows = [np.flatnonzero(number == k) for k in range(int(number.max()) + 1)]
    turned = np.concatenate([[0.0], np.cumsum(rate * np.diff(log.time_s, prepend=log.time_s[0]))])
    angle = np.full(len(rate), np.nan)
    angle[rest_rows[0]] = total = 0.0
    found: list[Turn] = []
    unlike = None
    for before, after in itertools.pairwise(rest_rows):
        first, last = int(before[-1]), int(after[0])
        bias = float(np.mean(rate[np.concatenate([before, after])]))
        sensed = float(turned[last + 1] - turned[first + 1] - bias * (log.time_s[last] - log.time_s[first]))
        if abs(sensed) > _JOLT:
            said = float(turns_rad[len(found)]) if len(found) < len(turns_rad) else 0.0
            found.append(Turn(float(log.time_s[first]), float(log.time_s[last]), said, sensed))
            if unlike is None and not abs(sensed - said) <= _LIKE * abs(said):
                unlike = len(found)
            total += said
        angle[after] = total
    if len(found) != len(turns_rad) or unlike is not None:
        listed = ", ".join(f"{np.degrees(turn.sensed_rad):.0f} deg at {turn.begin_s:.4g} s" for turn in found[:40])
        wrong = (
            f"turn {unlike} was said to be {np.degrees(found[unlike - 1].said_rad):.0f} deg"
            if unlike is not None and unlike <= len(turns_rad)
            else f"{len(turns_rad)} turns were said"
        )
        raise LogError(f"{wrong}, and about {name} the sensor has {listed or 'none'}: are order, signs and axis right?")
    marked = replace(
        log, table_axes=(name,), table_angle_rad=angle[:, None], table_rate_rad_per_s=None, standstill=number
    )
    return marked, found
