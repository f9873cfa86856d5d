"""Interlocks: conditions that pause or abort a run; and what a step's samples lack, so that it is repeated.

A rule returns a sentence where it is violated. A violation that lasts longer than the rule's patience trips it: the run
pauses or aborts. The rules hold in every state of a run: while it homes axes, waits, is paused (then it can only be
aborted), or runs. A step may lack samples themselves, their rate, or the motion that the table made.
"""

import itertools
import math
from collections import deque
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from functools import partial
from typing import Final, Literal

import numpy as np

from gradcal_jax.hardware.axis_control import too_fast
from gradcal_jax.hardware.roles import AxisReading, ChamberReading, ImuDecoder
from gradcal_jax.hardware.track import GyroErrors

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
    rates = ((name, now.axes[name].rate_dps, most) for name, most in now.allowed_dps.items() if name in now.axes)
    return "; ".join(
        f"axis {name} turns at {dps:.1f} deg/s; the command was {told:g}, and the rig allows {most:g}"
        for name, dps, (told, most) in rates
        if too_fast(dps, (told, most))
    )


def _limit(bounds: InterlockLimits, now: Situation) -> str:
    chamber, band_k = now.chamber, bounds.temperature_band_k if math.isfinite(bounds.temperature_band_k) else 0.0
    lowest = max(bounds.never_below_c, now.range_c[0] - band_k)
    highest = min(bounds.never_above_c, now.range_c[1] + band_k)
    for what, value in () if chamber is None else (("air", chamber.air_c), ("load", chamber.product_c)):
        if value is not None and not lowest <= value <= highest:
            return f"the {what} is at {value:.1f} degC; its limits are {lowest:g} to {highest:g} degC"
    return ""


def _off_course(bounds: InterlockLimits, now: Situation, *, paused: bool) -> str:
    """A pause may open the door: then the room belongs to the course."""
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
        f"the chamber was commanded to condition the air but does not: mode {now.chamber.mode}, air at "
        f"{now.chamber.air_c:.1f} degC. Check the chamber's power, and whether somebody used its panel"
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


# The window in which the rate of samples is measured is at least so long; what a unit's own clock may be off.
_WINDOW_S, _RATE_OFF = 60.0, 0.05
_LEAST_TURN_DEG = 90.0
_TOGETHER_S = 0.25


class StepNotDone(Exception):
    """A step was not executed as written; `unit`: the one whose samples it lacks."""

    def __init__(self, number: int, why: str, unit: str = "") -> None:
        Exception.__init__(self, why)
        self.number, self.unit = number, unit


@dataclass(frozen=True)
class ExecutedStep:
    number: int
    began_s: float
    ended_s: float


@dataclass
class _Arrival:
    """Samples that came together: until when, how many, what lacks before them, and how far the unit turned."""

    time_s: float
    received: int = 0
    missing: int = 0
    restarted: bool = False
    turned_deg: float = 0.0


class SampleLosses:
    """The samples of a unit: the stream is decoded once on arrival, and only their numbers are kept."""

    def __init__(self, decoder: ImuDecoder, sample_rate_hz: float, gyros: GyroErrors | None) -> None:
        self._decoder, self._sample_rate_hz, self._gyros = decoder, sample_rate_hz, gyros
        self._arrivals: deque[_Arrival] = deque(maxlen=1 << 16)
        self.received = self.missing = 0

    def begin_again(self, decoder: ImuDecoder) -> None:
        self._decoder = decoder
        self._arrivals.clear()

    def push(self, data: bytes, time_s: float) -> None:
        batch = self._decoder.push(data, time_s)
        missing, restarted = int(batch.gap_before.sum()), bool(batch.restarted.any())
        self.received, self.missing = self.received + len(batch), self.missing + missing
        if not len(batch):
            return
        newest = self._arrivals[-1] if self._arrivals else None
        if newest is None or restarted or time_s - newest.time_s > _TOGETHER_S:
            newest = _Arrival(time_s)
            self._arrivals.append(newest)
        newest.received += len(batch)
        newest.missing += missing
        newest.restarted = newest.restarted or restarted
        newest.turned_deg += float(np.nansum(np.linalg.norm(batch.gyro_dps, axis=1))) * self._decoder.sample_s

    def between(self, executed: ExecutedStep, share: float, latest_s: float, turned_deg: float | None) -> str:
        """A sentence where more than a share of a step's samples is missing, the IMU restarted in it or sends at
        another rate, or where its gyro shows another angle than the table turned (None: unknown).

        `latest_s`: how late the computer may read them.
        """
        known = list(self._arrivals)
        inside = [arrival for arrival in known if executed.began_s < arrival.time_s <= executed.ended_s]
        if any(arrival.restarted for arrival in inside):
            return "the IMU restarted during a step"
        lost, lasted_s = sum(arrival.missing for arrival in inside), executed.ended_s - executed.began_s
        if lost > share * lasted_s * self._sample_rate_hz:
            return f"{lost} of {lasted_s * self._sample_rate_hz:.0f} samples are lost"
        begins_s = min(executed.began_s, executed.ended_s - _WINDOW_S)
        begins_s = max([begins_s, *(one.time_s for one in known if one.restarted and one.time_s <= executed.ended_s)])
        window = [arrival for arrival in known if begins_s <= arrival.time_s <= executed.ended_s]
        if window and (span_s := window[-1].time_s - window[0].time_s) > 0.0:
            count = sum(arrival.received + arrival.missing for arrival in window[1:])
            if abs(count / self._sample_rate_hz - span_s) > _RATE_OFF * span_s + latest_s:
                return f"the IMU sends {count / span_s:.1f} samples/s, but its setting is {self._sample_rate_hz:g}"
        gyros = self._gyros
        if gyros is None or turned_deg is None or turned_deg < _LEAST_TURN_DEG or not inside:
            return ""
        times_s = [executed.began_s, *(arrival.time_s for arrival in inside), executed.ended_s]
        late_s = max(after - before for before, after in itertools.pairwise(times_s))
        shown_deg = sum(arrival.turned_deg for arrival in inside)
        allowed_deg = (gyros.share + late_s / lasted_s) * turned_deg + gyros.bias_dps * lasted_s
        if math.isfinite(shown_deg) and abs(shown_deg - turned_deg) > allowed_deg:
            return f"the IMU's gyros measured {shown_deg:.0f} deg in total, but the table turned {turned_deg:.0f}"
        return ""
