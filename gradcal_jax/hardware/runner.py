"""Executes a track on a bench: one clock, everything journalled, safe at every kind of end.

Each change of state is an event of the journal. A run never waits for a person to resume it: an interlock, an operator
or a failure ends it, within a quarter of a second of the run's clock or when the device that has the current command
has answered, and it can be resumed. Interlocks hold in every state, also while an axis searches its reference or the
chamber acknowledges. A step that was interrupted, or that lacks something of what the recipe states, is repeated from
its beginning: the chamber goes to the step's first temperature and is stable there, the axes go to their angles, and
the journal marks the seam.

Beside the executing thread, one thread reads the chamber, and one for each unit writes its bytes to the disk: no slow
device delays a move. A runner with `first_step` resumes after a crash (see `run_folder`); `guard` makes a rig safe when
this process is killed.
"""

import math
import threading
import time
from collections import deque
from collections.abc import Callable
from dataclasses import dataclass, field
from functools import partial
from typing import Any, Literal

from gradcal_jax.hardware.axis_control import AxisControl
from gradcal_jax.hardware.chamber_control import ChamberControl
from gradcal_jax.hardware.clock import Clock, beside, in_thread
from gradcal_jax.hardware.dry_run import dry_run_of
from gradcal_jax.hardware.errors import HardwareError, LimitExceeded, sentence_of
from gradcal_jax.hardware.guard import make_safe, put_back
from gradcal_jax.hardware.interlocks import InterlockLimits, Interlocks
from gradcal_jax.hardware.journal import Journal, event_fields
from gradcal_jax.hardware.setup import Bench, require_identity
from gradcal_jax.hardware.supervision import RunProgress, RunResult, RunState, SafeOutcome
from gradcal_jax.hardware.track import Ask, Stable, Track, TrackStep
from gradcal_jax.hardware.unit_control import ExecutedStep, SampleLosses, UnitControl
from gradcal_jax.spec.rig import ImuDevice

_HELPERS_END_S, _HELPERS_LOOK_S = 5.0, 0.02
_SLICE_S = 0.25
_ARRIVAL_S, _PIECES_S, _LONGEST_ARRIVAL_S = 0.1, 0.2, 60.0
_TRIES = 3
# The chamber's temperature while the operator reaches into it.
_FOR_HANDS_C = 23.0


class StepNotDone(Exception):
    """A step was not executed as written; `unit`: the one whose samples it lacks."""

    def __init__(self, number: int, why: str, unit: str = "") -> None:
        Exception.__init__(self, why)
        self.number, self.unit = number, unit


@dataclass
class Runner:
    """One run. `run` returns only after everything was made safe, and raises no errors of devices."""

    track: Track
    bench: Bench
    journal: Journal
    clock: Clock
    limits: InterlockLimits = field(default_factory=InterlockLimits)
    on_progress: Callable[[RunProgress], None] | None = None
    on_alarm: Callable[[str], None] = lambda sentence: None
    chamber_every_s: float = 5.0
    safe_deadline_s: float = 60.0
    first_step: int = 0
    mounting: int = 0
    """The mounting of the IMUs when the run begins, as `Ask.mounting`; 0: unknown."""
    on_begin: Callable[[], None] = lambda: None
    """Called once, before the first command that can make anything unsafe."""
    on_new_session: Callable[[int], None] = lambda first_step: None
    """Called when the samples of an IMU are used again, with the step at which the run continues."""

    def __post_init__(self) -> None:
        self.state = RunState.IDLE
        self.begun = False
        """Whether anything was commanded."""
        self.ticked_s = time.monotonic()
        """Real time of the last sign of life of the run's own thread."""
        self._interlocks = Interlocks()
        self._problem = ""
        self._working, self._watching = threading.Event(), threading.Event()
        chamber, latest_s = self.bench.chamber, self.limits.latest_s
        self._chamber = None if chamber is None else ChamberControl(chamber, self.clock, self._event, self.abort)
        track_kept = not self.bench.imus
        self._axes = AxisControl(self.bench.axes, self.clock, self._event, latest_s, keep_track=track_kept)
        self._units: dict[str, UnitControl] = {}
        self._unconfirmed: deque[ExecutedStep] = deque()
        self._tries: dict[int, int] = {}
        self._shortfall: StepNotDone | None = None
        self._heard_end_s = math.inf
        self._shown_s = -math.inf
        self._late: set[str] = set()
        self._steps_done = self.first_step
        self._step_ends_s = 0.0

    def abort(self, why: str) -> None:
        """Make safe and end; from any thread, and in a signal handler."""
        self._problem = self._problem or why

    def run(self) -> RunResult:
        helpers: list[threading.Event] = []
        status: Literal["success", "aborted"] = "success"
        reason = ""
        with self.clock.party():
            try:
                self._working.set()
                self._watching.set()
                self._prepare(helpers)
                self._duties()
                self._enter(RunState.RUNNING)
                self._execute()
            except KeyboardInterrupt:
                status, reason = "aborted", "interrupted from the keyboard"
            except Exception as problem:
                status, reason = "aborted", sentence_of(problem)
            outcomes = self._end(status, reason)
            self._working.clear()
            end_s = self.clock.now() + _HELPERS_END_S
            while self.clock.now() < end_s and not all(helper.is_set() for helper in helpers):
                self.clock.sleep(_HELPERS_LOOK_S)
            # At the end: no other thread reads the lines of the units any more.
            for name, problem in put_back(self.bench).items():
                self._event("settings put back", device=name, problem=problem)
            unsafe = ", ".join(outcome.name for outcome in outcomes if not outcome.verified)
            if unsafe or status == "aborted":
                self.on_alarm(f"The run was {status}: {reason}" + (f" NOT VERIFIED SAFE: {unsafe}" if unsafe else ""))
            self._event("end", exit_status=status, reason=reason, verified_safe=not unsafe)
        return RunResult(status, reason, outcomes, self._steps_done, self.begun)

    # ------------------------------------------------------------------------------------------------ the beginning

    def _prepare(self, helpers: list[threading.Event]) -> None:
        for name, entry, device in self.bench.devices():
            identity = device.identify()
            require_identity(name, entry, identity)
            self._event("identity", device=name, **event_fields(identity))
            if isinstance(entry, ImuDevice):
                self._units[name] = UnitControl(name, self.bench.imus[name], self.clock)
                self._tell_settings(self._units[name])
        axes = {name: axis.limits() for name, axis in self.bench.axes.items()}
        if problems := dry_run_of(self.track, self.bench.chamber_limits(), axes).problems:
            raise LimitExceeded("The run was not started. " + " ".join(problems))

        def start(failed: str, work: Callable[[], None]) -> None:
            """Work in a thread of its own; a sentence that begins with `failed` ends the run where it cannot go on."""
            helpers.append(in_thread(work, self.clock, lambda problem: self.abort(f"{failed}: {problem}")))

        if (chamber := self._chamber) is not None:
            chamber.begin()
            start("The chamber is not monitored", partial(chamber.watch, self.chamber_every_s, self._watching))
        self.begun = True
        self.on_begin()
        # The units' data begin after the search for references.
        self._axes.home(self.track.moved, self._duties)
        for name, unit in self._units.items():
            unit.stream.start()
            unit.listen(self.track.gyros)
            start(name, partial(self._carry_bytes, unit))

    def _tell_settings(self, unit: UnitControl) -> None:
        self._event("configuration", device=unit.name, **event_fields(unit.settings))

    def _carry_bytes(self, unit: UnitControl) -> None:
        while self._working.is_set():
            unit.carry_bytes(self.journal)

    # ---------------------------------------------------------------------------------------------------- the steps

    def _execute(self) -> None:
        steps = self.track.steps
        # A run that was killed after its last step only has to end.
        again = 0 < self.first_step < len(steps)
        if again:
            self._seam("the run was resumed; the step begins again")
        while (number := self._steps_done) < len(steps) or self._unconfirmed or self._interlocks.pending:
            try:
                if number == len(steps):
                    self._await_confirmation()
                    continue
                self._unconfirmed.append(self._run_step(steps[number], again))
                again = isinstance(steps[number], Ask)
                self._steps_done += 1
                self._confirm_steps()
            except StepNotDone as shortfall:
                self._take_back(shortfall)
                again = True

    def _seam(self, why: str) -> None:
        self._event("seam", step=self.track.steps[self._steps_done].name, why=why)

    def _take_back(self, shortfall: StepNotDone) -> None:
        """This step and those after it are to be executed again."""
        number = shortfall.number
        self._say_not_done(shortfall)
        self._shortfall = None
        self._unconfirmed = deque(executed for executed in self._unconfirmed if executed.number < number)
        self._tries[number] = self._tries.get(number, 0) + 1
        if self._tries[number] == _TRIES:
            name = self.track.steps[number].name
            what = f"In {_TRIES} attempts, step {name!r} was not executed as the recipe states."
            raise HardwareError(f"{what} The last attempt: {shortfall}.")
        self._axes.stop()
        self._steps_done = number
        if shortfall.unit:
            # Its samples count anew from here, as in a run that is resumed.
            self.on_new_session(number)
            for unit in self._units.values():
                self._tell_settings(unit)
            self._units[shortfall.unit].listen(self.track.gyros)
        self._seam("the step is repeated: it was not executed as the recipe states")

    def _run_step(self, step: TrackStep, again: bool) -> ExecutedStep:
        number, axes = self._steps_done, self._axes
        self._event("step", step=step.name, number=number)
        anew = again or number == self.first_step or step.stable is not None
        if anew:
            self._place(step, again)
        begin = self.clock.now() if anew else self._step_ends_s
        if isinstance(step, Ask):
            self._ask(step)
        axes.late_s = 0.0 if anew else axes.late_s
        self._step_ends_s = begin + step.duration_s
        self._event("step begins", step=step.name, number=number, begins_s=begin, data=step.data)
        end = self._move(step, begin, anew)
        after = self.track.steps[number + 1 :][:1]
        if not after or after[0].stable is not None or isinstance(after[0], Ask):
            axes.end_spins(step.name, step.duration_s)
        axes.settle_all(self._duties)
        self._require_executed()
        axes.late_s = end - self._step_ends_s
        self._event("step ends", at_once=False, step=step.name, number=number)
        return ExecutedStep(number, begin, self.clock.now(), step.turned_deg)

    def _move(self, step: TrackStep, begin: float, anew: bool) -> float:
        """Everything in a step's own time; returns its end."""
        axes, planned = self._axes, bool(step.read_at_s)
        courses = deque(self.track.courses_from(self._steps_done) if anew else step.courses)
        moves = deque(step.moves)
        reads = deque(step.read_at_s)
        if not planned:
            reads.extend(k * step.read_every_s for k in range(math.ceil(step.duration_s / step.read_every_s)))
        while True:
            now, motion = self.clock.now(), begin + axes.late_s
            end = max(self._step_ends_s, motion + step.duration_s - step.slack_s)
            while reads and motion + reads[-1] > end + 1e-6:
                reads.pop()
            if reads and motion + reads[0] <= now and not axes.turned_by_hand:
                self._read(reads, motion, planned)
            while courses and begin + courses[0].start_s <= self.clock.now():
                course = courses.popleft()
                due_s = begin + course.start_s
                self._note_late("the temperature profile was sent to the chamber {:.1f} s late", due_s)
                if self._chamber is not None:
                    self._chamber.tell(course, due_s)
            while moves and motion + moves[0].start_s <= self.clock.now() and not axes.turned_by_hand:
                axes.move(step.name, moves[0], motion + moves[0].start_s, self._duties)
                moves.popleft()
            axes.look()
            self._require_executed()
            self._duties(end)
            if self.clock.now() >= end and not (moves or reads or axes.turned_by_hand):
                return end
            dues = [self.clock.now() + _SLICE_S, axes.look_s]
            dues += [end] if end > now else []
            dues += [begin + courses[0].start_s] if courses else []
            if not axes.turned_by_hand:
                dues += [motion + reads[0]] if reads else []
                dues += [motion + moves[0].start_s] if moves else []
            self.clock.sleep_until(min(dues))

    def _read(self, reads: deque[float], motion: float, planned: bool) -> None:
        """Take the readings that are due, as one. While an axis is turned by hand nothing is read: of what fell due
        meanwhile the last counts."""
        now = self.clock.now()
        due_s = motion + reads[0]
        while reads and motion + reads[0] <= now:
            due_s = motion + reads[0] if self._axes.by_hand else due_s
            reads.popleft()
        if planned:
            self._note_late("a reading was {:.1f} s late", due_s)
        self._axes.read(planned=planned)

    def _note_late(self, what: str, due_s: float) -> None:
        if (late_s := self.clock.now() - due_s) > self.limits.latest_s:
            self._axes.amiss.append(what.format(late_s))

    def _place(self, step: TrackStep, again: bool) -> None:
        """Bring axes and chamber to the step's start, and wait for its condition."""
        self._axes.go_to_start(step.name, step.start_deg, self._duties)
        stable = step.stable or (self.track.again if again else None)
        if step.start_c is not None and stable is not None:
            self._stabilise(step, step.start_c, stable)

    def _ask(self, step: Ask) -> None:
        """Ask the operator to hang the units, and wait without a time-out."""
        console = self.bench.console
        if step.mounting == self.mounting:
            return
        if console is None:
            raise HardwareError(
                f"The mounting of the IMUs must be changed ({step.hang}), and there is no operator to ask."
            )
        self._axes.go_to_start(step.name, dict.fromkeys(self.track.moved, 0.0), self._duties)
        if self.track.again is not None:
            self._stabilise(step, _FOR_HANDS_C, self.track.again)
        console.ask(f"mount the IMUs as follows: {step.hang}; press Enter when they are mounted:")
        try:
            while console.answer() is None:
                self._duties()
                self.clock.sleep(_SLICE_S)
        finally:
            console.withdraw("cancelled: leave the IMUs as they are mounted.")
        self.mounting = step.mounting
        self._event("hung", step=step.name, mounting=step.mounting, how=step.hang)

    def _stabilise(self, step: TrackStep, at_c: float, ready: Stable) -> None:
        if (chamber := self._chamber) is None:
            return
        chamber.approach(at_c)
        beside(partial(chamber.hold, at_c), self.clock, self._duties)
        began = self.clock.now()
        while (value := chamber.stable_at(at_c, ready)) is None:
            self._duties()
            if self.clock.now() - began > ready.timeout_s:
                raise HardwareError(
                    f"Step {step.name!r}: the temperature was not stable within {ready.band_k:g} K of {at_c:g} "
                    f"degC after {ready.timeout_s:g} s. Check the chamber, or allow more time."
                )
            self.clock.sleep(_SLICE_S)
        chamber.expected.stands(self.clock.now(), at_c)
        self._event("stable", step=step.name, temperature_c=value, waited_s=self.clock.now() - began)

    # ----------------------------------------------------------------------------------------- each step done or said

    @property
    def _losses(self) -> dict[str, SampleLosses]:
        """Of the units whose samples are awaited."""
        return {name: unit.losses for name, unit in self._units.items() if unit.losses is not None}

    def _require_executed(self) -> None:
        """Interrupt the step where axes or readings deviate from the track: it is to be repeated."""
        if self._shortfall is not None:
            raise self._shortfall
        if self._axes.amiss:
            raise StepNotDone(self._steps_done, "; ".join(dict.fromkeys(self._axes.amiss)))

    def _confirm_steps(self) -> None:
        """Judge the steps whose samples are in the journal: a step that a resumed run does not repeat is complete.
        The first bytes after its end may be a piece of a burst whose other pieces hold the step's last samples."""
        while self._unconfirmed and self._shortfall is None and self._has_samples_of(self._unconfirmed[0]):
            self._heard_end_s = min(self._heard_end_s, self.clock.now())
            if self.clock.now() < self._heard_end_s + _PIECES_S:
                return
            self._heard_end_s = math.inf
            self._shortfall = self._shortfall_of(self._unconfirmed[0])
            if self._shortfall is None:
                self._confirm(self._unconfirmed.popleft())

    def _has_samples_of(self, executed: ExecutedStep) -> bool:
        latest_s = min((losses.newest.time_s for losses in self._losses.values()), default=math.inf)
        return executed.ended_s + _ARRIVAL_S <= latest_s

    def _shortfall_of(self, executed: ExecutedStep) -> StepNotDone | None:
        for name, losses in self._losses.items() if self.track.steps[executed.number].data else ():
            if lost := losses.between(executed, self.limits):
                return StepNotDone(executed.number, f"{name}: {lost}", name)
        return None

    def _confirm(self, executed: ExecutedStep) -> None:
        self._event("step done", step=self.track.steps[executed.number].name, number=executed.number)

    def _await_confirmation(self) -> None:
        """Wait for the samples of the last steps, and until no rule is violated: one that is violated in the last
        seconds clears or trips before the run is done."""
        until = self.clock.now() + _LONGEST_ARRIVAL_S
        while self._unconfirmed or self._interlocks.pending:
            self._require_executed()
            self._duties()
            if self.clock.now() > until:
                raise HardwareError(f"The last samples did not come within {_LONGEST_ARRIVAL_S:g} s: check the IMUs.")
            self.clock.sleep(_SLICE_S)

    def _judge_the_rest(self) -> None:
        """At the end of a run that did not finish: each executed step is done, or said to be not done."""
        for executed in self._unconfirmed:
            shortfall = self._shortfall_of(executed)
            if shortfall is None and not self._has_samples_of(executed):
                shortfall = StepNotDone(executed.number, "the run ended before all of its samples had come")
            if shortfall is None:
                self._confirm(executed)
            else:
                self._say_not_done(shortfall)
        self._unconfirmed.clear()

    def _say_not_done(self, shortfall: StepNotDone) -> None:
        name = self.track.steps[shortfall.number].name
        self._event("not done", step=name, number=shortfall.number, why=str(shortfall))

    # ------------------------------------------------------------------------------------------- duties in every state

    def _duties(self, end_s: float | None = None) -> None:
        self.ticked_s = time.monotonic()
        self._confirm_steps()
        self._show(end_s)
        self._watch()

    def _watch(self) -> None:
        """Interlocks and problems of other threads end the run."""
        if problem := self._problem or self.journal.problem:
            raise HardwareError(problem)
        self._axes.watch()
        now, limits, violated = self.clock.now(), self.limits, self._axes.violated()
        if self._chamber is not None:
            violated |= self._chamber.violated(limits)
        ages_s = {name: now - losses.newest.time_s for name, losses in self._losses.items()}
        if old := [f"{name} for {age_s:.1f} s" for name, age_s in ages_s.items() if age_s > limits.imu_stale_s]:
            violated["stale unit"] = f"no sample from {', '.join(old)}"
        if (free := self.journal.free_bytes) < limits.free_bytes:
            violated["disk space"] = f"only {free / 1e6:.0f} MB are free on the disk"
        if tripped := self._interlocks.check(now, violated):
            rule, text = tripped
            self._event("interlock", at_once=False, rule=rule, text=text)
            raise HardwareError(f"Interlock '{rule}': {text}.")

    def _late_replies(self) -> tuple[str, ...]:
        """A sentence for each line on which replies come after their time-out; an event for each device at first."""
        late = {name: line.late for name, line in self.bench.lines.items() if line.late}
        for name in late.keys() - self._late:
            self._event("late reply", at_once=False, device=name, what=late[name])
        self._late |= late.keys()
        return tuple(dict.fromkeys(late.values()))

    def _show(self, end_s: float | None) -> None:
        now, late = self.clock.now(), self._late_replies()
        if self.on_progress is None or now - self._shown_s < self.chamber_every_s:
            return
        self._shown_s = now
        steps, done, chamber = self.track.steps, self._steps_done, self._chamber
        left = None if end_s is None else max(0.0, end_s - now)
        ahead_s = sum(step.duration_s for step in steps[done + (left is not None) :])
        progress = RunProgress(
            state=self.state,
            step=steps[min(done, len(steps) - 1)].name,
            steps_done=done,
            steps=len(steps),
            step_left_s=left,
            track_left_s=ahead_s + (left or 0.0),
            chamber=None if chamber is None else chamber.newest,
            axes=self._axes.newest,
            course_c=chamber and chamber.expected.of_late(now, self.limits.temperature_lag_s),
            samples={name: (losses.newest.received, losses.newest.missing) for name, losses in self._losses.items()},
            remarks=late,
        )
        self.on_progress(progress)

    # ------------------------------------------------------------------------------------------------------- the end

    def _end(self, status: str, reason: str) -> tuple[SafeOutcome, ...]:
        """Make safe. What happens is noted for the journal, and nothing waits for the disk before all is safe."""
        # A chamber that is being made safe gets no other commands.
        self._watching.clear()
        self._enter(RunState.ABORTING if status == "aborted" else RunState.STOPPING, at_once=False)
        self._event("ending", at_once=False, exit_status=status, reason=reason)
        outcomes = tuple(make_safe(self.bench, self.clock, deadline_s=self.safe_deadline_s, busy=self._is_busy))
        for outcome in outcomes:
            fields = event_fields(outcome)
            self._event("made safe", fields.pop("at_s"), **fields)
        self._judge_the_rest()
        good = all(outcome.verified for outcome in outcomes)
        self._enter(RunState.SAFE if good else RunState.FAILED)
        return outcomes

    def _is_busy(self, name: str) -> bool:
        if self._chamber is not None and name == "chamber":
            return not self._chamber.end(0.5 * self.safe_deadline_s)
        return self._axes.is_homing(name)

    def _enter(self, state: RunState, *, at_once: bool = True) -> None:
        self.state = state
        self._shown_s = -math.inf
        self._event("state", at_once=at_once, state=state.value)

    def _event(self, name: str, at_s: float | None = None, /, *, at_once: bool = True, **data: Any) -> None:
        self.ticked_s = time.monotonic()
        self.journal.event(self.clock.now() if at_s is None else at_s, name, at_once=at_once, **data)
