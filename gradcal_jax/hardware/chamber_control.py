"""The chamber in a run: its commands, its readings, and when its temperature counts as stable.

Only the first command of a run starts the chamber, and the first after an operator has resumed the run: a chamber that
is off otherwise was switched off by a person (or lost its power), and stays off.

The readings are compared with the recipe's own course of the air (`expected`), because a chamber that accepts every
command and does nothing would agree with its own set point.
"""

import math
import threading
from collections import deque
from collections.abc import Callable, Generator
from contextlib import contextmanager
from typing import Any

import numpy as np

from gradcal_jax.hardware.clock import Clock, holding, in_thread
from gradcal_jax.hardware.errors import Disconnected
from gradcal_jax.hardware.journal import event_fields
from gradcal_jax.hardware.roles import ChamberLimits, ChamberReading, TemperatureChamber
from gradcal_jax.hardware.track import Course, Stable

_SOFT_STEP_S = 5.0
_LOOKS_S = 0.02
_REMEMBERED = 1 << 14
_KNOTS = 64
# How far a chamber may overshoot at the end of an approach, as a share of its way.
_OVERSHOOT = 0.1
# Share of a slope by which a controller may round it.
_ROUNDED = 0.005

Tell = Callable[..., None]
"""Writes an event: its name and its data."""


def rate_as_made(limits: ChamberLimits, rate_k_per_min: float) -> float:
    step = limits.ramp_step_k_per_min
    return step * max(1, round(rate_k_per_min / step)) if step else rate_k_per_min


def ramps_alone(limits: ChamberLimits, rate_k_per_min: float) -> bool:
    """Whether the controller makes a ramp as planned: what it rounds changes all slopes."""
    made = rate_as_made(limits, rate_k_per_min)
    return limits.hardware_ramp and abs(made - rate_k_per_min) <= _ROUNDED * rate_k_per_min


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


class ChamberControl:
    """Commands the chamber and keeps its readings, from any thread: one command after the other."""

    def __init__(self, chamber: TemperatureChamber, clock: Clock, event: Tell) -> None:
        self.chamber = chamber
        self._clock = clock
        self._event = event
        self._telling = threading.RLock()
        self._ended = self._started = False
        self._history: deque[tuple[float, float]] = deque(maxlen=_REMEMBERED)
        # A ramp by set points of the runner, for a controller without ramps or with coarse ones, and its end.
        self._soft: tuple[AirCourse, float] | None = None
        self._next_soft_s = 0.0
        self._held_c: float | None = None
        self._conditions_since_s = math.inf
        self.expected = AirCourse()
        self.newest: ChamberReading | None = None

    def heard(self, reading: ChamberReading) -> None:
        self.newest = reading
        if not reading.conditioning:
            self._held_c = None
        self._history.append((reading.time_s, reading.air_c if reading.product_c is None else reading.product_c))

    @property
    def conditions(self) -> bool:
        return self.newest is not None and self.newest.time_s > self._conditions_since_s

    def end(self, longest_s: float) -> bool:
        """Send no further command; returns when the current one has ended, or after `longest_s`; whether it has."""
        self._ended = True
        end_s = self._clock.now() + longest_s
        while not self._telling.acquire(blocking=False):
            if self._clock.now() >= end_s:
                return False
            self._clock.sleep(_LOOKS_S)
        self._telling.release()
        return True

    @contextmanager
    def _alone(self) -> Generator[bool, None, None]:
        """Exclusive access to the chamber; whether commands are still allowed."""
        with holding(self._telling, self._clock):
            yield not self._ended

    def hold(self, temperature_c: float) -> None:
        """Condition at a temperature, unless the chamber does so already."""
        with self._alone() as may:
            if may and self._held_c != temperature_c:
                self._set(temperature_c)
                self._event("chamber told", hold_c=temperature_c)
            self._soft = None

    def expect(self, course: Course, now_s: float) -> None:
        if course.ramp_k_per_min is not None:
            self.expected.ramps(now_s, course.temperature_c, course.ramp_k_per_min)
        elif self.expected.of_late(now_s, 0.0) != (course.temperature_c, course.temperature_c):
            self.approach(course.temperature_c)

    def approach(self, temperature_c: float) -> None:
        if self.newest is not None:
            self.expected.approaches(self.newest.air_c, temperature_c)

    def may_start(self) -> None:
        """The next command may start the chamber again: an operator has resumed the run."""
        self._started = False

    def _set(self, temperature_c: float) -> None:
        if self._started:
            self.chamber.set_point(temperature_c)
        else:
            self.chamber.hold(temperature_c)
            self._conditioned()
        self._held_c = temperature_c

    def _conditioned(self) -> None:
        self._started = True
        self._conditions_since_s = min(self._conditions_since_s, self._clock.now())

    def follow(self, course: Course) -> None:
        """Follow a course: by the controller's own ramp where it has the planned one, else by `step_soft_ramp`."""
        rate = course.ramp_k_per_min
        if rate is None:
            self.hold(course.temperature_c)
            return
        with self._alone() as may:
            if not may:
                return
            self._held_c = self._soft = None
            command: dict[str, Any] = {"ramp_to_c": course.temperature_c, "asked_k_per_min": rate}
            limits, now = self.chamber.limits(), self.chamber.read()
            if self._started and not now.conditioning:
                self._event("chamber not told", **command, why="it is off, and this run did not switch it off")
            elif ramps_alone(limits, rate):
                command["k_per_min"] = self.chamber.ramp(course.temperature_c, rate)
                self._conditioned()
                self._event("chamber told", **command)
            else:
                soft, self._next_soft_s = AirCourse(), self._clock.now()
                soft.stands(self._next_soft_s, now.setpoint_c)
                soft.ramps(self._next_soft_s, course.temperature_c, rate)
                self._soft = soft, course.temperature_c
                self._event("chamber told", **command, k_per_min=rate, by="steps of the runner")

    def step_soft_ramp(self) -> None:
        """Continue a ramp by set points, at least five seconds apart; to be called often."""
        if self._soft is None:
            return
        with self._alone() as may:
            now = self._clock.now()
            if not may or self._soft is None or now < self._next_soft_s:  # pyright: ignore[reportUnnecessaryComparison]
                return
            ramp, target_c = self._soft
            # A set point that is held until the next one is late by half of that time.
            self._set(ramp.at(now + 0.5 * max(_SOFT_STEP_S, now - self._next_soft_s + _SOFT_STEP_S)))
            self._soft = None if self._held_c == target_c else self._soft
            self._next_soft_s = now + _SOFT_STEP_S

    def watch(self, every_s: float, watching: threading.Event, failed: Callable[[str], None]) -> None:
        failures = 0
        while watching.is_set():
            self._clock.sleep(every_s)
            if not watching.is_set():
                return
            try:
                self.step_soft_ramp()
                reading = self.chamber.read()
                self.heard(reading)
                failures = 0
                self._event("chamber", at_once=False, **event_fields(reading))
            except Exception as problem:
                failures += 1
                self._event("chamber not read", problem=str(problem))
                if failures == 3 or isinstance(problem, Disconnected):
                    failed(f"The chamber cannot be read: {problem}")
                    return

    def tell(self, course: Course, due_s: float, failed: Callable[[str], None]) -> None:
        """Runs in a separate thread: a chamber that takes seconds to acknowledge delays no move and no reading."""
        self.expect(course, due_s)
        why = "The temperature profile could not be sent to the chamber"
        in_thread(lambda: self.follow(course), self._clock, lambda problem: failed(f"{why}: {problem}"))

    def stable_at(self, temperature_c: float, wanted: Stable) -> float | None:
        """The newest temperature, if it has been stable for the required time; else None."""
        readings = list(self._history)
        lowest, highest = math.inf, -math.inf
        for time_s, value in reversed(readings):
            lowest, highest = min(lowest, value), max(highest, value)
            if abs(value - temperature_c) > wanted.band_k or highest - lowest > wanted.band_k:
                return None
            if readings[-1][0] - time_s >= wanted.for_s:
                return readings[-1][1]
        return None
