"""Interlocks: conditions that pause or abort a run.

A rule examines the situation and returns a sentence where it is violated. A violation that lasts longer than the rule's
patience trips it: the run pauses or aborts, and the sentence goes into the journal.
"""

from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from typing import Literal

from .axis_control import too_fast
from .roles import AxisReading, ChamberReading

# A short opening of the door does not trip a rule.
_PATIENCE_S = 30.0


@dataclass(frozen=True)
class Situation:
    """The newest readings. `imu_age_s`: time since each unit's last bytes. `course_c`: the recipe's lowest and highest
    temperature of the air over the last while, None while the chamber goes to a set point as fast as it can.
    `allowed_dps`: the rates allowed to an axis now by its commands and by the rig."""

    time_s: float
    chamber: ChamberReading | None
    axes: Mapping[str, AxisReading]
    imu_age_s: Mapping[str, float]
    free_bytes: int
    course_c: tuple[float, float] | None
    allowed_dps: Mapping[str, tuple[float, float]]


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

    The air may be `temperature_band_k` off its course, and `temperature_lag_s` behind it. A step is not executed as
    written if a command is, or a turn ends, `latest_s` late, or if it lacks more than `lost_share` of a unit's samples.
    """

    temperature_band_k: float | None = 3.0
    temperature_lag_s: float = 300.0
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
    """Chamber alarm, faults and over-speed of axes, course of the temperature, stale units, disk space."""
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

    def course(now: Situation) -> str:
        if now.chamber is None or bounds.temperature_band_k is None or now.course_c is None:
            return ""
        low, high = now.course_c
        air = now.chamber.air_c
        away = min(air - low, 0.0) or max(air - high, 0.0)
        if abs(away) <= bounds.temperature_band_k:
            return ""
        return (
            f"the air is at {air:.1f} degC, {away:+.1f} K from the recipe's course of the last "
            f"{bounds.temperature_lag_s:g} s; the rig allows {bounds.temperature_band_k:g} K"
        )

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
            InterlockRule("temperature course", "pause", _PATIENCE_S, course),
            InterlockRule("stale unit", "pause", 0.0, stale),
            InterlockRule("disk space", "pause", 0.0, disk),
        ),
        bounds,
    )
