"""An interrupted run: the posterior after its executed part, and the best plan for the remaining time.

The executed part is in the spec as `[[done]]`, so that every prediction of the new plan includes its readings and
noise. Both are one run: the drifts continue through the pause, the turn-on bias stays (the unit is not switched off),
and the angle's origin is read anew. The remaining plan is searched like any plan, on a ramp from the temperature of the
interruption to the end of the old ramp.
"""

import math
import tomllib
from collections.abc import Callable, Sequence
from typing import Any, NamedTuple

from gradcal_jax.api.flow import optimise
from gradcal_jax.api.imu_build import build_imu, executed_motion
from gradcal_jax.api.imu_residual import imu_residual
from gradcal_jax.api.measure import design_block
from gradcal_jax.api.search_results import Optimised, SearchStep
from gradcal_jax.api.structures import ResolvedCycle, cycle_of, ramped_shape, read_spacing, visit_times
from gradcal_jax.files import changed, tables_of
from gradcal_jax.files.rounding import steps_of
from gradcal_jax.files.spec_sections import Spec
from gradcal_jax.information import imu_information, posterior
from gradcal_jax.trajectory import body_nodes

PAUSE_S = 1800.0
_ROUNDING = 1e-6
# A segment that ends within this time counts as over; s.
_BRIEF_S = 1.0
# The share of a turn at the table for which the axis rests in the first plan of a search.
_STANDS = 0.2
_GO_ON = "continue the run with its plan, gradcal run --resume"
Span = tuple[float, float]
"""Start and end on a plan's clock (s)."""


class KnownRow(NamedTuple):
    """The residual of a requirement after the executed part (`now`) and after the whole plan (`at_end`); None: not
    observable."""

    name: str
    axis: str
    unit: str
    now: float | None
    at_end: float | None


def with_done(spec: Spec, done: Sequence[Span], pause_s: float = PAUSE_S) -> Spec:
    """The spec with spans of its own plan as the part that was executed before it."""
    plan: dict[str, Any] = {"plan": tables_of(spec)["plan"], "pause": f"{pause_s:.9g} s"}
    parts = [plan | {"start": f"{begin:.9g} s", "end": f"{end:.9g} s"} for begin, end in done]
    return changed(spec, {"done": [*tables_of(spec).get("done", ()), *parts]}) if parts else spec


def known_so_far(spec: Spec, done: Sequence[Span], goes_on_s: float) -> list[KnownRow]:
    """The residual of each requirement after the executed spans of the spec's plan, and after the plan has continued
    from `goes_on_s` (s, its clock): the end of the last span while a run is under way, or the start of a repeated
    step."""
    ends_s = spec.schedule.duration
    flows = bool(done) and abs(goes_on_s - done[-1][1]) < _BRIEF_S
    rest = [(done[-1][0], ends_s)] if flows else [(goes_on_s, ends_s)] if goes_on_s < ends_s else []
    rows = []
    for spans in (done, [*done[: len(done) - flows], *rest]):
        built = build_imu(with_done(spec, spans))
        motion = executed_motion(built)
        motions = [] if motion is None else [(motion, body_nodes(motion, built.points))]
        known = posterior(imu_information(motions, built.model))
        rows.append([imu_residual(built, known, requirement) for requirement in spec.requirement])
    return [
        KnownRow(now.requirement.name, now.requirement.axis, now.unit, now.statistic(), end.statistic())
        for now, end in zip(*rows, strict=True)
    ]


def rest_of(spec: Spec, done: Sequence[Span], *, left_s: float | None = None, pause_s: float = PAUSE_S) -> Spec:
    """The spec of the remaining plan, after the executed part: a ramp of `left_s` (None: the plan's remaining time)
    from the temperature of the interruption to the plan's last one, with the plan's cycle; where turns of one gyro are
    searched, with as many turns at the table of about the same length as fit.

    Errors: `ValueError` for a standard plan, where nothing is left, where the remaining programme is not one ramp, and
    for several mountings.
    """
    if len(spec.rig.table.mounting) > 1:
        raise ValueError(f"a plan with several mountings cannot be replanned: {_GO_ON}")
    schedule = spec.executable_schedule
    seam_s = done[-1][1] if done else 0.0
    left = [s for s in schedule.segments if s.end > seam_s + _BRIEF_S]
    ramps = [s for s in left if s.kind == "ramp"]
    if not ramps:
        raise ValueError(f"the ramp is complete: {_GO_ON}")
    slopes = [s.slope for s in ramps]
    waits = any(s.kind == "step" or not s.used for s in (left if done else left[1:]))
    if waits or min(slopes) * max(slopes) < 0.0:
        raise ValueError(f"the remaining plan is not a single ramp, up or down: {_GO_ON}")
    begins_c = ramps[0].temperature_start + ramps[0].slope * max(seam_s - ramps[0].start, 0.0)
    ends_c = ramps[-1].temperature_end
    lasts_s = sum(s.end - max(s.start, seam_s) for s in left if s.used) if left_s is None else left_s
    chamber, steps = spec.rig.chamber, steps_of(spec)
    steepest = float(chamber.max_heating if ends_c > begins_c else chamber.max_cooling)
    fine, grid_k = float(steps.slope), float(steps.temperature)
    begins_c = grid_k * round(begins_c / grid_k)
    # A slope of the controller's steps at which the ramp ends in time, or the steepest that the chamber allows.
    span_k, least = abs(ends_c - begins_c), max(lasts_s, _BRIEF_S)
    slope = fine * min(math.ceil(span_k / least / fine - _ROUNDING), math.floor(steepest / fine + _ROUNDING))
    span_k = grid_k * math.floor(min(span_k, slope * lasts_s) / grid_k + _ROUNDING)
    if span_k <= 0.0:
        raise ValueError(f"there is no time for a ramp: {_GO_ON}")
    ends_c, lasts_s = begins_c + math.copysign(span_k, ends_c - begins_c), span_k / slope
    plan: dict[str, Any] = {
        "plan.programme": None,
        "plan.soak": None,
        "plan.temperature": [f"{begins_c:.9g} degC", f"{ends_c:.9g} degC"],
        "plan.gradient": f"{60.0 * slope:.9g} K/min",
    }
    soak = schedule.segments[0]
    if soak.kind == "soak" and (not schedule.steps or not done):
        plan["plan.soak"] = {"duration": f"{soak.duration:.9g} s", "used": soak.used and not done}
    if design := tables_of(spec).get("design"):
        # The limits of the whole run's time: the rest has the plan's own.
        plan["design"] = {name: value for name, value in design.items() if name not in ("max_total", "max_motion")}
    if spec.turns_one_gyro:
        design = plan.setdefault("design", tomllib.loads(design_block(spec))["design"])
        if (cycle := cycle_of(spec)) is not None and {"duration", "rest", "turn"} & set(design["free"]):
            plan["plan.cycle"] = _visits(spec, cycle, lasts_s)
    return changed(with_done(spec, done, pause_s), plan)


def replan(
    spec: Spec,
    done: Sequence[Span],
    *,
    left_s: float | None = None,
    pause_s: float = PAUSE_S,
    quick: bool = False,
    watch: Callable[[SearchStep], None] = lambda _: None,
) -> Optimised:
    """The best plan for the rest of a run, after its executed part. For a whole unit use `rest_of` and `optimise`.

    `spec`: of the executed recipe; `done`: the executed spans on its plan's clock (s), as `hardware.run_folder` reads
    them from the journal. `left_s`: how long the rest may take; None: the plan's remaining time. `pause_s`: duration of
    the interruption. `quick`, `watch` and the result: as `optimise`; the returned spec has `done`, and its values (ppm
    or deg/h) are those of the whole run.

    Errors: `ValueError` where nothing is left of the plan, or not one ramp up or down, and as `optimise`.
    """
    return optimise(rest_of(spec, done, left_s=left_s, pause_s=pause_s), quick=quick, watch=watch)


def _visits(spec: Spec, cycle: ResolvedCycle, lasts_s: float) -> dict[str, Any]:
    """A cycle of one turn at the table and the other axes' time after it, a whole number of which fills the rest.

    Both are nearly as long as in the spec. The moves are only the start of a search.
    """
    own, other = visit_times(cycle)
    visits = max(1, round((lasts_s + other) / (own + other)))
    share, step = lasts_s / (visits * own + (visits - 1) * other), float(steps_of(spec).time)
    each_s, other = (step * math.floor(share * time / step + _ROUNDING) for time in (own, other))
    every_s = read_spacing(cycle)
    stands_s = every_s * max(1, int(_STANDS * each_s / every_s))
    turns_s = 0.5 * (each_s - stands_s)
    axis = spec.rig.table.axis[0]
    rate = min(0.5 * float(axis.max_rate), 0.1 * float(axis.max_acceleration) * turns_s)
    rate = math.degrees(min(rate, 0.5 * float(axis.travel) / turns_s))
    turn = {"duration": f"{turns_s:.9g} s", "shape": ramped_shape(cycle)}
    moves: list[dict[str, Any]] = [{"rest": f"{stands_s:.9g} s", "read_every": f"{every_s:.9g} s"}]
    moves += [turn | {"peak_rate": f"{way * rate:.6g} deg/s"} for way in (1.0, -1.0)]
    result: dict[str, Any] = {"moves": moves}
    if other > 0.0:
        result["other_axes"] = {"duration": f"{other:.9g} s", "read": cycle.other_read_every is not None}
        if cycle.other_read_every is not None:
            result["other_axes"]["read_every"] = f"{cycle.other_read_every:.9g} s"
    return result
