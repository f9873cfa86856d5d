"""The chamber in a run: its commands, its readings, when its temperature counts as stable, and what is wrong with it.

Only the first command of a run starts the chamber: one that is off later was switched off by a person (or lost its
power), and stays off.

The readings are compared with the recipe's own course of the air (`expected`), because a chamber that accepts every
command and does nothing would agree with its own set point.
"""

import math
import threading
from collections import deque
from collections.abc import Callable
from dataclasses import dataclass, field
from functools import partial
from typing import Any

import numpy as np

from gradcal_jax.hardware.clock import Clock, in_thread, until
from gradcal_jax.hardware.errors import Disconnected
from gradcal_jax.hardware.interlocks import InterlockLimits
from gradcal_jax.hardware.journal import event_fields
from gradcal_jax.hardware.roles import ChamberReading, TemperatureChamber
from gradcal_jax.hardware.track import Course, Stable

_SOFT_STEP_S = 5.0
_MOST_FAILURES = 3
_KNOTS = 64
# How far a chamber may overshoot at the end of an approach, as a share of its way.
_OVERSHOOT = 0.1
# Share of a slope by which a controller may round it: what it rounds changes all slopes.
_ROUNDED = 0.005

Tell = Callable[..., None]
"""Writes an event: its name and its data."""


class AirCourse:
    """A temperature of the air over time, linear between knots; constant after the last.

    While the chamber goes to a set point as fast as it can the course is all that lies between, and a share more.
    """

    def __init__(self) -> None:
        self._knots: tuple[tuple[float, float], ...] = ()
        self._between: tuple[float, float] | None = None

    def approaches(self, from_c: float, target_c: float) -> None:
        over_k = _OVERSHOOT * abs(target_c - from_c)
        self._knots = ()
        self._between = min(from_c, target_c) - over_k, max(from_c, target_c) + over_k

    def stands(self, now_s: float, temperature_c: float) -> None:
        self._knots = ((now_s, temperature_c),)

    def ramps(self, from_s: float, target_c: float, k_per_min: float) -> None:
        """A ramp from the course's temperature at that time; in an approach its target belongs to what lies between."""
        if not self._knots:
            if self._between is not None:
                low, high = self._between
                self._between = min(low, target_c), max(high, target_c)
            return
        start_c = self.at(from_s)
        before = tuple(knot for knot in self._knots[-_KNOTS:] if knot[0] < from_s)
        reached_s = from_s + abs(target_c - start_c) / k_per_min * 60.0
        self._knots = (*before, (from_s, start_c), (reached_s, target_c))

    def of_late(self, now_s: float, lag_s: float) -> tuple[float, float] | None:
        """The lowest and the highest of the last `lag_s`; None where nothing was commanded."""
        if not self._knots:
            return self._between
        inside = [value for time_s, value in self._knots if now_s - lag_s < time_s < now_s]
        inside += [self.at(now_s - lag_s), self.at(now_s)]
        return min(inside), max(inside)

    def at(self, time_s: float) -> float:
        times_s, values_c = zip(*self._knots, strict=True)
        return float(np.interp(time_s, times_s, values_c))


@dataclass(eq=False)
class ChamberControl:
    """Commands the chamber and keeps its readings: one thing after the other, each in a thread beside the run's, so
    that a chamber that takes seconds to acknowledge delays no move and no reading. `failed` gets the sentence that ends
    the run."""

    chamber: TemperatureChamber
    clock: Clock
    event: Tell
    failed: Callable[[str], None] = lambda sentence: None
    newest: ChamberReading | None = None
    expected: AirCourse = field(default_factory=AirCourse)
    # What is to be told; whether nothing is under way; when it was read, and how often it could not be read.
    _courses: deque[Course] = field(default_factory=deque[Course])
    _free: threading.Event = field(default_factory=threading.Event)
    _reads_s: float = -math.inf
    _failures: int = 0
    _history: list[tuple[float, float]] = field(default_factory=list[tuple[float, float]])
    # A ramp by set points of the runner, for a controller without ramps or with coarse ones, and its end.
    _soft: tuple[AirCourse, float] | None = None
    _next_soft_s: float = 0.0
    _held_c: float | None = None
    _conditions_since_s: float = math.inf
    # The temperatures that the chamber reports as its limits, and that of its air at the start.
    _range_c: tuple[float, float] = (-math.inf, math.inf)

    def __post_init__(self) -> None:
        self._free.set()

    def begin(self) -> None:
        """The first reading of a run."""
        reading, limits = self.chamber.read(), self.chamber.limits()
        self._range_c = min(limits.lowest_c, reading.air_c), max(limits.highest_c, reading.air_c)
        self.heard(reading)

    def heard(self, reading: ChamberReading) -> None:
        self.newest = reading
        if not reading.conditioning:
            self._held_c = None
        self._history.append((reading.time_s, reading.air_c if reading.product_c is None else reading.product_c))

    def tell(self, course: Course, due_s: float) -> None:
        """Have the chamber told a course, which begins at this time."""
        at_c, rate = course.temperature_c, course.ramp_k_per_min
        if rate is not None:
            self.expected.ramps(due_s, at_c, rate)
        elif self.expected.of_late(due_s, 0.0) != (at_c, at_c) and self.newest is not None:
            self.expected.approaches(self.newest.air_c, at_c)
        self._courses.append(course)

    def attend(self, every_s: float) -> None:
        """Begin what is due beside the run: a command, or a reading `every_s`. To be called often."""
        now = self.clock.now()
        if not self._free.is_set():
            return
        if self._courses:
            self._free = in_thread(partial(self.follow, self._courses.popleft()), self.clock, self._not_told)
        elif now >= self._reads_s + every_s:
            self._reads_s = now
            self._free = in_thread(self._look, self.clock, self._not_read)

    def end(self, longest_s: float) -> bool:
        """Whether what is under way has ended, at the latest after `longest_s`."""
        return until(self._free.is_set, self.clock, longest_s=longest_s)

    def _not_told(self, problem: Exception) -> None:
        self.failed(f"The temperature profile could not be sent to the chamber: {problem}")

    def _not_read(self, problem: Exception) -> None:
        self._failures += 1
        self.event("chamber not read", at_once=False, problem=str(problem))
        if self._failures == _MOST_FAILURES or isinstance(problem, Disconnected):
            self.failed(f"The chamber cannot be read: {problem}")

    def _look(self) -> None:
        self._step_soft_ramp()
        reading = self.chamber.read()
        self.heard(reading)
        self._failures = 0
        self.event("chamber", at_once=False, **event_fields(reading))

    def follow(self, course: Course) -> None:
        """Follow a course: by the controller's own ramp where it has the planned one, else by set points."""
        at_c, rate = course.temperature_c, course.ramp_k_per_min
        self._soft = None
        if rate is None:
            if self._held_c != at_c:
                self._set(at_c)
                self.event("chamber told", hold_c=at_c)
            return
        self._held_c = None
        command: dict[str, Any] = {"ramp_to_c": at_c, "asked_k_per_min": rate}
        limits, now = self.chamber.limits(), self.chamber.read()
        step = limits.ramp_step_k_per_min
        made = step * max(1, round(rate / step)) if step else rate
        if self._started and not now.conditioning:
            self.event("chamber not told", **command, why="it is off, and this run did not switch it off")
        elif limits.hardware_ramp and abs(made - rate) <= _ROUNDED * rate:
            command["k_per_min"] = self.chamber.ramp(at_c, rate)
            self._conditioned()
            self.event("chamber told", **command)
        else:
            soft, self._next_soft_s = AirCourse(), self.clock.now()
            soft.stands(self._next_soft_s, now.setpoint_c)
            soft.ramps(self._next_soft_s, at_c, rate)
            self._soft = soft, at_c
            self.event("chamber told", **command, k_per_min=rate, by="steps of the runner")

    def _step_soft_ramp(self) -> None:
        """Continue a ramp by set points, at least five seconds apart."""
        now = self.clock.now()
        if self._soft is None or now < self._next_soft_s:
            return
        ramp, target_c = self._soft
        # A set point that is held until the next one is late by half of that time.
        self._set(ramp.at(now + 0.5 * max(_SOFT_STEP_S, now - self._next_soft_s + _SOFT_STEP_S)))
        self._soft = None if self._held_c == target_c else self._soft
        self._next_soft_s = now + _SOFT_STEP_S

    def _set(self, temperature_c: float) -> None:
        if self._started:
            self.chamber.set_point(temperature_c)
        else:
            self.chamber.hold(temperature_c)
            self._conditioned()
        self._held_c = temperature_c

    @property
    def _started(self) -> bool:
        return math.isfinite(self._conditions_since_s)

    def _conditioned(self) -> None:
        self._conditions_since_s = min(self._conditions_since_s, self.clock.now())

    @property
    def newest_c(self) -> float:
        """The newest temperature, of the load where the chamber measures it."""
        return self._history[-1][1]

    def is_stable_at(self, temperature_c: float, wanted: Stable) -> bool:
        """Whether the temperature has been stable for the required time."""
        lowest, highest, latest_s = math.inf, -math.inf, self._history[-1][0]
        for time_s, value in reversed(self._history):
            lowest, highest = min(lowest, value), max(highest, value)
            if abs(value - temperature_c) > wanted.band_k or highest - lowest > wanted.band_k:
                return False
            if latest_s - time_s >= wanted.for_s:
                return True
        return False

    def violated(self, limits: InterlockLimits) -> dict[str, str]:
        """What is wrong with the newest reading, by the rules of `interlocks`."""
        if (reading := self.newest) is None:
            return {}
        alarms = f"the chamber reports alarm {', '.join(reading.alarms)}: see its manual" if reading.alarms else ""
        return {
            "chamber alarm": alarms,
            "temperature limit": self._beyond(reading, limits),
            "temperature course": self._off_course(reading, limits),
            "idle chamber": self._idle(reading),
        }

    def _beyond(self, reading: ChamberReading, limits: InterlockLimits) -> str:
        band_k = limits.temperature_band_k if math.isfinite(limits.temperature_band_k) else 0.0
        lowest = max(limits.never_below_c, self._range_c[0] - band_k)
        highest = min(limits.never_above_c, self._range_c[1] + band_k)
        for what, value in (("air", reading.air_c), ("load", reading.product_c)):
            if value is not None and not lowest <= value <= highest:
                return f"the {what} is at {value:.1f} degC; its limits are {lowest:g} to {highest:g} degC"
        return ""

    def _off_course(self, reading: ChamberReading, limits: InterlockLimits) -> str:
        course_c = self.expected.of_late(self.clock.now(), limits.temperature_lag_s)
        if course_c is None:
            return ""
        low, high = course_c
        away = min(reading.air_c - low, 0.0) or max(reading.air_c - high, 0.0)
        if abs(away) <= limits.temperature_band_k:
            return ""
        return (
            f"the air is at {reading.air_c:.1f} degC, {away:+.1f} K from the temperature profile of the last "
            f"{limits.temperature_lag_s:g} s; the rig allows {limits.temperature_band_k:g} K"
        )

    def _idle(self, reading: ChamberReading) -> str:
        if reading.conditioning or reading.time_s <= self._conditions_since_s:
            return ""
        return (
            f"the chamber is off, and this run did not switch it off: mode {reading.mode}, air at "
            f"{reading.air_c:.1f} degC. Check its power, and whether a person used its panel"
        )
