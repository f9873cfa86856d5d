"""A run that was broken off: what is known by what was done, and the best plan for the time that is left.

What was done stands in the spec as `[[done]]`, so that every prediction of the new plan counts it: the same readings
and the same noise as of a plan, without the pieces that were not executed. It is one run: the drifts go on through the
pause, the turn-on bias stays what it was (the unit is not switched off), and the angle's origin is read anew. What
follows is searched as any plan is, on a ramp from where the chamber's course was broken off to where it was to end.
"""

import tomllib
from collections.abc import Callable, Sequence
from itertools import accumulate
from typing import Any, NamedTuple

from gradcal_jax.api.build import assemble
from gradcal_jax.api.flow import optimise
from gradcal_jax.api.measure import design_block
from gradcal_jax.api.optimise import Optimised, Step
from gradcal_jax.api.posterior_of_plan import UNIT_OF, residual_map, statistic_of
from gradcal_jax.files import Spec, changed, tables_of
from gradcal_jax.files.design import TIMES
from gradcal_jax.files.schedule import TemperatureSegment
from gradcal_jax.information import information, posterior

PAUSE_S = 1800.0
# Of a span that is ramped in the time that is left, so much is given up before the slope is called too steep; K.
_GRID_K = 0.1
# What is left of a segment for less than this is over; s.
_BRIEF_S = 1.0
_GO_ON = "go on with the run as it is, gradcal run --resume"
Span = tuple[float, float]
"""From when to when, on a plan's clock (s)."""


class KnownRow(NamedTuple):
    """What is known of a requirement: by what was done (`now`) and once the rest is (`at_end`); None: too little."""

    name: str
    axis: str
    unit: str
    now: float | None
    at_end: float | None


def with_done(spec: Spec, done: Sequence[Span], pause_s: float = PAUSE_S) -> Spec:
    """The spec with spans of its own plan as what was done before it."""
    plan = tables_of(spec)["plan"]
    parts = [
        {"plan": plan, "start": f"{begin:.9g} s", "end": f"{end:.9g} s", "pause": f"{pause_s:.9g} s"}
        for begin, end in done
    ]
    return changed(spec, {"done": [*tables_of(spec).get("done", ()), *parts]}) if parts else spec


def known_so_far(spec: Spec, done: Sequence[Span], goes_on_s: float, pause_s: float = PAUSE_S) -> list[KnownRow]:
    """What is left by what was done of the spec's plan, and once it has gone on from `goes_on_s` (s, its clock)."""
    whole = assemble(with_done(spec, done, pause_s))
    rows: list[KnownRow] = []
    for channel in whole.channels:
        past = whole.past.get(channel)
        rest = whole.schedules[channel].trajectory(whole.thermal_lag).between(goes_on_s, spec.schedule.duration)
        lines = [None if past is None else past.line, None]
        if rest.piece_count:
            lines[1] = rest if past is None else past.then(rest)
        else:
            lines[1] = lines[0]
        for requirement in spec.requirement:
            unit, _ = UNIT_OF[requirement.quantity]
            values: list[float | None] = []
            for line in lines:
                known = None if line is None else posterior(information(line, whole.model))
                of = [] if known is None else [statistic_of(requirement, residual_map(whole, known, requirement)[2])]
                values += of if of and of[0] < float("inf") else [None]
            rows.append(KnownRow(requirement.name, channel, unit, *values))
    return rows


def rest_of(spec: Spec, done: Sequence[Span], *, left_s: float | None = None, pause_s: float = PAUSE_S) -> Spec:
    """The spec of what is still to be done, with what was: a ramp of `left_s` (None: what the plan had left) from where
    the chamber was to where it was to end, and on it the first turn at the table of the plan's cycle, again and again.

    Errors: `ValueError` for a standard plan, where nothing is left, and where what is left is not one ramp.
    """
    schedule = spec.gradient_schedule
    seam_s = done[-1][1] if done else 0.0
    left = [s for s in schedule.segments if s.end > seam_s + _BRIEF_S]
    ramps = [s for s in left if s.kind == "ramp"]
    if not ramps:
        raise ValueError(f"nothing of the ramp is left: {_GO_ON}")
    slopes = [s.slope for s in ramps]
    waits = any(s.kind == "step" or not s.used for s in (left if done else left[1:]))
    if waits or min(slopes) * max(slopes) < 0.0:
        raise ValueError(f"what is left of the plan is not one ramp, up or down: {_GO_ON}")
    begins_c, ends_c = _course(ramps[0], seam_s), ramps[-1].temperature_end
    lasts_s = sum(s.end - max(s.start, seam_s) for s in left if s.used) if left_s is None else left_s
    chamber = spec.rig.chamber
    steepest = float(chamber.max_heating if ends_c > begins_c else chamber.max_cooling)
    if abs(ends_c - begins_c) > steepest * lasts_s:
        # As far as the chamber comes in the time.
        reach = _GRID_K * int(steepest * lasts_s / _GRID_K)
        ends_c = begins_c + (reach if ends_c > begins_c else -reach)
    ends_c, begins_c = round(ends_c, 3), round(begins_c, 1)
    if not lasts_s > 0.0 or abs(ends_c - begins_c) < _GRID_K:
        raise ValueError(f"no time is left for a ramp: {_GO_ON}")
    plan: dict[str, Any] = {
        "plan.programme": None,
        "plan.soak": None,
        "plan.temperature": [f"{begins_c:.9g} degC", f"{ends_c:.9g} degC"],
        "plan.gradient": f"{60.0 * abs(ends_c - begins_c) / lasts_s:.12g} K/min",
    }
    soak = schedule.segments[0]
    if soak.kind == "soak" and (schedule.cycle is None or not done):
        plan["plan.soak"] = {"duration": f"{soak.duration:.9g} s", "used": soak.used and not done}
    if schedule.cycle is not None:
        plan["plan.cycle"] = _one_visit(spec, lasts_s)
    design = tables_of(spec).get("design") or tomllib.loads(design_block(spec))["design"]
    design = {name: value for name, value in design.items() if name not in ("max_total", "max_motion")}
    if design["minimise"] not in TIMES:
        design["max_motion"] = f"{lasts_s:.9g} s"
    return changed(with_done(spec, done, pause_s), plan | {"design": design})


def replan(
    spec: Spec,
    done: Sequence[Span],
    *,
    left_s: float | None = None,
    pause_s: float = PAUSE_S,
    quick: bool = False,
    watch: Callable[[Step], None] = lambda _: None,
) -> Optimised:
    """The best plan for what is left of a run, given what was done of it.

    `spec`: of the recipe that was executed; `done`: from when to when, on its plan's clock (s), as
    `hardware.stretches` reads it from the journal. `left_s`: how long the rest may take; None: as long as the plan had
    left. `pause_s`: until it goes on. `quick`, `watch`, errors and what is returned: as `optimise`; the returned spec
    has `done`, its values are of all that was and will be done.
    """
    return optimise(rest_of(spec, done, left_s=left_s, pause_s=pause_s), quick=quick, watch=watch)


def _course(ramp: TemperatureSegment, at_s: float) -> float:
    return ramp.temperature_start + ramp.slope * max(at_s - ramp.start, 0.0)


def _one_visit(spec: Spec, lasts_s: float) -> dict[str, Any]:
    """The first turn at the table of a cycle, and after it the time of the other axes, as a cycle of its own; of one
    that is longer than what is left, what fits."""
    cycle, tables = spec.gradient_schedule.cycle, tables_of(spec)["plan"]["cycle"]
    assert cycle is not None
    others = [k for k, move in enumerate(cycle.moves) if move.other_axes]
    if others:
        between = tables["moves"][others[0]]
        reads = "read_every" in between
        other = {"duration": between["rest"], "read": reads} | ({"read_every": between["read_every"]} if reads else {})
        return {"moves": tables["moves"][: others[0]], "other_axes": other}
    if cycle.moving <= lasts_s:
        return tables
    ends_s = accumulate(move.repeat * move.duration for move in cycle.moves)
    fits = sum(end_s < lasts_s - _BRIEF_S for end_s in ends_s)
    stands_s = lasts_s - sum(move.repeat * move.duration for move in cycle.moves[:fits])
    every_s = next((move.read_every for move in cycle.moves if move.read_every), 1.0)
    rest = {"rest": f"{stands_s:.9g} s", "read_every": f"{every_s:.9g} s"}
    return {"moves": [*tables["moves"][:fits], rest]}
