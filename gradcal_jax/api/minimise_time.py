"""The shortest plan that meets the targets: durations are tried until the residual just does."""

import math
from collections.abc import Callable, Iterator

import numpy as np

from gradcal_jax.api.limit import limits
from gradcal_jax.api.search_results import Optimised, Price, SearchStep
from gradcal_jax.api.structures import motion_time
from gradcal_jax.api.verdicts import limit_of
from gradcal_jax.files.motion_plan import duration_of
from gradcal_jax.files.schedule import StandardSchedule
from gradcal_jax.files.spec_sections import Spec

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
        raise ValueError(f'"{spec.design.minimise}" is minimised under targets: give a requirement a target')
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
                    words = f"{event.best:.3g} of the target in {time / 60.0:.4g} min"
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
                f"no plan found meets the target in {longest / 60.0:.4g} min: the best one leaves {plan.now:.3g} "
                "times the target"
            )
    assert best is not None
    yield _as_time(spec, best, long, longest)


def _refuse_what_no_plan_meets(spec: Spec, longest: float) -> None:
    """A target below the proven limit needs no search."""
    try:
        rows = {row.name: row for row in limits(spec, motion=longest)}
    except ValueError:
        # There is no proof for such plans or requirements.
        return
    for requirement in spec.requirement:
        row = rows.get(requirement.name)
        limit = limit_of(requirement)
        if row is not None and limit is not None and row.certified > limit[1]:
            raise ValueError(
                f"no plan meets {row.name!r}: its target allows {limit[1]:.4g} {row.unit} (1σ), and proven limits "
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
        sentence=f"{best.sentence}; {best.now:.3g} times the target; {longest / 60.0:.4g} min were allowed",
        starts=(),
        active=(*best.active, bound),
        prices=prices,
    )
