"""Interlocks: conditions that end a run, and their limits.

A violation that lasts longer than its rule's patience trips the rule. The rules hold in every state of a run: while
it homes axes, waits, or runs. `axis_control`, `chamber_control` and `runner` say what is violated, by rule.
"""

import math
from dataclasses import dataclass
from typing import Final

from gradcal_jax.spec.rig import RigFile

# How long a rule may be violated before it trips, where that is not at once: a short opening of the door ends no run.
PATIENCE_S: Final = {"temperature course": 30.0, "idle chamber": 30.0}


@dataclass(frozen=True)
class InterlockLimits:
    """The limits of the rules, and of a step's execution; an infinite one switches a rule off.

    The air may be `temperature_band_k` off its course, and `temperature_lag_s` behind it. Air and load are never above
    `never_above_c` or below `never_below_c`. A step is not executed as written if a command is, or a turn ends,
    `latest_s` late, or if it lacks more than `lost_share` of a unit's samples.
    """

    temperature_band_k: float = 3.0
    temperature_lag_s: float = 300.0
    never_above_c: float = math.inf
    never_below_c: float = -math.inf
    latest_s: float = 1.0
    lost_share: float = 0.02
    imu_stale_s: float = 2.0
    free_bytes: float = 200e6


def limits_of(rig: RigFile) -> InterlockLimits:
    """Those of a rig file."""
    if (chamber := rig.chamber) is None:
        return InterlockLimits()
    limits = {
        "temperature_band_k": chamber.band,
        "temperature_lag_s": chamber.lag,
        "never_above_c": chamber.never_above,
        "never_below_c": chamber.never_below,
    }
    return InterlockLimits(**{name: float(limit) for name, limit in limits.items() if limit is not None})
