"""The axes in a run: their commands, readings and state of motion.

A motor does a turn in the track's time; it is read from its planned end on until it stands. An operator's turn may take
longer: while an axis is turned by hand nothing else of the track begins, and everything after it is delayed by as much
as the turn was late (`late_s`), so that every rest keeps its length; early turns make up for late ones.

Deviations from the track are `amiss`: a late command, a turn that ended late or at another angle, a spin at another
rate. The allowed rate of an axis (`allowed`) follows from its commands, and `interlocks` compares the readings with it.
"""

import math
from collections.abc import Callable, Mapping
from dataclasses import replace
from functools import partial

from gradcal_jax.hardware.chamber_control import Tell
from gradcal_jax.hardware.clock import Clock, beside
from gradcal_jax.hardware.errors import HardwareError
from gradcal_jax.hardware.journal import event_fields
from gradcal_jax.hardware.roles import AxisLimits, AxisReading, MotionAxis
from gradcal_jax.hardware.track import AxisCommand

_POLL_S = 0.05
_POLL_BY_HAND_S = 0.25
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


class AxisControl:
    """Commands the axes and keeps their readings. One thread, the run's own."""

    def __init__(
        self,
        axes: Mapping[str, MotionAxis],
        clock: Clock,
        event: Tell,
        latest_s: float = 1.0,
        *,
        keep_track: bool = False,
    ) -> None:
        self._axes, self._clock, self._event = axes, clock, event
        self._latest_s, self._keep_track = latest_s, keep_track
        self._goal_deg: dict[str, float] = {}
        # Moves that end by themselves: the time of the next reading.
        self._turning: dict[str, float] = {}
        self._by_hand: set[str] = set()
        # Commanded: the rate now, the rate before and until when that is still allowed, and when turns are to end.
        self._asked_dps: dict[str, float] = {}
        self._asked_at_s: dict[str, float] = {}
        self._easing: dict[str, tuple[float, float]] = {}
        self._due_end_s: dict[str, float] = {}
        # The move of a motor: when and where it began, and the turn. And where the axis has stood, nearly, since when.
        self._turns: dict[str, tuple[float, float, AxisCommand]] = {}
        self._stands: dict[str, tuple[float, float]] = {}
        # An axis is left to its search for the reference: nothing else is asked of it.
        self._searching: set[str] = set()
        self._homing: dict[str, float] = {}
        # An axis that the run does not move is not homed: what it reports at the first reading is no fault of the run,
        # such as the alarm of a board that waits for its reference.
        self._moved: set[str] = set()
        self._reported_before: dict[str, frozenset[str]] = {}
        # Constant rates, and when they are reached.
        self._spins: dict[str, tuple[float, float]] = {}
        self._off_rate: dict[str, int] = {}
        # Axes of which the recipe takes a reading as soon as they stand.
        self._awaited: set[str] = set()
        self._limits: dict[str, AxisLimits] = {}
        self.newest: dict[str, AxisReading] = {}
        self.late_s = 0.0
        self.amiss: list[str] = []

    def home(self, names: list[str], meanwhile: Callable[[], None]) -> None:
        self._searching.update(names)
        self._moved.update(names)
        for name in names:
            self._event("homing", axis=name)
            if self._limits_of(name).by_hand:
                self._by_hand.add(name)
            # The device chooses the rate of its search for the reference.
            self._asked_dps[name] = math.inf
            beside(partial(self._home, name), self._clock, meanwhile)
            self._searching.discard(name)
            self.settle(name, meanwhile)
            self._goal_deg[name] = 0.0

    def _home(self, name: str) -> None:
        self._homing[name] = self._clock.now()
        try:
            self._axes[name].home()
        finally:
            del self._homing[name]

    def is_homing(self, name: str) -> bool:
        """Whether an axis may still be told to find its reference, also after a run has been ended."""
        return self._clock.now() < self._homing.get(name, -math.inf) + _SEARCH_TOLD_S

    @property
    def turned_by_hand(self) -> bool:
        return not self._by_hand.isdisjoint(self._due_end_s)

    @property
    def by_hand(self) -> bool:
        return bool(self._by_hand)

    @property
    def look_s(self) -> list[float]:
        return list(self._turning.values())

    def go_to_start(
        self, step: str, start_deg: Mapping[str, float], meanwhile: Callable[[], None], *, watched: bool = False
    ) -> None:
        """Bring axes to the starting angles of a step that does not follow another at once. `watched`: the run was not
        interrupted since their last moves, so that an axis that stands there is not told to go there."""
        for name, position in start_deg.items():
            limits = self._limits_of(name)
            goal = position
            if limits.travel_deg == (-math.inf, math.inf):
                # An endless axis has no cable to unwind: it goes to the nearest equal angle.
                goal += 360.0 * round((self._at(name) - position) / 360.0)
            if not self._stands_at(name, goal, watched=watched):
                rate, acceleration = min(limits.max_rate_dps, 60.0), min(limits.max_acceleration_dps2, 60.0)
                goes = AxisCommand(0.0, name, "go", position_deg=goal, rate_dps=rate, acceleration_dps2=acceleration)
                self._command(step, goes)
                self.settle(name, meanwhile)

    def move(self, step: str, move: AxisCommand, due_s: float, meanwhile: Callable[[], None]) -> None:
        """A turn waits until the turn before it has ended, of any axis: one axis turns at a time, the others hold. The
        delay is in the journal."""
        name = move.axis
        if (late_s := self._clock.now() - due_s) > self._latest_s:
            self.amiss.append(f"a {move.kind} of axis {name} began {late_s:.1f} s late")
        if move.kind in ("go", "turn") and (name in self._turning or name in self._spins):
            if self._spins.pop(name, None):
                self._axes[name].stop()
            self.settle(name, meanwhile)
        for other in sorted(self._turning.keys() - {name}):
            self.settle(other, meanwhile)
        self._command(step, move)

    def look(self) -> None:
        """Read an axis from the planned end of its move until it stands: its standstill begins there."""
        for name in sorted(self._turning):
            if self._turning[name] <= self._clock.now():
                self._turning[name] = self._clock.now() + (_POLL_BY_HAND_S if name in self._by_hand else _POLL_S)
                self._read(name)

    def read(self, *, planned: bool = False) -> None:
        """Read all axes; `planned`: the recipe takes a reading, of an axis that still moves as soon as it stands."""
        self._awaited |= self._axes.keys() if planned else set()
        for name in self._axes:
            self._read(name)

    def watch(self) -> None:
        """Read the rates of axes that have a motor, more often where they move.

        These readings are events only where the track is recorded, which aligns another logger's recording.
        """
        now = self._clock.now()
        for name in self._axes:
            under_way = name in self._turning or name in self._spins
            last = self.newest.get(name)
            every_s = _WATCH_MOVING_S if under_way else _WATCH_STANDING_S
            left_alone = name in self._searching or self._limits_of(name).by_hand
            if left_alone or (last is not None and now - last.time_s < every_s):
                continue
            reading = self.newest[name] = self._heard(name)
            self._note_place(name, reading)
            if self._keep_track:
                place = {"time_s": reading.time_s, "position_deg": reading.position_deg}
                self._event("track", at_once=False, axis=name, **place)
            asked_dps, runs_s = self._spins.get(name, (0.0, math.inf))
            off = reading.time_s > runs_s and abs(reading.rate_dps - asked_dps) > _off(asked_dps)
            self._off_rate[name] = self._off_rate.get(name, 0) + 1 if off else 0
            # One wrong reading may come from a busy host.
            if self._off_rate[name] == _OFF_READINGS:
                self.amiss.append(f"axis {name} spins at {reading.rate_dps:.2f} deg/s instead of {asked_dps:g}")

    def allowed(self) -> dict[str, tuple[float, float]]:
        """The rates allowed to axes with a motor now, deg/s: by the last commands, and by the rig. An axis that has not
        been read since its last command is absent."""
        now, rates = self._clock.now(), dict[str, tuple[float, float]]()
        for name, reading in self.newest.items():
            limits = self._limits_of(name)
            if not limits.by_hand and reading.time_s > self._asked_at_s.get(name, -math.inf):
                rates[name] = (self._allowed_dps(name, now), limits.max_rate_dps)
        return rates

    def stalled(self) -> tuple[str, ...]:
        """A sentence for each axis that pushes, does not move, and is not where the plan has it at this instant."""
        sentences: list[str] = []
        for name, (began_s, from_deg, turn) in self._turns.items():
            reading = self.newest[name]
            _, since_s = self._stands.get(name, (math.nan, math.inf))
            stood_s, after_s = reading.time_s - since_s, reading.time_s - began_s
            if not reading.moving or stood_s < _STALL_S:
                continue
            planned_deg = from_deg + turn.turned_deg(after_s)
            behind = abs(planned_deg - reading.position_deg) > _stands_within_deg(abs(turn.rate_dps))
            if behind or after_s - turn.duration_s >= _STALL_S:
                sentences.append(
                    f"axis {name} has been at {reading.position_deg:.1f} deg for {stood_s:.0f} s, and should be at "
                    f"{planned_deg:.1f} deg now: it is blocked, or its motor has no power"
                )
        return tuple(sentences)

    def settle_all(self, meanwhile: Callable[[], None]) -> None:
        for name in sorted(self._turning):
            self.settle(name, meanwhile)

    def settle(self, name: str, meanwhile: Callable[[], None]) -> None:
        """Wait until an axis stands; it is stopped at the time-out. A turn by hand has no time-out."""
        began_s, _, turn = self._turns.get(name, (-math.inf, 0.0, AxisCommand(0.0, name, "stop")))
        planned_s = max(self._clock.now(), began_s + turn.duration_s)
        end = math.inf if name in self._by_hand else planned_s + _LONGEST_MOVE_S
        while self._read(name).moving:
            if self._clock.now() > end:
                self._axes[name].stop()
                raise HardwareError(
                    f"Axis {name!r} is still moving {_LONGEST_MOVE_S:g} s after its step. It was stopped."
                )
            meanwhile()
            self._clock.sleep(_POLL_BY_HAND_S if name in self._by_hand else _POLL_S)

    def end_spins(self, step: str, at_s: float) -> None:
        for name in sorted(self._spins):
            self._command(step, AxisCommand(at_s, name, "stop"))

    def stop(self) -> None:
        for name, axis in self._axes.items():
            axis.stop()
            self._asks(name, 0.0)
            self._event("stopped", at_once=False, axis=name)
        for under_way in (self._turning, self._due_end_s, self._turns, self._spins, self.amiss):
            under_way.clear()

    def _stands_at(self, name: str, goal_deg: float, *, watched: bool) -> bool:
        """Whether an axis is at a goal: a motor that was told to go there, one by hand within a tolerance."""
        newest = self.newest.get(name)
        if name in self._by_hand:
            return newest is not None and not newest.moving and abs(newest.position_deg - goal_deg) <= _NEAR_BY_HAND_DEG
        if newest is None:
            return abs(self._goal_deg.get(name, 0.0) - goal_deg) <= 1e-9
        # Its standstill goes on: a motor that is told to go where it is may move a little.
        stands = watched and not newest.moving and abs(newest.position_deg - goal_deg) <= _OFF_GOAL_DEG
        return stands and abs(self._goal_deg.get(name, math.inf) - goal_deg) <= 1e-9

    def _command(self, step: str, move: AxisCommand) -> None:
        axis, name = self._axes[move.axis], move.axis
        self._awaited.discard(name)
        self._asks(name, abs(move.rate_dps), move.acceleration_dps2)
        for before in (self._due_end_s, self._turns, self._stands, self._spins):
            before.pop(name, None)
        began = self._clock.now()
        if move.kind in ("go", "turn"):
            turned = self._goal_deg.get(name, 0.0) + move.angle_deg
            goal = turned if move.kind == "turn" else move.position_deg
            axis.move_to(goal, move.rate_dps, move.acceleration_dps2)
            self._goal_deg[name] = goal
            ends_s = began + (move.duration_s + move.answer_s if move.kind == "turn" else 0.0)
            self._turning[name], self._due_end_s[name] = ends_s, ends_s
            if name in self._by_hand:
                self._turning[name] = began
            else:
                self._due_end_s[name] = ends_s if move.kind == "turn" else math.inf
                self._turns[name] = began, self._at(name), replace(move, kind="turn", angle_deg=goal - self._at(name))
        elif move.kind == "spin":
            axis.spin(move.rate_dps, move.acceleration_dps2)
            newest = self.newest.get(name)
            change = abs(move.rate_dps - (newest.rate_dps if newest is not None else 0.0))
            self._spins[name] = (move.rate_dps, began + change / move.acceleration_dps2 + _EASING_S)
            self._turning.pop(name, None)
        else:
            axis.stop()
            self._turning[name] = began
        self._event("move", at_once=False, step=step, began_s=began, **event_fields(move))

    def _read(self, name: str) -> AxisReading:
        before, reading = self.newest.get(name), self._heard(name)
        self.newest[name] = reading
        self._note_place(name, reading)
        # An unknown angle is no reading, and a typed angle is one reading however often it is read.
        if not math.isnan(reading.position_deg) and before != reading:
            planned = not reading.moving and (name in self._awaited or name in self._by_hand)
            self._event("angle", at_once=False, axis=name, planned=planned, **event_fields(reading))
        if not reading.moving:
            self._awaited.discard(name)
            self._turning.pop(name, None)
            self._turns.pop(name, None)
            if name not in self._spins:
                self._stood(name, reading)
        return reading

    def _heard(self, name: str) -> AxisReading:
        """A reading; of an axis that the run does not move only the faults that it did not report at first."""
        reading = self._axes[name].read()
        if name in self._moved:
            return reading
        before = self._reported_before.setdefault(name, frozenset(reading.faults))
        # A fault that has cleared is a new one when it comes again.
        self._reported_before[name] = before & set(reading.faults)
        return replace(reading, faults=tuple(fault for fault in reading.faults if fault not in before))

    def _at(self, name: str) -> float:
        newest = self.newest.get(name)
        known = newest is not None and not math.isnan(newest.position_deg)
        return newest.position_deg if newest is not None and known else self._goal_deg.get(name, 0.0)

    def _note_place(self, name: str, reading: AxisReading) -> None:
        place_deg, _ = self._stands.get(name, (math.inf, 0.0))
        if abs(reading.position_deg - place_deg) > _stands_within_deg(self._asked_dps.get(name, 0.0)):
            self._stands[name] = reading.position_deg, reading.time_s

    def _stood(self, name: str, reading: AxisReading) -> None:
        if self._asked_dps.get(name):
            self._asks(name, 0.0)
        due_s = self._due_end_s.pop(name, None)
        if due_s is None:
            return
        if name in self._by_hand:
            # An early turn makes up for late ones before it.
            self.late_s = max(0.0, self.late_s + reading.time_s - due_s)
            return
        if (late_s := reading.time_s - due_s) > self._latest_s:
            self.amiss.append(
                f"a turn of axis {name} ended {late_s:.1f} s late, and the rest after it is shorter by this time"
            )
        if abs(reading.position_deg - self._goal_deg[name]) > _OFF_GOAL_DEG:
            self.amiss.append(
                f"axis {name} is at {reading.position_deg:.3f} deg, and its target is {self._goal_deg[name]:.3f}"
            )

    def _asks(self, name: str, rate_dps: float, acceleration_dps2: float = math.inf) -> None:
        """Set the commanded rate of an axis; the rate before stays allowed until the axis has slowed down."""
        now = self._clock.now()
        before_dps = self._allowed_dps(name, now)
        slows_s = (before_dps - rate_dps) / acceleration_dps2 if acceleration_dps2 > 0.0 else 0.0
        slows_s = min(max(slows_s, 0.0), _LONGEST_MOVE_S) if math.isfinite(before_dps) else 0.0
        self._easing[name] = (before_dps, now + slows_s + _EASING_S)
        self._asked_dps[name], self._asked_at_s[name] = rate_dps, now

    def _allowed_dps(self, name: str, now: float) -> float:
        before_dps, until_s = self._easing.get(name, (0.0, -math.inf))
        return max(self._asked_dps.get(name, 0.0), before_dps if now <= until_s else 0.0)

    def _limits_of(self, name: str) -> AxisLimits:
        """The axis's limits at the beginning of the run."""
        if name not in self._limits:
            self._limits[name] = self._axes[name].limits()
        return self._limits[name]


def _stands_within_deg(rate_dps: float) -> float:
    """How far an axis with this command goes while it counts as standing."""
    return _STALL_SHARE * _STALL_S * rate_dps


def _off(asked_dps: float) -> float:
    return _OFF_RATE * abs(asked_dps) + _OFF_RATE_DPS


def too_fast(rate_dps: float, allowed: tuple[float, float]) -> bool:
    return abs(rate_dps) > min(bound + _off(bound) for bound in allowed)
