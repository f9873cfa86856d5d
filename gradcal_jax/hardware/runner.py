"""Executes a track on a bench: one clock, everything journalled, safe at every kind of end.

Each change of state is an event of the journal. Requests (pause, stop, abort) may come from any thread or signal
handler and take effect within a quarter of a second of the run's clock, or when the device that has the current command
has answered. Nothing turns while a run is paused; interlocks hold in every state, also while an axis searches its
reference or the chamber acknowledges. A step that was interrupted, by a pause or by the end of the process, is repeated
from its beginning: the chamber goes to the step's first temperature and is stable there, the axes go to their angles,
and the journal marks the interruption.

Beside the executing thread, one thread reads the chamber, and one for each unit writes its bytes to the disk: no slow
device delays a move. A runner with `first_step` resumes after a crash (see `run_folder`); `guard` makes a rig safe when
this process is killed.
"""

import math
import threading
import time
from collections import deque
from collections.abc import Callable
from contextlib import suppress
from dataclasses import dataclass, field
from functools import partial
from typing import Any, Literal

from gradcal_jax.hardware.axis_control import AxisControl
from gradcal_jax.hardware.chamber_control import ChamberControl
from gradcal_jax.hardware.clock import Clock, beside, in_thread
from gradcal_jax.hardware.dry_run import dry_run_of
from gradcal_jax.hardware.errors import HardwareError, LimitExceeded, sentence_of
from gradcal_jax.hardware.guard import make_safe, put_back
from gradcal_jax.hardware.interlocks import ExecutedStep, Interlocks, SampleLosses, Situation, StepNotDone
from gradcal_jax.hardware.journal import Journal, event_fields
from gradcal_jax.hardware.roles import ImuSettings
from gradcal_jax.hardware.setup import Bench, require_identity
from gradcal_jax.hardware.supervision import RunProgress, RunResult, RunState, SafeOutcome
from gradcal_jax.hardware.track import Ask, Course, Stable, Track, TrackStep
from gradcal_jax.spec.rig import ImuDevice

Request = Literal["soft pause", "pause", "resume", "stop", "abort"]
_HELPERS_END_S, _HELPERS_LOOK_S = 5.0, 0.02
_SLICE_S = 0.25
_ARRIVAL_S, _PIECES_S, _LONGEST_ARRIVAL_S = 0.1, 0.2, 60.0
_TRIES = 3
_ALARM_AGAIN_S = 300.0
# The chamber's temperature while the operator reaches into it.
_FOR_HANDS_C = 23.0


class _Interrupted(Exception):
    """A pause within a step."""


class _Ended(Exception):
    """Stop or abort."""

    def __init__(self, status: Literal["stopped", "aborted"], reason: str) -> None:
        Exception.__init__(self, reason)
        self.status: Literal["stopped", "aborted"] = status


@dataclass
class Runner:
    """One run. `run` returns only after everything was made safe, and raises no errors of devices."""

    track: Track
    bench: Bench
    journal: Journal
    clock: Clock
    interlocks: Interlocks = field(default_factory=Interlocks)
    on_progress: Callable[[RunProgress], None] | None = None
    on_alarm: Callable[[str], None] = lambda sentence: None
    chamber_every_s: float = 5.0
    safe_deadline_s: float = 60.0
    wait_when_paused: bool = True
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
        self._requests: deque[tuple[Request, str]] = deque()
        self._pause_first = False
        # Why the run is paused, by a rule or by a request, and since when.
        self._why, self._by_rule = "", False
        self._paused_s: float | None = None
        self._problem = ""
        self._working, self._watching = threading.Event(), threading.Event()
        self._range_c = (-math.inf, math.inf)
        chamber, latest_s = self.bench.chamber, self.interlocks.limits.latest_s
        self._chamber = None if chamber is None else ChamberControl(chamber, self.clock, self._event)
        self._axes = AxisControl(self.bench.axes, self.clock, self._event, latest_s, not self.bench.imus)
        self._losses: dict[str, SampleLosses] = {}
        # Units whose samples are awaited; they send none while the axes search for their references.
        self._streaming: set[str] = set()
        self._settings: dict[str, ImuSettings] = {}
        self._unconfirmed: deque[ExecutedStep] = deque()
        self._confirmed: set[int] = set()
        self._tries: dict[int, int] = {}
        self._shortfall: StepNotDone | None = None
        self._heard_end_s = math.inf
        self._shown_s = -math.inf
        self._late: set[str] = set()
        self._steps_done = self.first_step
        self._step_ends_s = 0.0

    def request(self, what: Request, reason: str = "asked for") -> None:
        """Request a change of state; safe in a signal handler."""
        self._requests.append((what, reason))

    def run(self) -> RunResult:
        helpers: list[threading.Event] = []
        status: Literal["success", "stopped", "aborted"] = "success"
        reason = ""
        with self.clock.party():
            try:
                self._working.set()
                self._watching.set()
                self._prepare(helpers)
                self._obey_requests()
                self._enter(RunState.RUNNING)
                if self._pause_first:
                    self._enter(RunState.PAUSING)
                    self._wait_paused()
                self._execute()
            except _Ended as end:
                status, reason = end.status, str(end)
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
                self._settings[name] = self.bench.imus[name].configure()
                self._event("configuration", device=name, **event_fields(self._settings[name]))
        axes = {name: axis.limits() for name, axis in self.bench.axes.items()}
        if problems := dry_run_of(self.track, self.bench.chamber_limits(), axes).problems:
            raise LimitExceeded("The run was not started. " + " ".join(problems))

        def start(failed: str, work: Callable[[], None]) -> None:
            """Work in a thread of its own; a sentence that begins with `failed` ends the run where it cannot go on."""

            def fail(problem: Exception) -> None:
                self._fail(f"{failed}: {problem}")

            helpers.append(in_thread(work, self.clock, fail))

        if self._chamber is not None:
            reading, limits = self._chamber.chamber.read(), self._chamber.chamber.limits()
            self._range_c = min(limits.lowest_c, reading.air_c), max(limits.highest_c, reading.air_c)
            self._chamber.heard(reading)
            watch = partial(self._chamber.watch, self.chamber_every_s, self._watching, self._fail)
            start("The chamber is not monitored", watch)
        self.begun = True
        self.on_begin()
        # The units' data begin after the search for references.
        self._axes.home(self.track.moved, self._duties)
        for name, unit in self.bench.imus.items():
            unit.start()
            self._listen_to(name)
            start(name, partial(self._carry_bytes, name))

    def _fail(self, problem: str) -> None:
        self._problem = problem

    def _listen_to(self, name: str) -> None:
        """Count a unit's samples from here on."""
        decoder, rate_hz = self.bench.imus[name].decoder(), self._settings[name].sample_rate_hz
        self._losses[name] = SampleLosses(decoder, rate_hz, self.track.gyros, self.clock.now())
        self._streaming.add(name)

    def _carry_bytes(self, name: str) -> None:
        """Write raw bytes to the journal first, then count the missing samples."""
        while self._working.is_set():
            data, time_s = self.bench.imus[name].read_bytes(0.2)
            if data:
                self.journal.bytes_of(name, time_s, data, received=True)
                self._losses[name].push(data, time_s)

    # ---------------------------------------------------------------------------------------------------- the steps

    def _execute(self) -> None:
        steps = self.track.steps
        # A run that was killed after its last step only has to end.
        again = 0 < self.first_step < len(steps)
        if again:
            self._seam("the run was resumed; the step begins again")
        while (number := self._steps_done) < len(steps) or self._unconfirmed or self.interlocks.pending:
            try:
                if number == len(steps):
                    self._await_confirmation()
                    continue
                self._unconfirmed.append(self._run_step(steps[number], again))
                again = isinstance(steps[number], Ask)
                self._steps_done += 1
                self._confirm_steps()
                if self.state is RunState.PAUSING and self._steps_done < len(steps):
                    self._pause_between(steps[number])
                    if again := steps[self._steps_done].stable is None:
                        self._seam("the run was paused before this step")
            except _Interrupted:
                violated = self._why if self._by_rule else ""
                self._wait_paused()
                if number < len(steps):
                    self._seam("the step begins again after a pause")
                    again = True
                elif violated:
                    self._take_back(StepNotDone(number - 1, violated))
                    again = True
            except StepNotDone as shortfall:
                self._take_back(shortfall)
                again = True
        if left := set(range(self.first_step, len(steps))) - self._confirmed:
            names = ", ".join(repr(steps[number].name) for number in sorted(left))
            raise HardwareError(f"The run ended before these steps were confirmed: {names}.")

    def _seam(self, why: str) -> None:
        self._event("seam", step=self.track.steps[self._steps_done].name, why=why)

    def _take_back(self, shortfall: StepNotDone) -> None:
        """This step and those after it are to be executed again."""
        number = shortfall.number
        self._say_not_done(shortfall)
        self._shortfall = None
        self._unconfirmed = deque(executed for executed in self._unconfirmed if executed.number < number)
        self._confirmed = {done for done in self._confirmed if done < number}
        self._tries[number] = self._tries.get(number, 0) + 1
        if self._tries[number] == _TRIES:
            what = (
                f"In {_TRIES} attempts, step {self.track.steps[number].name!r} was not executed as the recipe states."
            )
            raise HardwareError(f"{what} The last attempt: {shortfall}.")
        self._axes.stop()
        self._steps_done = number
        if shortfall.unit:
            # Its samples count anew from here, as in a run that is resumed.
            self.on_new_session(number)
            for device, settings in self._settings.items():
                self._event("configuration", device=device, **event_fields(settings))
            self._listen_to(shortfall.unit)
        self._seam("the step is repeated: it was not executed as the recipe states")

    def _pause_between(self, step: TrackStep) -> None:
        """Stop every axis: nothing turns while a run is paused, not even a spin that the next step continues."""
        # Interrupted: every axis was stopped.
        with suppress(_Interrupted):
            self._axes.end_spins(step.name, step.duration_s)
            self._axes.settle_all(self._duties)
        if self.state is RunState.PAUSING:
            self._wait_paused()

    def _run_step(self, step: TrackStep, again: bool) -> ExecutedStep:
        number, axes = self._steps_done, self._axes
        self._event("step", step=step.name, number=number)
        anew = again or number == self.first_step or step.stable is not None
        if anew:
            self._place(step, again)
        begin = self.clock.now() if anew else self._step_ends_s
        if isinstance(step, Ask):
            self._ask(step)
        courses = self.track.courses_from(number) if anew else list(step.courses)
        axes.late_s = 0.0 if anew else axes.late_s
        self._step_ends_s = begin + step.duration_s
        self._event("step begins", step=step.name, number=number, begins_s=begin, data=step.data)
        end = self._move(step, begin, courses)
        after = self.track.steps[number + 1 :][:1]
        if not after or after[0].stable is not None or isinstance(after[0], Ask):
            axes.end_spins(step.name, step.duration_s)
        axes.settle_all(self._duties)
        self._require_executed()
        axes.late_s = end - self._step_ends_s
        self._event("step ends", at_once=False, step=step.name, number=number)
        return ExecutedStep(number, begin, self.clock.now())

    def _move(self, step: TrackStep, begin: float, courses: list[Course]) -> float:
        """Everything in a step's own time; returns its end."""
        axes, latest_s, planned = self._axes, self.interlocks.limits.latest_s, bool(step.read_at_s)
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
                late_s = now - motion - reads[0]
                while reads and motion + reads[0] <= now:
                    # While an axis is turned by hand nothing is read: of what fell due meanwhile the last counts.
                    late_s = now - motion - reads[0] if axes.by_hand else late_s
                    reads.popleft()
                if planned and late_s > latest_s:
                    axes.amiss.append(f"a reading was {late_s:.1f} s late")
                axes.read(planned=planned)
            while courses and begin + courses[0].start_s <= self.clock.now():
                course = courses.pop(0)
                if (late_s := self.clock.now() - begin - course.start_s) > latest_s:
                    axes.amiss.append(f"the temperature profile was sent to the chamber {late_s:.1f} s late")
                if self._chamber is not None:
                    self._chamber.tell(course, begin + course.start_s, self._fail)
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
            dues += [begin + course.start_s for course in courses[:1]]
            if not axes.turned_by_hand:
                dues += [motion + reads[0]] if reads else []
                dues += [motion + moves[0].start_s] if moves else []
            self.clock.sleep_until(min(dues))

    def _place(self, step: TrackStep, again: bool) -> None:
        """Bring axes and chamber to the step's start, and wait for its condition."""
        self._axes.go_to_start(step.name, step.start_deg, self._duties, watched=not again)
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
        step, limits = self.track.steps[executed.number], self.interlocks.limits
        for name, losses in self._losses.items() if step.data else ():
            if lost := losses.between(executed, limits.lost_share, limits.latest_s, step.turned_deg):
                return StepNotDone(executed.number, f"{name}: {lost}", name)
        return None

    def _confirm(self, executed: ExecutedStep) -> None:
        self._confirmed.add(executed.number)
        self._event("step done", step=self.track.steps[executed.number].name, number=executed.number)

    def _await_confirmation(self) -> None:
        """Wait for the samples of the last steps, and until no rule is violated: one that is violated in the last
        seconds clears or trips before the run is done. If it trips, the last step is executed again."""
        until = self.clock.now() + _LONGEST_ARRIVAL_S
        while self._unconfirmed or self.interlocks.pending:
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
        self._obey_requests()
        self._confirm_steps()
        self._show(end_s)
        self._watch()

    def _watch(self) -> None:
        """Interlocks pause or end the run; a run that is paused or has not begun can only be ended."""
        if problem := self._problem or self.journal.problem:
            raise HardwareError(problem)
        self._axes.watch()
        now, chamber, limits = self.clock.now(), self._chamber, self.interlocks.limits
        paused_s = None if self._paused_s is None else now - self._paused_s
        situation = Situation(
            time_s=now,
            chamber=None if chamber is None else chamber.newest,
            axes=self._axes.newest,
            imu_age_s={name: now - self._losses[name].newest.time_s for name in self._streaming},
            free_bytes=self.journal.free_bytes,
            course_c=None if chamber is None else chamber.expected.of_late(now, limits.temperature_lag_s),
            allowed_dps=self._axes.allowed(),
            range_c=self._range_c,
            conditions=chamber is not None and chamber.conditions,
            stalled=self._axes.stalled(),
            paused_s=paused_s,
            by_itself=self._by_rule,
        )
        tripped = self.interlocks.check(situation)
        if tripped is None or (paused_s is not None and tripped[0].action != "abort"):
            return
        rule, text = tripped
        sentence = f"Interlock '{rule.name}': {text}."
        self._event("interlock", at_once=False, rule=rule.name, action=rule.action, text=text)
        if rule.action == "abort" or not self.wait_when_paused or self.state is RunState.IDLE:
            raise _Ended("aborted", sentence)
        self.on_alarm(f"The run is paused. {sentence}")
        self._stop_and_pause(sentence, by_rule=True)

    def _stop_and_pause(self, why: str, *, by_rule: bool = False) -> None:
        self._why, self._by_rule = why, by_rule
        self.interlocks.forget()
        self._axes.stop()
        if self.state is RunState.RUNNING:
            self._enter(RunState.PAUSING)
        raise _Interrupted

    def _obey_requests(self) -> None:
        while self._requests:
            what, reason = self._requests.popleft()
            self._event("request", at_once=False, what=what, reason=reason)
            if what in ("stop", "abort"):
                raise _Ended("stopped" if what == "stop" else "aborted", reason)
            if self.state is RunState.IDLE:
                # Homing comes first.
                self._pause_first = what != "resume"
            elif what == "resume" and self.state in (RunState.PAUSING, RunState.PAUSED):
                self._why, self._by_rule = "", False
                self._enter(RunState.RUNNING)
            elif what == "soft pause" and self.state is RunState.RUNNING:
                self._why = reason
                self._enter(RunState.PAUSING)
            elif what == "pause" and self.state is not RunState.PAUSED:
                self._stop_and_pause(reason)

    def _wait_paused(self) -> None:
        self._enter(RunState.PAUSED)
        self._paused_s = self.clock.now()
        alarm_s = self._paused_s + _ALARM_AGAIN_S
        while True:
            self._show(None)
            self.ticked_s = time.monotonic()
            self._obey_requests()
            if self.state is not RunState.PAUSED:
                break
            self._confirm_steps()
            self._watch()
            if self._by_rule and self.clock.now() >= alarm_s:
                alarm_s += _ALARM_AGAIN_S
                self.on_alarm(f"The run is still paused. {self._why}")
            self.clock.sleep(_SLICE_S)
        self._paused_s = None
        self.interlocks.forget()
        if self._chamber is not None:
            self._chamber.may_start()

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
            course_c=chamber and chamber.expected.of_late(now, self.interlocks.limits.temperature_lag_s),
            samples={name: (losses.newest.received, losses.newest.missing) for name, losses in self._losses.items()},
            why=self._why,
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
