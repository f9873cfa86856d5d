"""Interlocks: conditions that pause or abort a run.

A rule examines the situation and returns a sentence where it is violated. A violation that lasts longer than the rule's
patience trips it: the run pauses or aborts, and the sentence goes into the journal. The rules hold in every state of a
run: while it homes axes, waits, is paused, or runs. A run that is paused can only be aborted.
"""

import math
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from typing import Literal

from .axis_control import too_fast
from .roles import AxisReading, ChamberReading

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
class InterlockRule:
    """`look` returns a sentence when something is wrong, else an empty text."""

    name: str
    action: Literal["pause", "abort"]
    patience_s: float
    look: Callable[[Situation], str]


@dataclass(frozen=True)
class InterlockLimits:
    """The limits of the standard rules, and of a step's execution; None switches a rule off.

    The air may be `temperature_band_k` off its course, and `temperature_lag_s` behind it; in a pause it may go to
    `room_c`, where the chamber's door is open. Air and load are never above `never_above_c` or below `never_below_c`. A
    pause by a rule may last `longest_pause_s`. A step is not executed as written if a command is, or a turn ends,
    `latest_s` late, or if it lacks more than `lost_share` of a unit's samples.
    """

    temperature_band_k: float | None = 3.0
    temperature_lag_s: float = 300.0
    room_c: float = 23.0
    never_above_c: float = math.inf
    never_below_c: float = -math.inf
    longest_pause_s: float = 1800.0
    latest_s: float = 1.0
    lost_share: float = 0.02
    imu_stale_s: float | None = 2.0
    free_bytes: int = 200_000_000


@dataclass
class Interlocks:
    """Rules, with the time since when each has been violated."""

    rules: tuple[InterlockRule, ...]
    limits: InterlockLimits = field(default_factory=InterlockLimits)
    _since: dict[str, float] = field(default_factory=dict[str, float])

    def check(self, situation: Situation) -> tuple[InterlockRule, str] | None:
        """The first rule that trips, with its sentence; aborts before pauses."""
        tripped: list[tuple[InterlockRule, str]] = []
        for rule in self.rules:
            text = rule.look(situation)
            if not text:
                self._since.pop(rule.name, None)
            elif situation.time_s - self._since.setdefault(rule.name, situation.time_s) >= rule.patience_s:
                tripped.append((rule, text))
        return min(tripped, key=lambda pair: pair[0].action != "abort", default=None)

    def forget(self) -> None:
        """Restart the patience of every rule, after a pause."""
        self._since.clear()


def standard_rules(limits: InterlockLimits | None = None) -> Interlocks:
    """The rules of every run."""
    bounds = limits or InterlockLimits()

    def alarm(now: Situation) -> str:
        if now.chamber is None or not now.chamber.alarms:
            return ""
        return f"the chamber reports alarm {', '.join(now.chamber.alarms)}: see its manual"

    def faults(now: Situation) -> str:
        texts = [f"axis {name}: {', '.join(reading.faults)}" for name, reading in now.axes.items() if reading.faults]
        return "; ".join(texts)

    def over_speed(now: Situation) -> str:
        texts = [
            f"axis {name} turns at {now.axes[name].rate_dps:.1f} deg/s; it was told {allowed[0]:g} and the rig allows "
            f"{allowed[1]:g}"
            for name, allowed in now.allowed_dps.items()
            if name in now.axes and too_fast(now.axes[name].rate_dps, allowed)
        ]
        return "; ".join(texts)

    def stalled(now: Situation) -> str:
        return "; ".join(now.stalled)

    def limit(now: Situation) -> str:
        if now.chamber is None:
            return ""
        margin = bounds.temperature_band_k or 0.0
        lowest = max(bounds.never_below_c, now.range_c[0] - margin)
        highest = min(bounds.never_above_c, now.range_c[1] + margin)
        for what, value in (("air", now.chamber.air_c), ("load", now.chamber.product_c)):
            if value is not None and not lowest <= value <= highest:
                return f"the {what} is at {value:.1f} degC; it is never to leave {lowest:g} to {highest:g} degC"
        return ""

    def course(now: Situation) -> str:
        return "" if now.paused_s is not None else _off_course(now, bounds)

    def course_in_a_pause(now: Situation) -> str:
        return "" if now.paused_s is None else _off_course(now, bounds)

    def idle_chamber(now: Situation) -> str:
        if now.chamber is None or not now.conditions or now.chamber.conditioning:
            return ""
        return (
            f"the chamber was commanded to condition and does not: mode {now.chamber.mode}, air at "
            f"{now.chamber.air_c:.1f} degC. Look for a power cut, or a hand at its panel"
        )

    def long_pause(now: Situation) -> str:
        if not now.by_itself or now.paused_s is None or now.paused_s < bounds.longest_pause_s:
            return ""
        return f"the run has been paused for {bounds.longest_pause_s / 60.0:g} min and nobody has resumed it"

    def stale(now: Situation) -> str:
        if bounds.imu_stale_s is None:
            return ""
        old = [f"{name} for {age:.1f} s" for name, age in now.imu_age_s.items() if age > bounds.imu_stale_s]
        return f"no bytes from {', '.join(old)}" if old else ""

    def disk(now: Situation) -> str:
        if now.free_bytes >= bounds.free_bytes:
            return ""
        return f"only {now.free_bytes / 1e6:.0f} MB are free on the disk"

    return Interlocks(
        (
            InterlockRule("chamber alarm", "abort", 0.0, alarm),
            InterlockRule("axis fault", "abort", 0.0, faults),
            InterlockRule("over-speed", "abort", 0.0, over_speed),
            InterlockRule("stalled axis", "abort", 0.0, stalled),
            InterlockRule("temperature limit", "abort", 0.0, limit),
            InterlockRule("temperature in a pause", "abort", _PATIENCE_S, course_in_a_pause),
            InterlockRule("longest pause", "abort", 0.0, long_pause),
            InterlockRule("temperature course", "pause", _PATIENCE_S, course),
            InterlockRule("idle chamber", "pause", _PATIENCE_S, idle_chamber),
            InterlockRule("stale unit", "pause", 0.0, stale),
            InterlockRule("disk space", "pause", 0.0, disk),
        ),
        bounds,
    )


def _off_course(now: Situation, bounds: InterlockLimits) -> str:
    """A sentence where the air is off its course. A pause may open the door: then the room belongs to the course."""
    if now.chamber is None or bounds.temperature_band_k is None or now.course_c is None:
        return ""
    low, high = now.course_c
    if now.paused_s is not None:
        low, high = min(low, bounds.room_c), max(high, bounds.room_c)
    air = now.chamber.air_c
    away = min(air - low, 0.0) or max(air - high, 0.0)
    if abs(away) <= bounds.temperature_band_k:
        return ""
    return (
        f"the air is at {air:.1f} degC, {away:+.1f} K from the recipe's course of the last "
        f"{bounds.temperature_lag_s:g} s; the rig allows {bounds.temperature_band_k:g} K"
    )
