"""A log that ends before its plan does: what it lacks, and what the executed part predicts."""

from collections.abc import Sequence

import numpy as np

from gradcal_jax.api.prediction import requirement_rows
from gradcal_jax.files.contracts import RequirementRow
from gradcal_jax.files.log import Log
from gradcal_jax.files.schedule import StandardSchedule
from gradcal_jax.files.spec_sections import Spec

# A log that is shorter than its plan by less than this, s and as a share, is whole: runs end with their last reading.
_SHORT_S, _SHORT = 2.0, 0.01


def lacks_of(spec: Spec, logs: Sequence[Log]) -> str | None:
    """A sentence on the part of a spec's plan that its logs lack, beside the prediction of the rest; None: they hold it
    all, or the plan is one of points, of which each that is missing is named."""
    schedule = spec.schedule
    if isinstance(schedule, StandardSchedule) or spec.done:
        return None
    planned = sum(stretch.duration for stretch in schedule.stretches)
    recorded = sum(_recorded_s(log) for log in logs)
    if recorded > planned - max(_SHORT_S, _SHORT * planned):
        return None
    left, until = recorded, 0.0
    for stretch in schedule.stretches:
        until = stretch.start + min(left, stretch.duration)
        left -= stretch.duration
        if left <= 0.0:
            break
    text = f"the log ends at {recorded:.4g} s of the plan's {planned:.4g} s ({recorded / planned:.0%})"
    whole, part = requirement_rows(spec), requirement_rows(spec, until)
    said = [_beside(one, other) for one, other in zip(part, whole, strict=True)]
    return f"{text}: the executed part alone predicts, by the named terms, {'; '.join(said)}" if said else text


def _recorded_s(log: Log) -> float:
    """Time of all unbroken stretches."""
    steps = np.diff(log.time_s, prepend=log.time_s[:1])
    steps[log.stretch_starts] = 0.0
    return float(steps.sum())


def _beside(part: RequirementRow, whole: RequirementRow) -> str:
    left, planned = ("nothing" if v is None else f"{v:.4g} {part.unit}" for v in (part.decisive, whole.decisive))
    return f"{left} of {part.name} (the whole plan {planned})"
