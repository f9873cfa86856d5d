"""The axes in a run: their commands, readings and state of motion.

A motor does a turn in the track's time; it is read from its planned end on until it stands. An operator's turn may take
longer: while an axis is turned by hand nothing else of the track begins, and everything after it is delayed by as much
as the turn was late (`late_s`), so that every rest keeps its length; early turns make up for late ones.

Deviations from the track are `amiss`: a late command, a turn that ended late or at another angle, a spin at another
rate. The allowed rate of an axis (`allowed`) follows from its commands, and `interlocks` compares the readings with it.
"""

import math
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field, replace
from functools import cached_property, partial

from gradcal_jax.hardware.chamber_control import Tell
from gradcal_jax.hardware.clock import Clock, beside
from gradcal_jax.hardware.errors import HardwareError
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


@dataclass
class AxisMotion:
    """One axis in a run: what it was commanded to do, and what its readings showed. Times are of the run's clock."""

    name: str
    axis: MotionAxis
    homed: bool = False
    """Whether the run moves it. What another axis reports at its first reading is no fault of the run, such as the
    alarm of a board that waits for its reference."""
    by_hand: bool = False
    homing_since_s: float = -math.inf
    searching: bool = False
    """It is left to its search for the reference: nothing else is asked of it."""
    reported_before: frozenset[str] | None = None
    newest: AxisReading | None = None
    command: AxisCommand | None = None
    """What is under way: a turn until it stands, a spin until it is stopped."""
    began_s: float = 0.0
    from_deg: float = 0.0
    goal_deg: float = 0.0
    """Where the last turn was to end."""
    looks_s: float = math.inf
    """The time of the next reading, of a move that ends by itself."""
    off_rate: int = 0
    """How many readings one after the other showed another rate."""
    awaited: bool = False
    """Whether the recipe takes a reading as soon as it stands."""
    asked_dps: float = 0.0
    asked_s: float = -math.inf
    eased: tuple[float, float] = (0.0, -math.inf)
    """The rate before the last command, and until when it is allowed."""
    stands: tuple[float, float] = (math.inf, math.inf)
    """Where it has stood, nearly, and since when."""

    @cached_property
    def limits(self) -> AxisLimits:
        """Those at the beginning of the run."""
        return self.axis.limits()

    @property
    def poll_s(self) -> float:
        return _POLL_BY_HAND_S if self.by_hand else _POLL_S

    @property
    def spins(self) -> bool:
        return self.command is not None and self.command.kind == "spin"

    @property
    def ends_s(self) -> float:
        """When what is under way is planned to end."""
        command = self.command
        return -math.inf if command is None else self.began_s + command.duration_s + command.answer_s

    @property
    def at_deg(self) -> float:
        """Its angle, as far as it is known."""
        if self.newest is None or math.isnan(self.newest.position_deg):
            return self.goal_deg
        return self.newest.position_deg

    def read(self) -> AxisReading:
        """A reading; of an axis that the run does not move only the faults that it did not report at first."""
        reading = self.axis.read()
        if not self.homed:
            before = frozenset(reading.faults) if self.reported_before is None else self.reported_before
            # A fault that has cleared is a new one when it comes again.
            self.reported_before = before & set(reading.faults)
            reading = replace(reading, faults=tuple(fault for fault in reading.faults if fault not in before))
        self.newest = reading
        if abs(reading.position_deg - self.stands[0]) > _stands_within_deg(self.asked_dps):
            self.stands = reading.position_deg, reading.time_s
        return reading

    def allowed_dps(self, now_s: float) -> float:
        before_dps, until_s = self.eased
        return max(self.asked_dps, before_dps if now_s <= until_s else 0.0)

    def asks(self, now_s: float, rate_dps: float, acceleration_dps2: float = math.inf) -> None:
        """Set the commanded rate; the rate before stays allowed until the axis has slowed down."""
        before_dps = self.allowed_dps(now_s)
        slows_s = (before_dps - rate_dps) / acceleration_dps2 if acceleration_dps2 > 0.0 else 0.0
        slows_s = min(max(slows_s, 0.0), _LONGEST_MOVE_S) if math.isfinite(before_dps) else 0.0
        self.eased = before_dps, now_s + slows_s + _EASING_S
        self.asked_dps, self.asked_s = rate_dps, now_s

    def stands_at(self, goal_deg: float, *, watched: bool) -> bool:
        """Whether it is at a goal: a motor that was told to go there, one by hand within a tolerance."""
        newest, told = self.newest, abs(self.goal_deg - goal_deg) <= 1e-9
        if newest is None:
            return told and not self.by_hand
        within_deg = _NEAR_BY_HAND_DEG if self.by_hand else _OFF_GOAL_DEG
        near = not newest.moving and abs(newest.position_deg - goal_deg) <= within_deg
        # Its standstill goes on: a motor that is told to go where it is may move a little.
        return near and (self.by_hand or (watched and told))

    def stalled(self) -> str:
        """A sentence where it pushes, does not move, and is not where the plan has it at this instant."""
        command, newest = self.command, self.newest
        if command is None or newest is None or self.spins or self.by_hand:
            return ""
        stood_s, after_s = newest.time_s - self.stands[1], newest.time_s - self.began_s
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


@dataclass
class AxisControl:
    """Commands the axes and keeps their readings. One thread, the run's own."""

    devices: Mapping[str, MotionAxis]
    clock: Clock
    event: Tell
    latest_s: float = 1.0
    keep_track: bool = False
    late_s: float = 0.0
    amiss: list[str] = field(default_factory=list[str])

    def __post_init__(self) -> None:
        self._motions = {name: AxisMotion(name, axis) for name, axis in self.devices.items()}

    @property
    def newest(self) -> dict[str, AxisReading]:
        return {name: motion.newest for name, motion in self._motions.items() if motion.newest is not None}

    @property
    def turned_by_hand(self) -> bool:
        return any(motion.by_hand and motion.command is not None for motion in self._motions.values())

    @property
    def by_hand(self) -> bool:
        return any(motion.by_hand for motion in self._motions.values())

    @property
    def look_s(self) -> float:
        """When an axis is to be read again."""
        return min((motion.looks_s for motion in self._motions.values()), default=math.inf)

    def _turning(self) -> list[AxisMotion]:
        """The axes whose move ends by itself, by name."""
        return [motion for _, motion in sorted(self._motions.items()) if motion.looks_s < math.inf]

    def home(self, names: list[str], meanwhile: Callable[[], None]) -> None:
        motions = [self._motions[name] for name in names]
        for motion in motions:
            motion.searching = motion.homed = True
        for motion in motions:
            self.event("homing", axis=motion.name)
            # Asked for before it searches, when a device may answer nothing.
            motion.by_hand = motion.limits.by_hand
            # The device chooses the rate of its search for the reference.
            motion.asked_dps = math.inf
            beside(partial(self._home, motion), self.clock, meanwhile)
            motion.searching = False
            self._settle(motion, meanwhile)

    def _home(self, motion: AxisMotion) -> None:
        motion.homing_since_s = self.clock.now()
        try:
            motion.axis.home()
        finally:
            motion.homing_since_s = -math.inf

    def is_homing(self, name: str) -> bool:
        """Whether an axis may still be told to find its reference, also after a run has been ended."""
        return self.clock.now() < self._motions[name].homing_since_s + _SEARCH_TOLD_S

    def go_to_start(
        self, step: str, start_deg: Mapping[str, float], meanwhile: Callable[[], None], *, watched: bool = False
    ) -> None:
        """Bring axes to the starting angles of a step that does not follow another at once. `watched`: the run was not
        interrupted since their last moves, so that an axis that stands there is not told to go there."""
        for name, goal in start_deg.items():
            motion = self._motions[name]
            limits = motion.limits
            if limits.travel_deg == (-math.inf, math.inf):
                # An endless axis has no cable to unwind: it goes to the nearest equal angle.
                goal += 360.0 * round((motion.at_deg - goal) / 360.0)
            if not motion.stands_at(goal, watched=watched):
                rate, acceleration = min(limits.max_rate_dps, _START_DPS), min(limits.max_acceleration_dps2, _START_DPS)
                self._command(step, AxisCommand(0.0, name, "go", goal - motion.at_deg, rate, acceleration))
                self._settle(motion, meanwhile)

    def move(self, step: str, move: AxisCommand, due_s: float, meanwhile: Callable[[], None]) -> None:
        """A turn waits until the turn before it has ended, of any axis: one axis turns at a time, the others hold. The
        delay is in the journal."""
        motion = self._motions[move.axis]
        if (late_s := self.clock.now() - due_s) > self.latest_s:
            self.amiss.append(f"a {move.kind} of axis {move.axis} began {late_s:.1f} s late")
        if move.kind == "turn" and motion.spins:
            motion.axis.stop()
            motion.command = None
            self._settle(motion, meanwhile)
        for other in self._turning():
            if other is not motion or move.kind == "turn":
                self._settle(other, meanwhile)
        self._command(step, move)

    def look(self) -> None:
        """Read an axis from the planned end of its move until it stands: its standstill begins there."""
        for motion in self._turning():
            now = self.clock.now()
            if motion.looks_s <= now:
                motion.looks_s = now + motion.poll_s
                self._read(motion)

    def read(self, *, planned: bool = False) -> None:
        """Read all axes; `planned`: the recipe takes a reading, of an axis that still moves as soon as it stands."""
        for motion in self._motions.values():
            motion.awaited = motion.awaited or planned
        for motion in self._motions.values():
            self._read(motion)

    def watch(self) -> None:
        """Read the rates of axes that have a motor, more often where they move.

        These readings are events only where the track is recorded, which aligns another logger's recording.
        """
        now = self.clock.now()
        for name, motion in self._motions.items():
            every_s = _WATCH_STANDING_S if motion.command is None else _WATCH_MOVING_S
            if motion.searching or motion.limits.by_hand:
                continue
            if motion.newest is not None and now - motion.newest.time_s < every_s:
                continue
            reading = motion.read()
            if self.keep_track:
                place = {"time_s": reading.time_s, "position_deg": reading.position_deg}
                self.event("track", at_once=False, axis=name, **place)
            if motion.command is None or not motion.spins or reading.time_s <= motion.eased[1]:
                motion.off_rate = 0
                continue
            asked_dps = motion.command.rate_dps
            motion.off_rate = motion.off_rate + 1 if abs(reading.rate_dps - asked_dps) > _off(asked_dps) else 0
            # One wrong reading may come from a busy host.
            if motion.off_rate == _OFF_READINGS:
                self.amiss.append(f"axis {name} spins at {reading.rate_dps:.2f} deg/s instead of {asked_dps:g}")

    def allowed(self) -> dict[str, tuple[float, float]]:
        """The rates allowed to axes with a motor now, deg/s: by the last commands, and by the rig. An axis that has not
        been read since its last command is absent."""
        now, rates = self.clock.now(), dict[str, tuple[float, float]]()
        for name, motion in self._motions.items():
            newest = motion.newest
            if newest is not None and not motion.limits.by_hand and newest.time_s > motion.asked_s:
                rates[name] = (motion.allowed_dps(now), motion.limits.max_rate_dps)
        return rates

    def stalled(self) -> tuple[str, ...]:
        return tuple(sentence for motion in self._motions.values() if (sentence := motion.stalled()))

    def settle_all(self, meanwhile: Callable[[], None]) -> None:
        for motion in self._turning():
            self._settle(motion, meanwhile)

    def _settle(self, motion: AxisMotion, meanwhile: Callable[[], None]) -> None:
        """Wait until an axis stands; it is stopped at the time-out. A turn by hand has no time-out."""
        end_s = math.inf if motion.by_hand else max(self.clock.now(), motion.ends_s) + _LONGEST_MOVE_S
        while self._read(motion).moving:
            if self.clock.now() > end_s:
                motion.axis.stop()
                raise HardwareError(
                    f"Axis {motion.name!r} is still moving {_LONGEST_MOVE_S:g} s after its step. It was stopped."
                )
            meanwhile()
            self.clock.sleep(motion.poll_s)

    def end_spins(self, step: str, at_s: float) -> None:
        for name, motion in sorted(self._motions.items()):
            if motion.spins:
                self._command(step, AxisCommand(at_s, name, "stop"))

    def stop(self) -> None:
        for name, motion in self._motions.items():
            motion.axis.stop()
            motion.asks(self.clock.now(), 0.0)
            self.event("stopped", at_once=False, axis=name)
        for motion in self._motions.values():
            motion.command, motion.looks_s = None, math.inf
        self.amiss.clear()

    def _command(self, step: str, move: AxisCommand) -> None:
        motion, began_s = self._motions[move.axis], self.clock.now()
        before_dps = 0.0 if motion.newest is None else motion.newest.rate_dps
        motion.awaited = False
        motion.asks(began_s, abs(move.rate_dps), move.acceleration_dps2)
        motion.stands = math.inf, math.inf
        motion.command, motion.looks_s = None, math.inf
        motion.began_s, motion.from_deg = began_s, motion.at_deg if move.kind == "go" else motion.goal_deg
        if move.kind == "spin":
            motion.axis.spin(move.rate_dps, move.acceleration_dps2)
            # Another sign takes longer than a slower rate does.
            changes_s = abs(move.rate_dps - before_dps) / move.acceleration_dps2
            motion.eased = motion.eased[0], max(motion.eased[1], began_s + changes_s + _EASING_S)
            motion.command = move
        elif move.kind == "stop":
            motion.axis.stop()
            motion.looks_s = began_s
        else:
            goal_deg = motion.from_deg + move.angle_deg
            motion.axis.move_to(goal_deg, move.rate_dps, move.acceleration_dps2)
            motion.goal_deg, motion.command = goal_deg, move
            motion.looks_s = began_s if motion.by_hand or move.kind == "go" else began_s + move.duration_s
        self.event(
            "move", at_once=False, step=step, began_s=began_s, position_deg=motion.goal_deg, **event_fields(move)
        )

    def _read(self, motion: AxisMotion) -> AxisReading:
        before, reading = motion.newest, motion.read()
        # An unknown angle is no reading, and a typed angle is one reading however often it is read.
        if not math.isnan(reading.position_deg) and before != reading:
            planned = not reading.moving and (motion.awaited or motion.by_hand)
            self.event("angle", at_once=False, axis=motion.name, planned=planned, **event_fields(reading))
        if not reading.moving:
            motion.awaited = False
            motion.looks_s = math.inf
            if not motion.spins:
                self._stood(motion, reading)
        return reading

    def _stood(self, motion: AxisMotion, reading: AxisReading) -> None:
        if motion.asked_dps:
            motion.asks(self.clock.now(), 0.0)
        command, late_s = motion.command, reading.time_s - motion.ends_s
        motion.command = None
        if command is None or command.kind == "go":
            return
        if motion.by_hand:
            # An early turn makes up for late ones before it.
            self.late_s = max(0.0, self.late_s + late_s)
            return
        if late_s > self.latest_s:
            self.amiss.append(
                f"a turn of axis {motion.name} ended {late_s:.1f} s late, and the rest after it is shorter by this time"
            )
        if abs(reading.position_deg - motion.goal_deg) > _OFF_GOAL_DEG:
            self.amiss.append(
                f"axis {motion.name} is at {reading.position_deg:.3f} deg, and its target is {motion.goal_deg:.3f}"
            )


def _stands_within_deg(rate_dps: float) -> float:
    """How far an axis with this command goes while it counts as standing."""
    return _STALL_SHARE * _STALL_S * rate_dps


def _off(asked_dps: float) -> float:
    return _OFF_RATE * abs(asked_dps) + _OFF_RATE_DPS


def too_fast(rate_dps: float, allowed: tuple[float, float]) -> bool:
    return abs(rate_dps) > min(bound + _off(bound) for bound in allowed)
