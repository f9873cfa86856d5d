"""`optimise`: the best plan for a spec, by the search that suits it: the turns of one gyro, the poses of any other IMU,
or the shortest time that meets the targets. `frontier`: the best plan for each of several durations; `replan`: that for
the rest of an interrupted run.

The executed part of an interrupted run is in the spec as `[[done]]`, so that every prediction of the new plan includes
its readings and noise. Both are one run: the drifts continue through the pause, the turn-on bias stays (the IMU is not
switched off), and the angle's origin is read anew. The remaining plan is searched like any plan, on a ramp from the
temperature of the interruption to the end of the old ramp.
"""

import logging
import math
import tomllib
from collections.abc import Callable, Iterator, Mapping, Sequence
from functools import partial
from typing import Any, Final, NamedTuple

import numpy as np

from gradcal_jax.design.cycle_plan import CyclePlan
from gradcal_jax.design.plan_limit import limit
from gradcal_jax.design.pose_search import EVALUATIONS, QUICK_EVALUATIONS, PoseSearch
from gradcal_jax.design.searching import Optimised, PlanSearch, Price, SearchStep, search_plans
from gradcal_jax.design.turn_plan import (
    ResolvedCycle,
    cycle_of,
    design_block,
    motion_time,
    ramped_shape,
    read_spacing,
    visit_times,
    with_motion,
)
from gradcal_jax.design.turn_search import STEPS, TurnSearch
from gradcal_jax.information import posterior
from gradcal_jax.information.imu_residual import imu_residual
from gradcal_jax.information.verdicts import limit_of
from gradcal_jax.model.imu_build import build_imu, executed_motion, information_with_gears
from gradcal_jax.motion import body_nodes
from gradcal_jax.recipe.rounding import steps_of
from gradcal_jax.spec.changes import changed, tables_of
from gradcal_jax.spec.design import TIMES
from gradcal_jax.spec.motion_plan import duration_of
from gradcal_jax.spec.plan import StandardPlan
from gradcal_jax.spec.schedule import StandardSchedule
from gradcal_jax.spec.spec import expect_spec
from gradcal_jax.spec.spec_sections import Spec
from gradcal_jax.tables.display import summary

_LOG = logging.getLogger(__name__)

BY_HAND = (
    'rig.table.drive is "hand": the search plans turns of a motor. Optimise the plan with drive = "motor" and '
    'moves without shape = "hand", then write its turns as turns by hand, with the durations that a person needs'
)
"""Why no plan of turns by hand is searched."""
NO_UNTIL_MET = "a search for the shortest plan ends when its targets are just met: leave --until-met out"


def optimise(
    spec: Spec,
    *,
    steps: int | None = None,
    quick: bool = False,
    until_met: bool = False,
    watch: Callable[[SearchStep], None] = lambda _: None,
) -> Optimised:
    """The best plan that gradient descent finds for a spec, rounded to the controllers' steps.

    Of one gyro along the only axis of a table the search changes what [design] frees; of any other IMU a cycle of turns
    and poses. `steps`: iterations of each start (240) or, of poses, gradients in all (14000). `quick`: few of them,
    within some per cent of the best in seconds. `until_met`: no further than to a plan that meets every target with a
    margin of 10 %. `watch` is called with progress (`api.searching.SearchStep`: `best` in `unit`, `share` of the
    work). Returns `api.searching.Optimised`: the rounded `spec`, `now` its residual and `before` the first plan's,
    in `unit` (ppm or deg/h; minutes, where time is minimised), all requirements in `rows`, `converged` and a `sentence`
    with the reason, and the limits that bind with their shadow prices. It is the best of several local
    optima: `limit` bounds what another plan could still gain.

    Errors: `ValueError` without a [design] for an axis, where limits exclude each other, where nothing can be observed,
    for targets that are not met in the time allowed, and for `until_met` without a target or with a minimised time.
    """
    for event in run_search(spec, steps=steps, quick=quick, until_met=until_met):
        if isinstance(event, Optimised):
            _LOG.info("optimise: %.4g %s; %s", event.now, event.unit, event.sentence)
            return event
        _LOG.info("optimise: %s %.4g %s, %.0f %% done", event.name, event.best, event.unit, 100.0 * event.share)
        watch(event)
    raise AssertionError("a search ends with its result")


def run_search(
    spec: Spec,
    *,
    steps: int | None = None,
    quick: bool = False,
    until_met: bool = False,
    motion: float | None = None,
    checkpoint: Mapping[str, np.ndarray] | None = None,
    stop: Callable[[], bool] = lambda: False,
) -> Iterator[SearchStep | Optimised]:
    """The search of `optimise`: a `SearchStep` every few iterations and the `Optimised` plan at the end.

    One gyro along the only axis of a table: the course of its turns, of the chamber, or the set points; any other IMU:
    a cycle of turns and poses. `steps`: iterations of each start (None: 240) or, of poses, gradients in all (None:
    14000). `quick`: few of them. `until_met`: no further than to a plan that, rounded, meets every target with a margin
    of 10 %; no search where the spec's own plan does. `motion` s: time without soaks, in the place of [design]'s or the
    plan's. `checkpoint`: resume from that of a step. `stop`: called after every step; once true, the best plan so far
    is finished. Errors: `ValueError` when limits exclude each other, nothing can be observed, the table is turned by
    hand or, with `until_met`, there is no target.
    """
    spec = expect_spec(spec)
    stands = isinstance(spec.plan, StandardPlan) or spec.plan.cycle is None
    if spec.rig.table.drive == "hand" and not stands:
        raise ValueError(BY_HAND)
    if motion is None and spec.design is not None and spec.design.minimise in TIMES:
        if until_met:
            raise ValueError(NO_UNTIL_MET)
        if checkpoint is not None:
            raise ValueError("a search for the shortest plan is not saved: start again, without --resume")
        yield from minimise_time(spec, partial(run_search, spec, steps=steps, quick=quick, stop=stop), stop)
        return
    if spec.turns_one_gyro:
        searched: PlanSearch = TurnSearch(spec, steps=steps or STEPS, quick=quick, motion=motion, stop=stop)
    else:
        if motion is None and spec.design is not None and (spec.design.max_motion or spec.design.max_total):
            motion = motion_time(spec, spec.design)
        timed = spec if motion is None else with_motion(spec, motion)
        evaluations = steps or (QUICK_EVALUATIONS if quick else EVALUATIONS)
        searched = PoseSearch(CyclePlan(timed), evaluations, stop)
    yield from search_plans(searched, until_met=until_met, checkpoint=checkpoint)


# --- the shortest plan ------------------------------------------------------------------------------------------------

# Relative accuracy of the time; the largest number of durations that are tried.
_NEAR = 1.02
_TRIES = 8
# The shortest duration that is tried, as a share of the time allowed.
_SHORTEST = 1.0 / 20.0


def minimise_time(
    spec: Spec,
    search: Callable[..., Iterator[SearchStep | Optimised]],
    stop: Callable[[], bool] = lambda: False,
) -> Iterator[SearchStep | Optimised]:
    """As `optimise`, for [design] that minimises "motion time" or "total time" under the requirements' targets.

    `search(motion=…)`: the search of plans of that duration, for the largest residual over its target. Values are
    durations in min, of the motion alone: a soak adds the same to each. Errors: `ValueError` where the targets are not
    met in the time allowed, with the best plan's residual; `KeyboardInterrupt` where `stop` ends the search before any
    plan meets them.
    """
    assert spec.design is not None
    if all(r.target is None for r in spec.requirement):
        raise ValueError(
            f'minimise = "{spec.design.minimise}" finds the shortest plan that meets the targets: give at least one '
            "requirement a target"
        )
    longest = motion_time(spec, spec.design)
    _refuse_what_no_plan_meets(spec, longest)
    short, long = _least(spec, longest), longest
    # Residual over target of the longest duration that is too short.
    too_much: float | None = None
    best: Optimised | None = None
    for tried in range(_TRIES):
        if tried == 0:
            time = short
        elif best is None:
            time = long
        elif long <= short * _NEAR or stop():
            break
        else:
            time = _between(short, long, too_much, best.now)
        plan = None
        try:
            for event in search(motion=time):
                if isinstance(event, Optimised):
                    plan = event
                else:
                    share = (tried + event.share) / _TRIES
                    words = f"{event.best:.3g} times the target in {time / 60.0:.4g} min"
                    yield event._replace(
                        name="motion time",
                        unit="min",
                        before=None,
                        best=long / 60.0,
                        share=share,
                        words=words,
                        checkpoint={},
                    )
        except ValueError:
            if time == longest:
                raise
        if plan is not None and plan.now <= 1.0:
            best, long = plan, time
            if tried == 0:
                break
        else:
            short, too_much = time, None if plan is None else plan.now
        if best is None and stop():
            raise KeyboardInterrupt
        if best is None and time == longest and plan is not None:
            raise ValueError(
                f"none of the plans found meets the target in {longest / 60.0:.4g} min: the best one leaves "
                f"{plan.now:.3g} times the target"
            )
    assert best is not None
    yield _as_time(spec, best, long, longest)


def _refuse_what_no_plan_meets(spec: Spec, longest: float) -> None:
    """A target below the proven limit needs no search."""
    try:
        rows = {row.name: row for row in limit(spec, motion=longest)}
    except ValueError:
        # There is no proof for such plans or requirements.
        return
    for requirement in spec.requirement:
        row = rows.get(requirement.name)
        allowed = limit_of(requirement)
        if row is not None and allowed is not None and row.certified > allowed[1]:
            raise ValueError(
                f"no plan meets {row.name!r}: its target allows {allowed[1]:.4g} {row.unit} (1σ), and proven limits "
                f"show that no plan leaves less than {row.certified:.4g} {row.unit} in {longest / 60.0:.4g} min "
                "on this rig"
            )


def _least(spec: Spec, longest: float) -> float:
    """A lower bound on the duration: the steepest ramp of the chamber, with one turn at the table."""
    if isinstance(spec.schedule, StandardSchedule) or not spec.schedule.steps:
        return longest * _SHORTEST
    chamber, ramps = spec.rig.chamber, [s for s in spec.schedule.segments if s.kind == "ramp"]
    steepest = (
        abs(s.temperature_end - s.temperature_start) / (chamber.max_heating if s.slope > 0.0 else chamber.max_cooling)
        for s in ramps
    )
    return min(longest, max(math.fsum(steepest), duration_of(spec.schedule.steps)))


def _between(short: float, long: float, too_much: float | None, enough: float) -> float:
    """The time at which the residual meets the target, interpolated linearly in logarithms."""
    share = 0.5 if too_much is None else np.log(too_much) / (np.log(too_much) - np.log(enough))
    return float(short * (long / short) ** np.clip(share, 0.1, 0.9))


def _as_time(spec: Spec, best: Optimised, time: float, longest: float) -> Optimised:
    """The result in minutes; the price of a limit follows from the residual's derivatives: −(∂r/∂limit)/(∂r/∂time)."""
    minutes = time / 60.0
    per_minute = next((p.change for p in best.prices if p.per == "minute"), 0.0)
    prices = tuple(
        Price(p.limit, p.per, -p.change / per_minute)
        for p in best.prices
        if p.per != "minute" and per_minute != 0.0 and best.now > 1.0 / _NEAR
    )
    bound = "the target" if best.now > 1.0 / _NEAR else "the chamber's slope"
    return best._replace(
        name="motion time",
        unit="min",
        before=spec.gradient_schedule.motion / 60.0 if not isinstance(spec.schedule, StandardSchedule) else None,
        optimum=minutes,
        now=minutes,
        sentence=f"{best.sentence}; the remaining error is {best.now:.3g} times the target; the search allowed at most "
        f"{longest / 60.0:.4g} min",
        starts=(),
        active=(*best.active, bound),
        prices=prices,
    )


# --- plans of several durations ---------------------------------------------------------------------------------------

_BLIND: Final = (
    "in every plan found for this duration, some requirements are not observable: increase moves in [design]"
)


class FrontierPoint(NamedTuple):
    """A ramp of `motion` s, without soaks, with its best plan, or the `reason` why there is none."""

    motion: float
    plan: Optimised | None
    reason: str

    __repr__ = summary


def frontier_points(
    spec: Spec,
    times: list[float],
    *,
    steps: int | None = None,
    watch: Callable[[float, SearchStep], None] = lambda _, __: None,
) -> Iterator[FrontierPoint]:
    """Optimise for each of `times` (s, without soaks); `watch` is called at every step. Errors: as `optimise`."""
    for time in times:
        try:
            for event in run_search(spec, steps=steps, motion=time):
                if isinstance(event, Optimised):
                    yield (
                        FrontierPoint(time, event, event.sentence)
                        if np.isfinite(event.now)
                        else FrontierPoint(time, None, _BLIND)
                    )
                else:
                    watch(time, event)
        except ValueError as error:
            if len(times) == 1:
                raise
            yield FrontierPoint(time, None, str(error))


def shortest(points: list[FrontierPoint], target: float) -> float | None:
    """The motion time (s) at which the frontier crosses `target`, between its points; None where it does not.

    Between points the logarithm of the residual is taken as linear in that of the time.
    """
    known = sorted((p.motion, p.plan.now) for p in points if p.plan is not None and np.isfinite(p.plan.now))
    # A longer plan can do what a shorter one does and then wait, so the frontier never rises.
    best = np.minimum.accumulate([value for _, value in known]) if known else np.array([])
    for k in range(len(known)):
        if best[k] <= target:
            if k == 0 or best[k] == best[k - 1]:
                return known[k][0]
            (early, late), (high, low) = np.log([known[k - 1][0], known[k][0]]), np.log([best[k - 1], best[k]])
            return float(np.exp(early + (late - early) * (high - np.log(target)) / (high - low)))
    return None


def frontier(spec: Spec, motion_s: Sequence[float], *, steps: int | None = None) -> list[FrontierPoint]:
    """The best residual for each of several durations of the ramp, `motion_s` in s, soaks not counted.

    Each `api.optimise.FrontierPoint` has `motion` (s) and its `plan` as `optimise` gives it, or None and the `reason`.

    Errors: as `optimise`, where no duration has a plan and only one was asked for.
    """
    return list(frontier_points(spec, list(motion_s), steps=steps))


# --- the rest of a run ------------------------------------------------------------------------------------------------

PAUSE_S = 1800.0
_ROUNDING = 1e-6
# A segment that ends within this time counts as over; s.
_BRIEF_S = 1.0
# The share of a turn at the table for which the axis rests in the first plan of a search.
_STANDS = 0.2
_GO_ON = "continue the run with its own plan (gradcal run --resume)"
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
        known = posterior(information_with_gears(motions, built.model, built.gears))
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
