"""The track that the runner executes: steps of temperature, each with its moves. Plain data.

A run resumes at a step. A step sets the chamber's course and waits until its condition holds (or its time-out ends the
run); then its own time begins, on which its moves start and it ends.
"""

import math
from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Literal


@dataclass(frozen=True)
class Stable:
    """The temperature (the load's where the chamber measures it, else the air's) stays within `band_k` of its goal and
    changes by at most `band_k` peak to peak, for `for_s`; not later than `timeout_s` after the waiting began."""

    band_k: float
    for_s: float
    timeout_s: float


@dataclass(frozen=True)
class AxisCommand:
    """One command to one axis, `start_s` after the step's own time began.

    "go" moves to the absolute `position_deg`; "turn" moves by `angle_deg` from where the last "go" or "turn" was to
    end, so that errors do not add up; "spin" turns at the signed `rate_dps`; "stop" ends a spin. `answer_s`: what the
    plan gives an operator beside the turning.
    """

    start_s: float
    axis: str
    kind: Literal["go", "turn", "spin", "stop"]
    position_deg: float = 0.0
    rate_dps: float = 0.0
    acceleration_dps2: float = 0.0
    angle_deg: float = 0.0
    answer_s: float = 0.0

    @property
    def duration_s(self) -> float:
        """Duration of a turn, or of a spin's run-up; 0 for a go, which depends on the position before it."""
        if self.acceleration_dps2 <= 0.0:
            return 0.0
        ramp = abs(self.rate_dps) / self.acceleration_dps2
        if self.kind != "turn":
            return ramp
        peak = min(abs(self.rate_dps), math.sqrt(abs(self.angle_deg) * self.acceleration_dps2))
        return abs(self.angle_deg) / peak + peak / self.acceleration_dps2 if peak > 0.0 else 0.0


@dataclass(frozen=True)
class Course:
    """A command to the chamber, `start_s` into a step; `ramp_k_per_min` None: as fast as it can."""

    start_s: float
    temperature_c: float
    ramp_k_per_min: float | None = None


@dataclass(frozen=True)
class TrackStep:
    """`temperature_c` None leaves the chamber alone; `ramp_k_per_min` None goes there as fast as it can.

    With `ready` the step waits until the temperature is stable at `start_c` (None: at `temperature_c`); then its own
    time begins and the chamber gets its command. `courses` are further commands in the step's own time. A step that
    `follows` begins when the one before ends, and the chamber continues, unless there is a course; where it begins
    separately (after a pause, or when a run is resumed) the chamber first goes to `start_c` and is stable by `again`,
    and the axes go to `start_deg`.

    With `goes_there` the axes always go to `start_deg` first. Of several mountings `hang` is the step's, with number
    `mounting`, from 1: where the units hang otherwise the operator is asked to change it before, with the axes at zero
    and the chamber at a temperature safe for hands.

    The last `slack_s` of the step are waiting only: they make up for late turns by hand.

    The angles of all axes are read at `read_at_s`, and after every turn when the axis stands; where `read_at_s` is
    empty, every `read_every_s`.
    """

    name: str
    duration_s: float
    temperature_c: float | None = None
    ramp_k_per_min: float | None = None
    ready: Stable | None = None
    moves: tuple[AxisCommand, ...] = ()
    read_every_s: float = 1.0
    start_c: float | None = None
    courses: tuple[Course, ...] = ()
    follows: bool = False
    again: Stable | None = None
    start_deg: Mapping[str, float] = field(default_factory=dict[str, float])
    read_at_s: tuple[float, ...] = ()
    slack_s: float = 0.0
    goes_there: bool = False
    hang: str = ""
    mounting: int = 0
    used: bool = False

    @property
    def data(self) -> bool:
        """Whether its samples are data: also where no angle is read, as in a part of a long rest that is read at its
        end."""
        return self.used or bool(self.read_at_s)

    @property
    def begins_c(self) -> float | None:
        """The chamber's temperature at the beginning of the step, where it matters."""
        return self.start_c if self.start_c is not None else self.temperature_c

    @property
    def turned_deg(self) -> float | None:
        """How far the axes turn in the step, all turns added up; None where that depends on what was before."""
        if not self.moves or any(move.kind == "go" for move in self.moves):
            return None
        total = 0.0
        for number, move in enumerate(self.moves):
            later = [after.start_s for after in self.moves[number + 1 :] if after.axis == move.axis]
            lasts_s = min(later, default=self.duration_s) - move.start_s
            total += abs(move.angle_deg) if move.kind == "turn" else abs(move.rate_dps) * lasts_s
        return total


@dataclass(frozen=True)
class GyroErrors:
    """By how much a unit's gyros may differ from the table: a share of the angle, and a bias, deg/s."""

    share: float = 0.1
    bias_dps: float = 1.0


@dataclass(frozen=True)
class Track:
    """The whole run. `gyros`: None where the unit has none; `read_at_rest`: axes are read while they stand. Errors:
    `ValueError` for inconsistent times."""

    steps: tuple[TrackStep, ...]
    gyros: GyroErrors | None = GyroErrors()
    read_at_rest: bool = False

    def __post_init__(self) -> None:
        if not self.steps:
            raise ValueError("A track needs at least one step.")
        for step in self.steps:
            starts = [move.start_s for move in step.moves]
            if not (step.duration_s >= 0.0 and step.read_every_s > 0.0) or starts != sorted(starts):
                raise ValueError(f"Step {step.name!r}: durations are not negative and moves stand in order of time.")
            if starts and not (starts[0] >= 0.0 and starts[-1] <= step.duration_s):
                raise ValueError(f"Step {step.name!r}: every move starts within the step's {step.duration_s:g} s.")
            if step.ready is not None and step.begins_c is None:
                raise ValueError(f"Step {step.name!r} waits for a temperature and sets none.")
            if step.ramp_k_per_min is not None and not step.ramp_k_per_min > 0.0:
                raise ValueError(f"Step {step.name!r}: a ramp's rate is above zero; its sign follows from its target.")
        if self.steps[0].follows:
            raise ValueError("The first step follows none.")

    @property
    def duration_s(self) -> float:
        """The steps' own time, without waiting for their conditions."""
        return sum(step.duration_s for step in self.steps)

    @property
    def moved(self) -> list[str]:
        """The names of the axes that move."""
        moved = {move.axis for step in self.steps for move in step.moves}
        return sorted(moved | {name for step in self.steps if step.goes_there for name in step.start_deg})
