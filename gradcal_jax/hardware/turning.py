"""The axes' side of a run: what they were told, what they read, and who still turns.

A motor does a turn in the time that the track reckons with; it is looked at when it should stand, until it says so. A
person takes the time that a person takes: while an axis is turned by hand nothing else of the track begins, and what
comes after it begins as much later as the turn was late (`late_s`), so that every rest keeps its length.
"""

import math
from collections.abc import Callable, Mapping

from .clock import Clock
from .errors import HardwareError
from .journal import plain
from .roles import AxisReading, MotionAxis
from .track import Move

_POLL_S = 0.05
_POLL_BY_HAND_S = 0.25
_LONGEST_MOVE_S = 120.0
_NEAR_BY_HAND_DEG = 5.0

Tell = Callable[..., None]
"""Writes an event: its name and what belongs to it."""


class AxesDuty:
    """Tells the axes their moves and remembers what they say. One thread, the run's own."""

    def __init__(self, axes: Mapping[str, MotionAxis], clock: Clock, event: Tell) -> None:
        self._axes = axes
        self._clock = clock
        self._event = event
        self._goal_deg: dict[str, float] = {}
        # What ends by itself: when to look next; and when it was to end, of those that are turned by hand.
        self._turning: dict[str, float] = {}
        self._planned_end_s: dict[str, float] = {}
        self._spinning: set[str] = set()
        self._by_hand: set[str] = set()
        self.newest: dict[str, AxisReading] = {}
        self.late_s = 0.0

    def home(self, names: list[str], meanwhile: Callable[[], None]) -> None:
        """Find the references."""
        for name in names:
            self._event("homing", axis=name)
            if self._axes[name].limits().by_hand:
                self._by_hand.add(name)
            self._axes[name].home()
            self.settle(name, meanwhile)
            self._goal_deg[name] = 0.0

    @property
    def turned_by_hand(self) -> bool:
        """Whether somebody is turning an axis now."""
        return bool(self._planned_end_s)

    @property
    def look_s(self) -> list[float]:
        """When the axes are to be looked at next."""
        return list(self._turning.values())

    def go_to_start(self, step: str, start_deg: Mapping[str, float], meanwhile: Callable[[], None]) -> None:
        """Bring axes to where a step begins that begins by itself."""
        for name, position in start_deg.items():
            limits = self._axes[name].limits()
            endless = limits.lowest_deg is None and limits.highest_deg is None
            # An endless axis has no cable to wind up: within one turn is the same place.
            goal = position % 360.0 if endless else position
            if not self._stands_at(name, goal):
                rate, acceleration = min(limits.max_rate_dps, 60.0), min(limits.max_acceleration_dps2, 60.0)
                goes = Move(0.0, name, "go", position_deg=goal, rate_dps=rate, acceleration_dps2=acceleration)
                self._command(step, goes)
                self.settle(name, meanwhile)

    def move(self, step: str, move: Move, meanwhile: Callable[[], None]) -> None:
        """A turn waits until the turn before it has ended; how late that makes it is in the journal."""
        name = move.axis
        if move.kind in ("go", "turn") and (name in self._turning or name in self._spinning):
            if name in self._spinning:
                self._axes[name].stop()
            self.settle(name, meanwhile)
        self._command(step, move)

    def look(self) -> None:
        """Read an axis that is due to stand until it says that it does: there its standstill begins."""
        for name in sorted(self._turning):
            if self._turning[name] <= self._clock.now():
                self._turning[name] = self._clock.now() + (_POLL_BY_HAND_S if name in self._by_hand else _POLL_S)
                self._read(name)

    def read(self) -> None:
        """Read all axes."""
        for name in self._axes:
            self._read(name)

    def settle_all(self, meanwhile: Callable[[], None]) -> None:
        """Wait until every axis stands that is to stand."""
        for name in sorted(self._turning):
            self.settle(name, meanwhile)

    def settle(self, name: str, meanwhile: Callable[[], None]) -> None:
        """Wait until an axis stands; what turns for ever is stopped. A person is waited for as long as it takes."""
        end = self._clock.now() + (math.inf if name in self._by_hand else _LONGEST_MOVE_S)
        while self._read(name).moving:
            if self._clock.now() > end:
                self._axes[name].stop()
                raise HardwareError(f"Axis {name!r} still moves {_LONGEST_MOVE_S:g} s after its step. It was stopped.")
            meanwhile()
            self._clock.sleep(_POLL_BY_HAND_S if name in self._by_hand else _POLL_S)

    def end_spins(self, step: str, at_s: float) -> None:
        for name in sorted(self._spinning):
            self._command(step, Move(at_s, name, "stop"))

    def stop(self) -> None:
        """Stop every axis now."""
        for name, axis in self._axes.items():
            axis.stop()
            self._event("stopped", at_once=False, axis=name)
        self._spinning.clear()
        self._turning.clear()
        self._planned_end_s.clear()

    # -------------------------------------------------------------------------------------------------------- parts

    def _stands_at(self, name: str, goal_deg: float) -> bool:
        """Whether an axis need not be told to go there: a motor goes exactly, a person only where it is worth it."""
        newest = self.newest.get(name)
        if name in self._by_hand:
            return newest is not None and not newest.moving and abs(newest.position_deg - goal_deg) <= _NEAR_BY_HAND_DEG
        return newest is None and abs(self._goal_deg.get(name, 0.0) - goal_deg) <= 1e-9

    def _command(self, step: str, move: Move) -> None:
        axis, name = self._axes[move.axis], move.axis
        began = self._clock.now()
        if move.kind in ("go", "turn"):
            turned = self._goal_deg.get(name, 0.0) + move.angle_deg
            goal = turned if move.kind == "turn" else move.position_deg
            axis.move_to(goal, move.rate_dps, move.acceleration_dps2)
            self._goal_deg[name] = goal
            self._spinning.discard(name)
            self._turning[name] = began + (move.duration_s if move.kind == "turn" else 0.0)
            if name in self._by_hand:
                self._planned_end_s[name], self._turning[name] = self._turning[name], began
        elif move.kind == "spin":
            axis.spin(move.rate_dps, move.acceleration_dps2)
            self._spinning.add(name)
            self._turning.pop(name, None)
        else:
            axis.stop()
            self._spinning.discard(name)
            self._turning[name] = began
        self._event("move", at_once=False, step=step, began_s=began, **plain(move))

    def _read(self, name: str) -> AxisReading:
        before, reading = self.newest.get(name), self._axes[name].read()
        self.newest[name] = reading
        # An angle that nobody knows is no reading, and one that was typed is one reading however often it is asked for.
        if not math.isnan(reading.position_deg) and before != reading:
            self._event("angle", at_once=False, axis=name, **plain(reading))
        if not reading.moving:
            self._turning.pop(name, None)
            planned_s = self._planned_end_s.pop(name, math.inf)
            self.late_s += max(0.0, reading.time_s - planned_s)
        return reading
