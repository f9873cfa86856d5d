"""The axes in a run: their commands, readings and state of motion, and what is wrong with them.

A motor does a turn in the track's time; it is read from its planned end on until it stands. An operator's turn may take
longer: while an axis is turned by hand nothing else of the track begins, and everything after it is delayed by as much
as the turn was late (`late_s`), so that every rest keeps its length; early turns make up for late ones.

Deviations from the track raise `StepNotDone`: a late command, a turn that ended late or at another angle, a spin at
another rate. The allowed rate of an axis follows from its commands; its place at every instant from the turn under way.
"""

import itertools
import math
from collections.abc import Mapping
from dataclasses import dataclass, replace
from functools import cached_property

from gradcal_jax.hardware.chamber_control import Tell
from gradcal_jax.hardware.clock import Clock, Work, beside, until
from gradcal_jax.hardware.errors import HardwareError, StepNotDone
from gradcal_jax.hardware.journal import event_fields
from gradcal_jax.hardware.roles import AxisLimits, AxisReading, MotionAxis
from gradcal_jax.hardware.track import AxisCommand

_POLL_S, _POLL_BY_HAND_S = 0.05, 0.25
_LONGEST_MOVE_S = 120.0
_NEAR_BY_HAND_DEG = 5.0
# How often an axis is read for its rate alone, and how long after a slower command it may still turn as before.
_WATCH_MOVING_S, _WATCH_STANDING_S = 0.5, 5.0
_EASING_S = 1.0
_OFF_GOAL_DEG = 1.0
_OFF_RATE, _OFF_RATE_DPS = 0.1, 3.0
_OFF_READINGS = 3
# An axis that should move, and in so long went less than a share of its way at its rate, is jammed.
_STALL_S, _STALL_SHARE = 5.0, 0.1
# A driver sends the commands of a search for the reference within this time, and then only looks.
_SEARCH_TOLD_S = 10.0
# The rates at which an axis goes to the starting angle of a step, at most.
_START_DPS = 60.0


@dataclass(eq=False)
class Axis:
    """One axis in a run: what it was commanded to do, and what its readings showed. Times are of the run's clock."""

    name: str
    device: MotionAxis
    clock: Clock
    event: Tell
    newest: AxisReading | None = None
    command: AxisCommand | None = None
    """What is under way: a turn until it stands, a spin until it is stopped."""
    began_s: float = 0.0
    from_deg: float = 0.0
    goal_deg: float = 0.0
    """Where the last turn was to end."""
    looks_s: float = math.inf
    """The time of the next reading, of a move that ends by itself."""
    awaited: bool = False
    """Whether the recipe takes a reading as soon as it stands."""
    homed: bool | None = None
    """Until its search for the reference has begun nothing else is asked of it. None: the run does not move it. Such an
    axis keeps the faults of its first reading: a board may wait for its reference."""
    searches_since_s: float = -math.inf
    _first_faults: tuple[str, ...] | None = None
    # The rate that is allowed, since when, and the one before, until when.
    _told_dps: float = 0.0
    _told_s: float = -math.inf
    _eased_dps: float = 0.0
    _eased_until_s: float = -math.inf
    # Where it has stood, nearly, and since when.
    _stands_deg: float = math.inf
    _stands_since_s: float = math.inf
    # Where it stood first since its last command; NaN: it has not stood since.
    _rests_deg: float = math.nan
    # How many readings one after the other showed another rate than that of its spin.
    _off_rate: int = 0

    @cached_property
    def limits(self) -> AxisLimits:
        """Those at the beginning of the run."""
        return self.device.limits()

    @property
    def poll_s(self) -> float:
        return _POLL_BY_HAND_S if self.limits.by_hand else _POLL_S

    @property
    def spins(self) -> bool:
        return self.command is not None and self.command.kind == "spin"

    @property
    def at_deg(self) -> float:
        """Its angle, as far as it is known."""
        if self.newest is None or math.isnan(self.newest.position_deg):
            return self.goal_deg
        return self.newest.position_deg

    @property
    def ends_s(self) -> float:
        """When what is under way is planned to end."""
        command = self.command
        return -math.inf if command is None else self.began_s + command.duration_s + command.answer_s

    def search(self, duties: Work) -> None:
        """Find the reference, at a rate that the device chooses."""
        self.event("homing", axis=self.name)
        self._told_dps, self._rests_deg = math.inf, math.nan

        def home() -> None:
            self.searches_since_s = self.clock.now()
            try:
                self.device.home()
            finally:
                self.searches_since_s = -math.inf

        beside(home, self.clock, duties)
        self.homed = True

    def tell(self, step: str, move: AxisCommand) -> None:
        now_s = self.clock.now()
        self._allow(abs(move.rate_dps), move.acceleration_dps2 or math.inf)
        self._stands_deg = self._stands_since_s = self.looks_s = math.inf
        self._rests_deg, self.command, self.awaited = math.nan, None, False
        self.began_s, self.from_deg = now_s, self.at_deg if move.kind == "go" else self.goal_deg
        if move.kind == "spin":
            self.device.spin(move.rate_dps, move.acceleration_dps2)
            self.command = move
        elif move.kind == "stop":
            self.device.stop()
            self.looks_s = now_s
        else:
            goal_deg = self.from_deg + move.angle_deg
            self.device.move_to(goal_deg, move.rate_dps, move.acceleration_dps2)
            self.goal_deg, self.command = goal_deg, move
            self.looks_s = now_s if self.limits.by_hand or move.kind == "go" else now_s + move.duration_s
        fields = event_fields(move)
        self.event("move", at_once=False, step=step, began_s=now_s, position_deg=self.goal_deg, **fields)

    def stop(self) -> None:
        self.device.stop()
        self._allow()
        self.event("stopped", at_once=False, axis=self.name)
        self.command, self.looks_s, self._rests_deg = None, math.inf, math.nan

    def read(self) -> AxisReading:
        """A reading without an event."""
        reading = self.device.read()
        if abs(reading.position_deg - self._rests_deg) > _OFF_GOAL_DEG:
            # One damaged character may show another angle.
            reading = self.device.read()
        if self.homed is None:
            known = self._first_faults = reading.faults if self._first_faults is None else self._first_faults
            reading = replace(reading, faults=tuple(fault for fault in reading.faults if fault not in known))
        self.newest = reading
        if abs(reading.position_deg - self._stands_deg) > _stands_within_deg(self._told_dps):
            self._stands_deg, self._stands_since_s = reading.position_deg, reading.time_s
        if self.command is None and self.looks_s == math.inf:
            self._rest_at(reading)
        return reading

    def _rest_at(self, reading: AxisReading) -> None:
        if math.isnan(self._rests_deg) and not reading.moving:
            self._rests_deg = reading.position_deg

    def ended(self, reading: AxisReading) -> AxisCommand | None:
        """What has ended, of an axis that stands."""
        self._rest_at(reading)
        if self._told_dps:
            self._allow()
        command, self.command = self.command, None
        return command

    def stands_at(self, goal_deg: float) -> bool:
        """Whether it is at a goal: a motor that was told to go there, one by hand within a tolerance. Its standstill
        goes on: a motor that is told to go where it is may move a little."""
        newest, by_hand, told = self.newest, self.limits.by_hand, abs(self.goal_deg - goal_deg) <= 1e-9
        if newest is None:
            return told and not by_hand
        within_deg = _NEAR_BY_HAND_DEG if by_hand else _OFF_GOAL_DEG
        return not newest.moving and abs(newest.position_deg - goal_deg) <= within_deg and (by_hand or told)

    def require_rate(self, reading: AxisReading) -> None:
        """Its spin is as commanded, or was at one of three readings: a wrong one may come from a busy host."""
        command = self.command
        if command is None or not self.spins or reading.time_s <= self._eased_until_s:
            self._off_rate = 0
            return
        off = abs(reading.rate_dps - command.rate_dps) > _tolerance_dps(command.rate_dps)
        self._off_rate = self._off_rate + 1 if off else 0
        if self._off_rate == _OFF_READINGS:
            raise StepNotDone(f"axis {self.name} spins at {reading.rate_dps:.2f} deg/s instead of {command.rate_dps:g}")

    # What is wrong with the newest reading: a sentence each, or an empty one.

    def faulty(self, newest: AxisReading) -> str:
        return f"axis {self.name}: {', '.join(newest.faults)}" if newest.faults else ""

    def too_fast(self, newest: AxisReading) -> str:
        """A sentence where it turns faster than by its commands, or than the rig allows."""
        if self.limits.by_hand or newest.time_s <= self._told_s:
            return ""
        bounds = self._allowed_dps(), self.limits.max_rate_dps
        if abs(newest.rate_dps) <= min(bound + _tolerance_dps(bound) for bound in bounds):
            return ""
        turns = f"axis {self.name} turns at {newest.rate_dps:.1f} deg/s"
        return f"{turns}; the command was {bounds[0]:g}, and the rig allows {bounds[1]:g}"

    def strays(self, newest: AxisReading) -> str:
        """A sentence where it has left the angle at which it stood without a command, whatever its state says."""
        if self.limits.by_hand or not abs(newest.position_deg - self._rests_deg) > _OFF_GOAL_DEG:
            return ""
        return (
            f"axis {self.name} stood at {self._rests_deg:.1f} deg and was not told to move, and is at "
            f"{newest.position_deg:.1f} deg: check its controller, and whether something pushed it"
        )

    def stalled(self, newest: AxisReading) -> str:
        """A sentence where it pushes, does not move, and is not where the plan has it at this instant."""
        command = self.command
        if command is None or self.spins or self.limits.by_hand:
            return ""
        stood_s, after_s = newest.time_s - self._stands_since_s, newest.time_s - self.began_s
        if not newest.moving or stood_s < _STALL_S:
            return ""
        planned_deg = self.from_deg + command.turned_deg(after_s)
        behind = abs(planned_deg - newest.position_deg) > _stands_within_deg(abs(command.rate_dps))
        if not behind and after_s - command.duration_s < _STALL_S:
            return ""
        return (
            f"axis {self.name} has been at {newest.position_deg:.1f} deg for {stood_s:.0f} s, and should be at "
            f"{planned_deg:.1f} deg now: it is blocked, or its motor has no power"
        )

    def _allowed_dps(self) -> float:
        return max(self._told_dps, self._eased_dps if self.clock.now() <= self._eased_until_s else 0.0)

    def _allow(self, rate_dps: float = 0.0, acceleration_dps2: float = math.inf) -> None:
        """The rate before stays allowed until the axis has it no more, whatever its sign."""
        before_dps = self._allowed_dps()
        changes_s = (before_dps + rate_dps) / acceleration_dps2 if math.isfinite(before_dps) else 0.0
        self._told_dps, self._told_s = rate_dps, self.clock.now()
        self._eased_dps, self._eased_until_s = before_dps, self._told_s + changes_s + _EASING_S


class AxisControl:
    """Commands the axes and keeps their readings. One thread, the run's own."""

    def __init__(
        self,
        devices: Mapping[str, MotionAxis],
        clock: Clock,
        event: Tell,
        latest_s: float = 1.0,
        *,
        keep_track: bool = False,
    ) -> None:
        """`keep_track`: every reading is an event, which aligns another logger's recording."""
        self._clock, self._event, self._latest_s, self._keep_track = clock, event, latest_s, keep_track
        self.axes = {name: Axis(name, device, clock, event) for name, device in devices.items()}
        self.late_s = 0.0

    @property
    def by_hand(self) -> bool:
        return any(axis.limits.by_hand for axis in self.axes.values())

    @property
    def turned_by_hand(self) -> bool:
        return any(axis.limits.by_hand and axis.command is not None for axis in self.axes.values())

    def _turning(self) -> list[Axis]:
        """The axes whose move ends by itself, by name."""
        return [axis for _, axis in sorted(self.axes.items()) if axis.looks_s < math.inf]

    def home(self, names: list[str], duties: Work) -> None:
        for name in names:
            self.axes[name].homed = False
        for name in names:
            self.axes[name].search(duties)
            self._settle(self.axes[name], duties)

    def is_homing(self, name: str) -> bool:
        """Whether an axis may still be told to find its reference, also after a run has been ended."""
        return self._clock.now() < self.axes[name].searches_since_s + _SEARCH_TOLD_S

    def go_to_start(self, step: str, start_deg: Mapping[str, float], duties: Work) -> None:
        """Bring axes to the starting angles of a step that does not follow another at once."""
        for name, goal in start_deg.items():
            axis, limits = self.axes[name], self.axes[name].limits
            if limits.travel_deg == (-math.inf, math.inf):
                # An endless axis has no cable to unwind: it goes to the nearest equal angle.
                goal += 360.0 * round((axis.at_deg - goal) / 360.0)
            if not axis.stands_at(goal):
                rate, acceleration = min(limits.max_rate_dps, _START_DPS), min(limits.max_acceleration_dps2, _START_DPS)
                axis.tell(step, AxisCommand(0.0, name, "go", goal - axis.at_deg, rate, acceleration))
                self._settle(axis, duties)

    def move(self, step: str, move: AxisCommand, due_s: float, duties: Work) -> None:
        """A turn waits until the turn before it has ended, of any axis: one axis turns at a time, the others hold. The
        delay is in the journal."""
        axis = self.axes[move.axis]
        if (late_s := self._clock.now() - due_s) > self._latest_s:
            raise StepNotDone(f"a {move.kind} of axis {move.axis} began {late_s:.1f} s late")
        for other in self._turning():
            if other is not axis or move.kind == "turn":
                self._settle(other, duties)
        axis.tell(step, move)

    def look(self) -> float:
        """Read an axis from the planned end of its move until it stands: its standstill begins there. Returns when to
        look again."""
        for axis in self._turning():
            now = self._clock.now()
            if axis.looks_s <= now:
                axis.looks_s = now + axis.poll_s
                self._read(axis)
        return min((axis.looks_s for axis in self._turning()), default=math.inf)

    def read(self, *, planned: bool = False) -> None:
        """Read all axes; `planned`: the recipe takes a reading, of an axis that still moves as soon as it stands."""
        for axis in self.axes.values():
            axis.awaited = axis.awaited or planned
        for axis in self.axes.values():
            self._read(axis)

    def watch(self) -> None:
        """Read the rates of axes that have a motor, more often where they move."""
        for name, axis in self.axes.items():
            every_s = _WATCH_STANDING_S if axis.command is None else _WATCH_MOVING_S
            if axis.homed is False or axis.limits.by_hand:
                continue
            if axis.newest is not None and self._clock.now() - axis.newest.time_s < every_s:
                continue
            reading = axis.read()
            if self._keep_track:
                place = {"time_s": reading.time_s, "position_deg": reading.position_deg}
                self._event("track", at_once=False, axis=name, **place)
            axis.require_rate(reading)

    def violated(self) -> dict[str, str]:
        """What is wrong with the newest readings, by the rules of `interlocks`."""
        rules = {
            "axis fault": Axis.faulty,
            "over-speed": Axis.too_fast,
            "stray axis": Axis.strays,
            "stalled axis": Axis.stalled,
        }
        read = [(axis, axis.newest) for axis in self.axes.values() if axis.newest is not None]
        return {rule: "; ".join(filter(None, itertools.starmap(said, read))) for rule, said in rules.items()}

    def settle_all(self, duties: Work) -> None:
        for axis in self._turning():
            self._settle(axis, duties)

    def _settle(self, axis: Axis, duties: Work) -> None:
        """Wait until an axis stands; it is stopped at the time-out. A turn by hand has no time-out."""
        longest_s = math.inf if axis.limits.by_hand else max(0.0, axis.ends_s - self._clock.now()) + _LONGEST_MOVE_S
        stands = until(
            lambda: not self._read(axis).moving, self._clock, duties, longest_s=longest_s, every_s=axis.poll_s
        )
        if not stands:
            axis.device.stop()
            raise HardwareError(
                f"Axis {axis.name!r} is still moving {_LONGEST_MOVE_S:g} s after its step. It was stopped."
            )

    def end_spins(self, step: str, at_s: float) -> None:
        for name, axis in sorted(self.axes.items()):
            if axis.spins:
                axis.tell(step, AxisCommand(at_s, name, "stop"))

    def stop(self) -> None:
        for axis in self.axes.values():
            axis.stop()

    def _read(self, axis: Axis) -> AxisReading:
        before, reading, by_hand = axis.newest, axis.read(), axis.limits.by_hand
        # An unknown angle is no reading, and a typed angle is one reading however often it is read.
        if not math.isnan(reading.position_deg) and before != reading:
            planned = not reading.moving and (axis.awaited or by_hand)
            self._event("angle", at_once=False, axis=axis.name, planned=planned, **event_fields(reading))
        if reading.moving:
            return reading
        axis.awaited, axis.looks_s = False, math.inf
        if axis.spins:
            return reading
        late_s, command, name = reading.time_s - axis.ends_s, axis.ended(reading), axis.name
        if command is None or command.kind == "go":
            return reading
        if by_hand:
            # An early turn makes up for late ones before it.
            self.late_s = max(0.0, self.late_s + late_s)
        elif late_s > self._latest_s:
            raise StepNotDone(
                f"a turn of axis {name} ended {late_s:.1f} s late, and the rest after it is shorter by this time"
            )
        elif abs(reading.position_deg - axis.goal_deg) > _OFF_GOAL_DEG:
            at = f"axis {name} is at {reading.position_deg:.3f} deg"
            raise StepNotDone(f"{at}, and its target is {axis.goal_deg:.3f}")
        return reading


def _stands_within_deg(rate_dps: float) -> float:
    """How far an axis with this command goes while it counts as standing."""
    return _STALL_SHARE * _STALL_S * rate_dps


def _tolerance_dps(rate_dps: float) -> float:
    return _OFF_RATE * abs(rate_dps) + _OFF_RATE_DPS
