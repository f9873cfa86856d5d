"""The states of a run and the ways between them, its progress, and how it ended: plain data."""

from collections.abc import Mapping
from dataclasses import dataclass, field
from enum import Enum
from typing import Literal

from gradcal_jax.display import summary

from .roles import AxisReading, ChamberReading
from .safety import SafeOutcome


class RunState(Enum):
    IDLE = "idle"
    RUNNING = "running"
    PAUSING = "pausing"
    PAUSED = "paused"
    STOPPING = "stopping"
    ABORTING = "aborting"
    SAFE = "safe"
    FAILED = "failed"


WAYS: Mapping[RunState, frozenset[RunState]] = {
    RunState.IDLE: frozenset({RunState.RUNNING, RunState.ABORTING}),
    RunState.RUNNING: frozenset({RunState.PAUSING, RunState.STOPPING, RunState.ABORTING}),
    RunState.PAUSING: frozenset({RunState.RUNNING, RunState.PAUSED, RunState.STOPPING, RunState.ABORTING}),
    RunState.PAUSED: frozenset({RunState.RUNNING, RunState.STOPPING, RunState.ABORTING}),
    RunState.STOPPING: frozenset({RunState.SAFE, RunState.FAILED}),
    RunState.ABORTING: frozenset({RunState.SAFE, RunState.FAILED}),
    RunState.SAFE: frozenset(),
    RunState.FAILED: frozenset(),
}


@dataclass(frozen=True)
class RunResult:
    """How a run ended: "success", "stopped" (on request) or "aborted", why, and the final state of every device."""

    exit_status: Literal["success", "stopped", "aborted"]
    reason: str
    outcomes: tuple[SafeOutcome, ...]
    steps_done: int
    begun: bool = True
    """Whether anything was commanded to a device."""

    __repr__ = summary

    @property
    def verified_safe(self) -> bool:
        return all(outcome.verified for outcome in self.outcomes)


@dataclass(frozen=True)
class RunProgress:
    """The argument of `on_progress`, called once for each chamber reading in the run's own thread: the run waits until
    it returns."""

    state: RunState
    step: str
    steps_done: int
    steps: int
    step_left_s: float | None
    track_left_s: float
    chamber: ChamberReading | None
    axes: Mapping[str, AxisReading]
    course_c: tuple[float, float] | None = None
    """The lowest and the highest temperature of the air by the recipe now, without the band."""
    samples: Mapping[str, tuple[int, int]] = field(default_factory=dict[str, tuple[int, int]])
    """Samples of each unit: received, and missing between them."""
    why: str = ""
    """Why the run is paused, or will be."""
    remarks: tuple[str, ...] = ()
    """What the operator is to mend after the run: devices that answer late."""
