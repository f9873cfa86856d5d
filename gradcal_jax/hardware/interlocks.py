"""What a run watches while it runs, and what it does about it.

A rule looks at the situation and gives a sentence when it is not as it should be. Only what lasts longer than the
rule's patience trips it; then the run pauses or aborts, and the sentence goes into the journal.
"""

from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from typing import Literal

from .roles import AxisReading, ChamberReading


@dataclass(frozen=True)
class Situation:
    """The newest that is known. `imu_age_s`: time since each unit's last bytes."""

    time_s: float
    chamber: ChamberReading | None
    previous_chamber: ChamberReading | None
    axes: Mapping[str, AxisReading]
    imu_age_s: Mapping[str, float]
    free_bytes: int
    settled: bool


@dataclass(frozen=True)
class Rule:
    """`look` returns a sentence when something is wrong, else an empty text."""

    name: str
    action: Literal["pause", "abort"]
    patience_s: float
    look: Callable[[Situation], str]


@dataclass(frozen=True)
class Limits:
    """The numbers of the standard rules; what is None is not watched."""

    temperature_band_k: float | None = 3.0
    temperature_band_patience_s: float = 300.0
    temperature_slope_k_per_min: float | None = None
    imu_stale_s: float | None = 2.0
    free_bytes: int = 200_000_000


@dataclass
class Interlocks:
    """Rules with their memory of since when each has been violated."""

    rules: tuple[Rule, ...]
    _since: dict[str, float] = field(default_factory=dict[str, float])

    def check(self, situation: Situation) -> tuple[Rule, str] | None:
        """The first rule that has lost its patience, with its sentence; aborts before pauses."""
        tripped: list[tuple[Rule, str]] = []
        for rule in self.rules:
            text = rule.look(situation)
            if not text:
                self._since.pop(rule.name, None)
            elif situation.time_s - self._since.setdefault(rule.name, situation.time_s) >= rule.patience_s:
                tripped.append((rule, text))
        return min(tripped, key=lambda pair: pair[0].action != "abort", default=None)

    def forget(self) -> None:
        """After a pause: every rule has its patience back."""
        self._since.clear()


def standard_rules(limits: Limits | None = None) -> Interlocks:
    """Chamber alarm, faults of axes, band and slope of the temperature, stale units, disk space."""
    given = limits or Limits()

    def alarm(now: Situation) -> str:
        if now.chamber is None or not now.chamber.alarms:
            return ""
        return f"the chamber reports alarm {', '.join(now.chamber.alarms)}: see its manual"

    def faults(now: Situation) -> str:
        found = [f"axis {name}: {', '.join(reading.faults)}" for name, reading in now.axes.items() if reading.faults]
        return "; ".join(found)

    def band(now: Situation) -> str:
        if now.chamber is None or given.temperature_band_k is None or not now.settled:
            return ""
        away = now.chamber.air_c - now.chamber.setpoint_c
        if abs(away) <= given.temperature_band_k:
            return ""
        return f"the air is {away:+.1f} K from the set point, more than {given.temperature_band_k:g} K"

    def slope(now: Situation) -> str:
        before, after = now.previous_chamber, now.chamber
        if given.temperature_slope_k_per_min is None or before is None or after is None:
            return ""
        if after.time_s <= before.time_s:
            return ""
        per_min = (after.air_c - before.air_c) / (after.time_s - before.time_s) * 60.0
        if abs(per_min) <= given.temperature_slope_k_per_min:
            return ""
        return f"the air changes by {per_min:+.1f} K/min, more than {given.temperature_slope_k_per_min:g}"

    def stale(now: Situation) -> str:
        if given.imu_stale_s is None:
            return ""
        old = [f"{name} for {age:.1f} s" for name, age in now.imu_age_s.items() if age > given.imu_stale_s]
        return f"no bytes from {', '.join(old)}" if old else ""

    def disk(now: Situation) -> str:
        if now.free_bytes >= given.free_bytes:
            return ""
        return f"only {now.free_bytes / 1e6:.0f} MB are free on the disk"

    return Interlocks(
        (
            Rule("chamber alarm", "abort", 0.0, alarm),
            Rule("axis fault", "abort", 0.0, faults),
            Rule("temperature band", "pause", given.temperature_band_patience_s, band),
            Rule("temperature slope", "abort", 0.0, slope),
            Rule("stale unit", "pause", 0.0, stale),
            Rule("disk space", "pause", 0.0, disk),
        )
    )
