"""Executes a track on a bench: one clock, everything journalled, safe at every kind of end.

Each change of state is an event of the journal. A run never waits for a person to resume it: an interlock, an operator
or a failure ends it, within a quarter of a second of the run's clock or when the device that has the current command
has answered, and it can be resumed. Interlocks hold in every state, also while an axis searches its reference or the
chamber acknowledges. A step that was interrupted, or that lacks something of what the recipe states, is repeated from
its beginning: the chamber goes to the step's first temperature and is stable there, the axes go to their angles, and
the journal marks the seam.

Beside the executing thread, one thread at a time commands or reads the chamber, and one for each unit writes its bytes
to the disk: no slow device delays a move.
A runner with `first_step` resumes after a crash (see `run_folder`); `guard` makes a rig safe when
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
from gradcal_jax.hardware.clock import Clock, in_thread, until
from gradcal_jax.hardware.dry_run import dry_run_of
from gradcal_jax.hardware.errors import HardwareError, LimitExceeded, StepNotDone, sentence_of
from gradcal_jax.hardware.guard import make_safe, put_back
from gradcal_jax.hardware.interlocks import PATIENCE_S, InterlockLimits
from gradcal_jax.hardware.journal import Journal, event_fields
from gradcal_jax.hardware.roles import ImuSettings, ImuStream
from gradcal_jax.hardware.setup import Bench, report_of
from gradcal_jax.hardware.supervision import RunProgress, RunResult, RunState, SafeOutcome
from gradcal_jax.hardware.track import Ask, AxisCommand, Course, Stable, Track, TrackStep
from gradcal_jax.hardware.unit_control import ExecutedStep, SampleLosses

_HELPERS_END_S = 5.0
_SLICE_S = 0.25
_READS_S = 0.2
_LONGEST_ARRIVAL_S = 60.0
_TRIES = 3
# The chamber's temperature while the operator reaches into it.
_FOR_HANDS_C = 23.0


@dataclass
class Runner:
    """One run. `run` returns only after everything was made safe, and raises no errors of devices."""

    track: Track
    bench: Bench
    journal: Journal
    clock: Clock
    limits: InterlockLimits = field(default_factory=InterlockLimits)
    on_progress: Callable[[RunProgress], None] | None = None
    chamber_every_s: float = 5.0
    safe_deadline_s: float = 60.0
    first_step: int = 0
    mounting: int = 0
    """The mounting of the IMUs when the run begins, as `Ask.mounting`; 0: unknown."""
    on_begin: Callable[[], None] = lambda: None
    """Called once, before the first command that can make anything unsafe."""

    def __post_init__(self) -> None:
        self.state = RunState.IDLE
        self.begun = False
        """Whether anything was commanded."""
        self.ticked_s = time.monotonic()
        """Real time of the last sign of life of the run's own thread."""
        self._violated_since_s: dict[str, float] = {}
        """Since when each rule that is violated is so."""
        self._problem = ""
        self._working = threading.Event()
        chamber, latest_s = self.bench.chamber, self.limits.latest_s
        self._chamber = None if chamber is None else ChamberControl(chamber, self.clock, self._event, self.abort)
        track_kept = not self.bench.imus
        self._axes = AxisControl(self.bench.axes, self.clock, self._event, latest_s, keep_track=track_kept)
        self._units: dict[str, SampleLosses] = {}
        """Of the units whose samples are awaited: they send none while the axes search for their references."""
        self._unconfirmed: deque[ExecutedStep] = deque()
        self._tries: dict[int, int] = {}
        self._shown_s = -math.inf
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
            until(lambda: all(helper.is_set() for helper in helpers), self.clock, longest_s=_HELPERS_END_S)
            # At the end: no other thread reads the lines of the units any more.
            for name, problem in put_back(self.bench).items():
                self._event("settings put back", device=name, problem=problem)
            result = RunResult(status, reason, outcomes, self._steps_done, self.begun)
            self._event("end", exit_status=status, reason=reason, verified_safe=result.verified_safe)
        return result

    # ------------------------------------------------------------------------------------------------ the beginning

    def _prepare(self, helpers: list[threading.Event]) -> None:
        limits: dict[str, Any] = {}
        for name, entry, device in self.bench.devices():
            report = report_of(self.bench, name, entry, device)
            if report.problem:
                raise HardwareError(report.problem)
            if report.identity is not None:
                self._event("identity", **event_fields(report.identity), device=name)
            limits[name] = report.limits
            if isinstance(report.limits, ImuSettings):
                self._event("configuration", device=name, **event_fields(report.limits))
        if problems := dry_run_of(self.track, limits).problems:
            raise LimitExceeded("The run was not started. " + " ".join(problems))
        if self._chamber is not None:
            self._chamber.begin()
        self.begun = True
        self.on_begin()
        # The units' data begin after the search for references.
        self._axes.home(self.track.moved, self._duties)
        for name, stream in self.bench.imus.items():
            stream.start()
            losses = SampleLosses(stream.decoder(), limits[name].sample_rate_hz, self.track.gyros, self.clock.now())
            self._units[name] = losses
            helpers.append(in_thread(partial(self._carry_bytes, name, stream, losses), self.clock, str))

    def _carry_bytes(self, name: str, stream: ImuStream, losses: SampleLosses) -> None:
        """Write a unit's raw bytes to the journal first, then count its samples; in a thread of its own."""
        try:
            while self._working.is_set():
                data, time_s = stream.read_bytes(_READS_S)
                if data:
                    self.journal.bytes_of(name, time_s, data, received=True)
                    losses.push(data, time_s)
        except Exception as problem:
            self.abort(f"{name}: {problem}")

    # ---------------------------------------------------------------------------------------------------- the steps

    def _execute(self) -> None:
        steps = self.track.steps
        # A run that was killed after its last step only has to end.
        again = 0 < self.first_step < len(steps)
        if again:
            self._seam("the run was resumed; the step begins again")
        while True:
            try:
                while self._steps_done < len(steps):
                    step = steps[self._steps_done]
                    self._unconfirmed.append(self._run_step(step, again))
                    again = isinstance(step, Ask)
                    self._steps_done += 1
                self._await_confirmation()
                return
            except StepNotDone as shortfall:
                self._take_back(shortfall)
                again = True

    def _seam(self, why: str) -> None:
        self._event_of(self._steps_done, "seam", why=why)

    def _take_back(self, shortfall: StepNotDone) -> None:
        """This step and those after it are to be executed again."""
        number = self._steps_done if shortfall.number is None else shortfall.number
        self._event_of(number, "not done", why=str(shortfall))
        self._unconfirmed = deque(executed for executed in self._unconfirmed if executed.number < number)
        self._tries[number] = self._tries.get(number, 0) + 1
        if self._tries[number] == _TRIES:
            name = self.track.steps[number].name
            what = f"In {_TRIES} attempts, step {name!r} was not executed as the recipe states."
            raise HardwareError(f"{what} The last attempt: {shortfall}.")
        self._axes.stop()
        self._steps_done = number
        if shortfall.unit:
            self._units[shortfall.unit].begin(self.clock.now())
        self._seam("the step is repeated: it was not executed as the recipe states")

    def _run_step(self, step: TrackStep, again: bool) -> ExecutedStep:
        number, axes = self._steps_done, self._axes
        self._event_of(number, "step")
        anew = again or number == self.first_step or step.stable is not None
        if anew:
            # Axes and chamber go to the step's start.
            axes.go_to_start(step.name, step.start_deg, self._duties)
            stable = step.stable or (self.track.again if again else None)
            if step.start_c is not None and stable is not None:
                self._stabilise(step, step.start_c, stable)
        begin = self.clock.now() if anew else self._step_ends_s
        if isinstance(step, Ask) and step.mounting != self.mounting:
            self._ask(step)
        axes.late_s = 0.0 if anew else axes.late_s
        self._step_ends_s = begin + step.duration_s
        self._event_of(number, "step begins", begins_s=begin, data=step.data)
        end = self._move(step, begin, anew)
        after = self.track.steps[number + 1 :][:1]
        if not after or after[0].stable is not None or isinstance(after[0], Ask):
            axes.end_spins(step.name, step.duration_s)
        axes.settle_all(self._duties)
        axes.late_s = end - self._step_ends_s
        self._event_of(number, "step ends", at_once=False)
        return ExecutedStep(number, begin, self.clock.now(), step.turned_deg)

    def _move(self, step: TrackStep, begin: float, anew: bool) -> float:
        """Everything in a step's own time; returns its end.

        While an axis is turned by hand nothing is read and nothing moves: of the readings that fell due meanwhile the
        last counts.
        """
        axes, planned = self._axes, bool(step.read_at_s)
        courses = deque(self.track.courses_from(self._steps_done) if anew else step.courses)
        reads_s = step.read_at_s
        if not planned:
            reads_s = [k * step.read_every_s for k in range(math.ceil(step.duration_s / step.read_every_s))]
        agenda: list[tuple[float, AxisCommand | None]] = [(time_s, None) for time_s in reads_s]
        agenda += [(move.start_s, move) for move in step.moves]
        # A reading at the time of a move comes first.
        agenda.sort(key=lambda entry: entry[0])
        motion, end, late_s = begin, self._step_ends_s, math.nan
        while True:
            if axes.late_s != late_s:
                late_s = axes.late_s
                motion = begin + late_s
                end = max(self._step_ends_s, motion + step.duration_s - step.slack_s)
                agenda = [entry for entry in agenda if entry[1] or motion + entry[0] <= end + 1e-6]
            while agenda and motion + agenda[0][0] <= self.clock.now() and not axes.turned_by_hand:
                start_s, move = agenda.pop(0)
                if move is not None:
                    axes.move(step.name, move, motion + start_s, self._duties)
                    continue
                skipped = bool(agenda) and agenda[0][1] is None and motion + agenda[0][0] <= self.clock.now()
                if planned and not (skipped and axes.by_hand):
                    self._require_on_time("a reading was {:.1f} s late", motion + start_s)
                if not skipped:
                    axes.read(planned=planned)
            while courses and begin + courses[0].start_s <= self.clock.now():
                course = courses.popleft()
                due_s = begin + course.start_s
                self._require_on_time("the temperature profile was sent to the chamber {:.1f} s late", due_s)
                if self._chamber is not None:
                    self._chamber.tell(course, due_s)
            look_s = axes.look()
            self._duties(end)
            now, waits = self.clock.now(), axes.turned_by_hand
            if now >= end and not (agenda or waits):
                return end
            dues = [now + _SLICE_S, look_s, end if end > now else math.inf]
            dues += [begin + courses[0].start_s] if courses else []
            dues += [motion + agenda[0][0]] if agenda and not waits else []
            self.clock.sleep_until(min(dues))

    def _require_on_time(self, what: str, due_s: float) -> None:
        if (late_s := self.clock.now() - due_s) > self.limits.latest_s:
            raise StepNotDone(what.format(late_s))

    def _ask(self, step: Ask) -> None:
        """Ask the operator to hang the units, and wait without a time-out."""
        console = self.bench.console
        if console is None:
            raise HardwareError(
                f"The mounting of the IMUs must be changed ({step.hang}), and there is no operator to ask."
            )
        self._axes.go_to_start(step.name, dict.fromkeys(self.track.moved, 0.0), self._duties)
        if self.track.again is not None:
            self._stabilise(step, _FOR_HANDS_C, self.track.again)
        console.ask(f"mount the IMUs as follows: {step.hang}; press Enter when they are mounted:")
        try:
            until(lambda: console.answer() is not None, self.clock, self._duties, every_s=_SLICE_S)
        finally:
            console.withdraw("cancelled: leave the IMUs as they are mounted.")
        self.mounting = step.mounting
        self._event("hung", step=step.name, mounting=step.mounting, how=step.hang)

    def _stabilise(self, step: TrackStep, at_c: float, ready: Stable) -> None:
        if (chamber := self._chamber) is None:
            return
        began = self.clock.now()
        chamber.tell(Course(0.0, at_c), began)
        is_so = partial(chamber.is_stable_at, at_c, ready)
        if not until(is_so, self.clock, self._duties, longest_s=ready.timeout_s, every_s=_SLICE_S):
            raise HardwareError(
                f"Step {step.name!r}: the temperature was not stable within {ready.band_k:g} K of {at_c:g} "
                f"degC after {ready.timeout_s:g} s. Check the chamber, or allow more time."
            )
        chamber.expected.stands(self.clock.now(), at_c)
        self._event("stable", step=step.name, temperature_c=chamber.newest_c, waited_s=self.clock.now() - began)

    # ----------------------------------------------------------------------------------------- each step done or said

    def _confirm_steps(self, *, ended: bool = False) -> None:
        """Judge the steps whose samples are in the journal: a step that a resumed run does not repeat is complete. At
        the end of a run that did not finish each executed step is done, or said to be not done."""
        while self._unconfirmed:
            executed, now = self._unconfirmed[0], self.clock.now()
            complete = all(losses.complete(executed.ended_s, now) for losses in self._units.values())
            if not (complete or ended):
                return
            why = "" if complete else "the run ended before all of its samples had come"
            for name, losses in self._units.items() if self.track.steps[executed.number].data else ():
                if lost := losses.between(executed, self.limits):
                    why = f"{name}: {lost}"
                    if not ended:
                        raise StepNotDone(why, executed.number, name)
            self._unconfirmed.popleft()
            self._event_of(executed.number, "not done" if why else "step done", **({"why": why} if why else {}))

    def _await_confirmation(self) -> None:
        """Wait for the samples of the last steps, and until no rule is violated: one that is violated in the last
        seconds clears or trips before the run is done."""
        is_so = lambda: not (self._unconfirmed or self._violated_since_s)  # noqa: E731
        if not until(is_so, self.clock, self._duties, longest_s=_LONGEST_ARRIVAL_S, every_s=_SLICE_S):
            raise HardwareError(f"The last samples did not come within {_LONGEST_ARRIVAL_S:g} s: check the IMUs.")

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
            self._chamber.attend(self.chamber_every_s)
            violated |= self._chamber.violated(limits)
        ages_s = {name: now - losses.newest.time_s for name, losses in self._units.items()}
        if old := [f"{name} for {age_s:.1f} s" for name, age_s in ages_s.items() if age_s > limits.imu_stale_s]:
            violated["stale unit"] = f"no sample from {', '.join(old)}"
        if (free := self.journal.free_bytes) < limits.free_bytes:
            violated["disk space"] = f"only {free / 1e6:.0f} MB are free on the disk"
        for rule, text in violated.items():
            if not text:
                self._violated_since_s.pop(rule, None)
            elif now - self._violated_since_s.setdefault(rule, now) >= PATIENCE_S.get(rule, 0.0):
                self._event("interlock", at_once=False, rule=rule, text=text)
                raise HardwareError(f"Interlock '{rule}': {text}.")

    def _show(self, end_s: float | None) -> None:
        now = self.clock.now()
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
            axes={name: axis.newest for name, axis in self._axes.axes.items() if axis.newest is not None},
            course_c=chamber and chamber.expected.of_late(now, self.limits.temperature_lag_s),
            samples={name: (losses.newest.received, losses.newest.missing) for name, losses in self._units.items()},
            remarks=tuple(dict.fromkeys(line.late for line in self.bench.lines.values() if line.late)),
        )
        self.on_progress(progress)

    # ------------------------------------------------------------------------------------------------------- the end

    def _end(self, status: str, reason: str) -> tuple[SafeOutcome, ...]:
        """Make safe. What happens is noted for the journal, and nothing waits for the disk before all is safe."""
        began_s = self.clock.now()
        self._enter(RunState.ABORTING if status == "aborted" else RunState.STOPPING, at_once=False)
        self._event("ending", at_once=False, exit_status=status, reason=reason)
        outcomes = tuple(make_safe(self.bench, self.clock, deadline_s=self.safe_deadline_s, busy=self._is_busy))
        for outcome in outcomes:
            self._event("made safe", began_s + outcome.took_s, **event_fields(outcome))
        self._confirm_steps(ended=True)
        good = all(outcome.verified for outcome in outcomes)
        self._enter(RunState.SAFE if good else RunState.FAILED)
        return outcomes

    def _is_busy(self, name: str) -> bool:
        # A chamber that is being made safe gets no other commands: only the duties begin them.
        if self._chamber is not None and name == "chamber":
            return not self._chamber.end(0.5 * self.safe_deadline_s)
        return self._axes.is_homing(name)

    def _enter(self, state: RunState, *, at_once: bool = True) -> None:
        self.state = state
        self._shown_s = -math.inf
        self._event("state", at_once=at_once, state=state)

    def _event(self, name: str, at_s: float | None = None, /, *, at_once: bool = True, **data: Any) -> None:
        self.ticked_s = time.monotonic()
        self.journal.event(self.clock.now() if at_s is None else at_s, name, at_once=at_once, **data)

    def _event_of(self, number: int, name: str, **data: Any) -> None:
        """An event of a step."""
        self._event(name, step=self.track.steps[number].name, number=number, **data)
