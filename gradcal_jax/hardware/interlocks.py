"""Interlocks: conditions that pause or abort a run.

A rule examines the situation and returns a sentence where it is violated. A violation that lasts longer than the rule's
patience trips it: the run pauses or aborts, and the sentence goes into the journal. The rules hold in every state of a
run: while it homes axes, waits, is paused, or runs. A run that is paused can only be aborted.
"""

import math
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from functools import partial
from typing import Final, Literal

from .axis_control import too_fast
from .roles import AxisReading, ChamberReading

Action = Literal["pause", "abort"]
# A short opening of the door does not trip a rule.
_PATIENCE_S = 30.0


@dataclass(frozen=True)
class Situation:
    """The newest readings, and what was commanded. `imu_age_s`: time since each unit's last bytes. `course_c`: the
    recipe's lowest and highest temperature of the air over the last while, None before the first command. `range_c`:
    the temperatures that the chamber reports as its limits, and that of its air at the start. `conditions`: whether the
    chamber was commanded to condition. `allowed_dps`: the rates allowed to an axis now by its commands and by the rig.
    `stalled`: what axes stand that should have arrived. `paused_s`: how long the run has been paused, None where it is
    not; `by_itself`: by a rule."""

    time_s: float
    chamber: ChamberReading | None
    axes: Mapping[str, AxisReading]
    imu_age_s: Mapping[str, float]
    free_bytes: int
    course_c: tuple[float, float] | None
    allowed_dps: Mapping[str, tuple[float, float]]
    range_c: tuple[float, float] = (-math.inf, math.inf)
    conditions: bool = False
    stalled: tuple[str, ...] = ()
    paused_s: float | None = None
    by_itself: bool = False


@dataclass(frozen=True)
class InterlockLimits:
    """The limits of the rules, and of a step's execution; an infinite one switches a rule off.

    The air may be `temperature_band_k` off its course, and `temperature_lag_s` behind it; in a pause it may go to
    `room_c`, where the chamber's door is open. Air and load are never above `never_above_c` or below `never_below_c`. A
    pause by a rule may last `longest_pause_s`. A step is not executed as written if a command is, or a turn ends,
    `latest_s` late, or if it lacks more than `lost_share` of a unit's samples.
    """

    temperature_band_k: float = 3.0
    temperature_lag_s: float = 300.0
    room_c: float = 23.0
    never_above_c: float = math.inf
    never_below_c: float = -math.inf
    longest_pause_s: float = 1800.0
    latest_s: float = 1.0
    lost_share: float = 0.02
    imu_stale_s: float = 2.0
    free_bytes: int = 200_000_000


def _alarm(bounds: InterlockLimits, now: Situation) -> str:
    alarms = () if now.chamber is None else now.chamber.alarms
    return f"the chamber reports alarm {', '.join(alarms)}: see its manual" if alarms else ""


def _faults(bounds: InterlockLimits, now: Situation) -> str:
    return "; ".join(f"axis {name}: {', '.join(axis.faults)}" for name, axis in now.axes.items() if axis.faults)


def _over_speed(bounds: InterlockLimits, now: Situation) -> str:
    return "; ".join(
        (
            f"axis {name} turns at {now.axes[name].rate_dps:.1f} deg/s; its command was {told:g}, and the rig "
            f"allows {most:g}"
        )
        for name, (told, most) in now.allowed_dps.items()
        if name in now.axes and too_fast(now.axes[name].rate_dps, (told, most))
    )


def _limit(bounds: InterlockLimits, now: Situation) -> str:
    band_k, chamber = bounds.temperature_band_k, now.chamber
    margin = band_k if math.isfinite(band_k) else 0.0
    lowest, highest = now.range_c[0] - margin, now.range_c[1] + margin
    lowest, highest = max(bounds.never_below_c, lowest), min(bounds.never_above_c, highest)
    for what, value in () if chamber is None else (("air", chamber.air_c), ("load", chamber.product_c)):
        if value is not None and not lowest <= value <= highest:
            return f"the {what} is at {value:.1f} degC; its limits are {lowest:g} to {highest:g} degC"
    return ""


def _off_course(bounds: InterlockLimits, now: Situation, *, paused: bool) -> str:
    """A sentence where the air is off its course. A pause may open the door: then the room belongs to the course."""
    if now.chamber is None or now.course_c is None:
        return ""
    low, high = now.course_c
    if paused:
        low, high = min(low, bounds.room_c), max(high, bounds.room_c)
    air = now.chamber.air_c
    away = min(air - low, 0.0) or max(air - high, 0.0)
    if (now.paused_s is not None) is not paused or abs(away) <= bounds.temperature_band_k:
        return ""
    return (
        f"the air is at {air:.1f} degC, {away:+.1f} K from the temperature profile of the last "
        f"{bounds.temperature_lag_s:g} s; the rig allows {bounds.temperature_band_k:g} K"
    )


def _long_pause(bounds: InterlockLimits, now: Situation) -> str:
    if not now.by_itself or now.paused_s is None or now.paused_s < bounds.longest_pause_s:
        return ""
    return f"the run has been paused for {bounds.longest_pause_s / 60.0:g} min and nobody has resumed it"


def _idle_chamber(bounds: InterlockLimits, now: Situation) -> str:
    if now.chamber is None or not now.conditions or now.chamber.conditioning:
        return ""
    return (
        f"the chamber was commanded to condition and does not: mode {now.chamber.mode}, air at "
        f"{now.chamber.air_c:.1f} degC. Check its power, and whether somebody used its panel"
    )


def _stale(bounds: InterlockLimits, now: Situation) -> str:
    old = ", ".join(f"{name} for {age:.1f} s" for name, age in now.imu_age_s.items() if age > bounds.imu_stale_s)
    return f"no bytes from {old}" if old else ""


def _disk(bounds: InterlockLimits, now: Situation) -> str:
    return f"only {now.free_bytes / 1e6:.0f} MB are free on the disk" if now.free_bytes < bounds.free_bytes else ""


@dataclass(frozen=True)
class InterlockRule:
    """What happens where `look` returns a sentence for longer than it is borne."""

    name: str
    action: Action
    patience_s: float
    look: Callable[[InterlockLimits, Situation], str]


RULES: Final = (
    InterlockRule("chamber alarm", "abort", 0.0, _alarm),
    InterlockRule("axis fault", "abort", 0.0, _faults),
    InterlockRule("over-speed", "abort", 0.0, _over_speed),
    InterlockRule("stalled axis", "abort", 0.0, lambda bounds, now: "; ".join(now.stalled)),
    InterlockRule("temperature limit", "abort", 0.0, _limit),
    InterlockRule("temperature in a pause", "abort", _PATIENCE_S, partial(_off_course, paused=True)),
    InterlockRule("longest pause", "abort", 0.0, _long_pause),
    InterlockRule("temperature course", "pause", _PATIENCE_S, partial(_off_course, paused=False)),
    InterlockRule("idle chamber", "pause", _PATIENCE_S, _idle_chamber),
    InterlockRule("stale unit", "pause", 0.0, _stale),
    InterlockRule("disk space", "pause", 0.0, _disk),
)
"""The rules of every run."""


@dataclass
class Interlocks:
    limits: InterlockLimits = field(default_factory=InterlockLimits)
    rules: tuple[InterlockRule, ...] = RULES
    _since: dict[str, float] = field(default_factory=dict[str, float])

    def check(self, situation: Situation) -> tuple[InterlockRule, str] | None:
        tripped: list[tuple[InterlockRule, str]] = []
        for rule in self.rules:
            text = rule.look(self.limits, situation)
            if not text:
                self._since.pop(rule.name, None)
            elif situation.time_s - self._since.setdefault(rule.name, situation.time_s) >= rule.patience_s:
                tripped.append((rule, text))
        return min(tripped, key=lambda pair: pair[0].action != "abort", default=None)

    def forget(self) -> None:
        self._since.clear()
