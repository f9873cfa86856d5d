"""Interlocks: conditions that pause or abort a run; and what a step's samples lack, so that it is repeated.

A rule returns a sentence where it is violated. A violation that lasts longer than the rule's patience trips it: the run
pauses or aborts. The rules hold in every state of a run: while it homes axes, waits, is paused (then it can only be
aborted), or runs. A step may lack samples themselves, their rate, or the motion that the table made.
"""

import itertools
import math
from bisect import bisect, bisect_left
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
    """The newest readings, and what was commanded. `imu_age_s`: time since each unit's last sample. `course_c`: the
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
        f"the chamber is off, and this run did not switch it off: mode {now.chamber.mode}, air at "
        f"{now.chamber.air_c:.1f} degC. Check its power, and whether a person used its panel; the run starts it "
        "again only when an operator resumes the run"
    )


def _stale(bounds: InterlockLimits, now: Situation) -> str:
    old = ", ".join(f"{name} for {age:.1f} s" for name, age in now.imu_age_s.items() if age > bounds.imu_stale_s)
    return f"no sample from {old}" if old else ""


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

    @property
    def pending(self) -> bool:
        """Whether a rule is violated that has not yet tripped."""
        return bool(self._since)

    def forget(self) -> None:
        self._since.clear()


# The rate of samples is measured over at least so long, beside each step's own count.
_WINDOW_S: Final = 60.0
# What a unit's own clock may be off, and how late the last samples of a step may be.
_RATE_OFF: Final = 0.05
_SLACK_S: Final = 0.5
_LEAST_TURN_DEG: Final = 90.0
_TOGETHER_S: Final = 0.25


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


@dataclass(frozen=True)
class _Arrival:
    """Samples that came together, the first of them at `begins_s`, and the last at `time_s`; the rest are sums since
    the stream was started: samples that came, and that lack between them, restarts of the unit, and its turning."""

    begins_s: float
    time_s: float
    received: int = 0
    missing: int = 0
    restarts: int = 0
    turned_deg: float = 0.0


class SampleLosses:
    """The samples of a unit since `start_s`: the stream is decoded once on arrival, and only numbers are kept.

    A sample without any finite rate or force is none.
    """

    def __init__(self, decoder: ImuDecoder, sample_rate_hz: float, gyros: GyroErrors | None, start_s: float) -> None:
        self._decoder, self._sample_rate_hz, self._gyros = decoder, sample_rate_hz, gyros
        self._arrivals: deque[_Arrival] = deque([_Arrival(start_s, start_s)], maxlen=1 << 16)

    @property
    def newest(self) -> _Arrival:
        """The newest samples, or when the stream was started."""
        return self._arrivals[-1]

    def push(self, data: bytes, time_s: float) -> None:
        batch = self._decoder.push(data, time_s)
        usable = np.isfinite(batch.gyro_dps).any(axis=1) | np.isfinite(batch.acceleration_g).any(axis=1)
        if not usable.any():
            return
        before, restarts = self.newest, int(batch.restarted.sum())
        together = before.received > 0 and not restarts and time_s - before.begins_s <= _TOGETHER_S
        if together:
            self._arrivals.pop()
        turned = float(np.nansum(np.linalg.norm(batch.gyro_dps, axis=1))) * self._decoder.sample_s
        newest = _Arrival(
            before.begins_s if together else time_s,
            time_s,
            before.received + int(usable.sum()),
            before.missing + int(batch.gap_before.sum()),
            before.restarts + restarts,
            before.turned_deg + turned,
        )
        self._arrivals.append(newest)

    def between(self, executed: ExecutedStep, share: float, latest_s: float, turned_deg: float | None) -> str:
        """A sentence where a step lacks samples: more than a share of them is missing, fewer or more came than the
        unit's rate makes in its time, the IMU restarted, or its gyro shows another angle than the table turned (None:
        unknown).

        `latest_s`: how late the computer may read them.
        """
        known, began_s, ended_s = list(self._arrivals), executed.began_s, executed.ended_s
        times_s = [arrival.time_s for arrival in known]
        first, last = (known[max(bisect(times_s, time_s) - 1, 0)] for time_s in (began_s, ended_s))
        if last.restarts > first.restarts:
            return "the IMU restarted during a step"
        lost, lasted_s = last.missing - first.missing, ended_s - began_s
        if lost > share * lasted_s * self._sample_rate_hz:
            return f"{lost} of {lasted_s * self._sample_rate_hz:.0f} samples are lost"
        # A longer time shows smaller errors of the rate; it begins after the last restart.
        since_s = next(arrival.time_s for arrival in known if arrival.restarts == last.restarts)
        for begins_s in (began_s, min(began_s, ended_s - _WINDOW_S)):
            if text := self._miscounted(known, times_s, max(begins_s, since_s), ended_s, latest_s):
                return text
        gyros = self._gyros
        if gyros is None or turned_deg is None or turned_deg < _LEAST_TURN_DEG:
            return ""
        inside_s = [began_s, *(time_s for time_s in times_s if began_s < time_s <= ended_s), ended_s]
        late_s = max(after - before for before, after in itertools.pairwise(inside_s))
        shown_deg = last.turned_deg - first.turned_deg
        allowed_deg = (gyros.share + late_s / lasted_s) * turned_deg + gyros.bias_dps * lasted_s
        if abs(shown_deg - turned_deg) > allowed_deg:
            return f"the IMU's gyros measured {shown_deg:.0f} deg in total, but the table turned {turned_deg:.0f}"
        return ""

    def _miscounted(
        self, known: list[_Arrival], times_s: list[float], begins_s: float, ends_s: float, latest_s: float
    ) -> str:
        """A sentence where other samples came than the unit's rate makes, from the last arrival before `begins_s` to
        the first after `ends_s`, or to the end where nothing came any more."""
        first = known[max(bisect(times_s, begins_s) - 1, 0)]
        place = bisect_left(times_s, ends_s)
        last, last_s = (known[place], times_s[place]) if place < len(known) else (known[-1], ends_s)
        received, span_s = last.received - first.received, last_s - first.time_s
        count = received + last.missing - first.missing
        came_s = count / self._sample_rate_hz
        if (1.0 - _RATE_OFF) * span_s - _SLACK_S <= came_s <= (1.0 + _RATE_OFF) * span_s + latest_s:
            return ""
        rate = f"{count / span_s:.1f} samples/s, but its setting is {self._sample_rate_hz:g}"
        return f"the IMU sent {received} samples in {span_s:.1f} s: {rate}"
