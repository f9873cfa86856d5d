"""`optimise`: the best plan for a spec, by the search that suits it: the turns of one gyro, the poses of any other IMU,
or the shortest time that meets the targets. `frontier`: the best plan for each of several durations."""

import logging
import math
from collections.abc import Callable, Iterator, Sequence
from functools import partial
from typing import Final, NamedTuple

import numpy as np

from gradcal_jax.design.cycle_plan import CyclePlan
from gradcal_jax.design.plan_limit import limit
from gradcal_jax.design.pose_search import (
    EVALUATIONS,
    EVALUATIONS_OF_VISITS,
    QUICK_EVALUATIONS,
    QUICK_EVALUATIONS_OF_VISITS,
    PoseSearch,
)
from gradcal_jax.design.prices import Price
from gradcal_jax.design.searching import Optimised, SearchStep, search_plans
from gradcal_jax.design.visits import motion_time, visit_choices, with_motion
from gradcal_jax.information.verdicts import limit_of
from gradcal_jax.spec.design import TIMES, Design
from gradcal_jax.spec.motion_plan import duration_of
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

    The search changes a cycle of turns and rests, or of a table at rest the chamber's course, as [design] frees them.
    `steps`: gradients in all (14000; 4500 where one gyro turns about the only axis of a table). `quick`: few of them,
    within some per cent of the best in seconds. `until_met`: no further than to a plan that meets every target with a
    margin of 10 %. `watch` is called with progress (`design.searching.SearchStep`: `best` in `unit`, `share` of the
    work). Returns `design.searching.Optimised`: the rounded `spec`, `now` its residual and `before` the first plan's,
    in `unit` (ppm or deg/h; minutes, where time is minimised), all requirements in `rows`, `converged` and a `sentence`
    with the reason, and the limits that bind with their shadow prices. It is the best of several local
    optima: `limit` bounds what another plan could still gain.

    Errors: `ValueError` where limits exclude each other, where nothing can be observed, for targets that are not met in
    the time allowed, and for `until_met` without a target or with a minimised time.
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
    stop: Callable[[], bool] = lambda: False,
) -> Iterator[SearchStep | Optimised]:
    """The search of `optimise`: a `SearchStep` every few iterations and the `Optimised` plan at the end.

    `motion` s: time without soaks, in the place of [design]'s or the plan's. `stop`: called after every step; once
    true, the best plan so far is finished. Errors: `ValueError` when limits exclude each other, nothing can be
    observed, the table is turned by hand or, with `until_met`, there is no target.
    """
    spec = expect_spec(spec)
    stands, design = not spec.gradient_schedule.steps, spec.design or Design()
    if spec.rig.table.drive == "hand" and not stands:
        raise ValueError(BY_HAND)
    if motion is None and design.minimise in TIMES:
        if until_met:
            raise ValueError(NO_UNTIL_MET)
        yield from minimise_time(spec, partial(run_search, spec, steps=steps, quick=quick, stop=stop), stop)
        return
    if motion is None and (design.max_motion or design.max_total):
        motion = motion_time(spec, design)
    timed = spec if motion is None else with_motion(spec, motion)
    visited = spec.turns_one_gyro and not stands
    plans = [CyclePlan(timed, times) for times in visit_choices(timed, design)] if visited else [CyclePlan(timed)]
    full, few = (
        (EVALUATIONS_OF_VISITS, QUICK_EVALUATIONS_OF_VISITS) if plans[0].draws else (EVALUATIONS, QUICK_EVALUATIONS)
    )
    evaluations = few if quick else len(plans) * full
    yield from search_plans(PoseSearch(plans, steps or evaluations, stop), until_met=until_met)


def belief_of(spec: Spec) -> str:
    """A sentence on the maps that a design takes as exact; empty where each has a discrepancy or smoothness."""
    gyro = spec.sensor.gyro
    sections = {} if gyro is None else {"bias": gyro.bias, "scale factor": gyro.scale_factor}
    sure = [name for name, s in sections.items() if s is not None and s.discrepancy is None and s.smoothness is None]
    if not sure:
        return ""
    return (
        f"assumed: the {' and the '.join(sure)} {'have' if len(sure) > 1 else 'has'} exactly the structure in the "
        "spec; if the spec states a discrepancy, the plan is robust against deviations from this structure"
    )


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
    schedule = spec.gradient_schedule
    if not schedule.steps:
        return longest * _SHORTEST
    chamber, ramps = spec.rig.chamber, [s for s in schedule.segments if s.kind == "ramp"]
    steepest = (
        abs(s.temperature_end - s.temperature_start) / (chamber.max_heating if s.slope > 0.0 else chamber.max_cooling)
        for s in ramps
    )
    return min(longest, max(math.fsum(steepest), duration_of(schedule.steps)))


def _between(short: float, long: float, too_much: float | None, enough: float) -> float:
    """The time at which the residual meets the target, interpolated linearly in logarithms."""
    share = 0.5 if too_much is None else np.log(too_much) / (np.log(too_much) - np.log(enough))
    return float(short * (long / short) ** np.clip(share, 0.1, 0.9))


def _as_time(spec: Spec, best: Optimised, time: float, longest: float) -> Optimised:
    """The result in minutes; the price of a limit follows from the residual's derivatives: −(∂r/∂limit)/(∂r/∂time)."""
    minutes = time / 60.0
    per_minute = next((p.change for p in best.prices if p.per == "minute"), 0.0)
    bound = Price("the target", "", 0.0) if best.now > 1.0 / _NEAR else Price("the chamber's slope", "", 0.0)
    prices = tuple(
        p._replace(change=-p.change / per_minute)
        for p in best.prices
        if p.per != "minute" and per_minute != 0.0 and best.now > 1.0 / _NEAR
    )
    return best._replace(
        name="motion time",
        unit="min",
        before=spec.gradient_schedule.motion / 60.0,
        now=minutes,
        sentence=f"{best.sentence}; the remaining error is {best.now:.3g} times the target; the search allowed at most "
        f"{longest / 60.0:.4g} min",
        prices=(*prices, bound),
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
