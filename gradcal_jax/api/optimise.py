"""`optimise`: the best plan that a search finds for a spec, by what its rig can turn."""

from collections.abc import Callable, Iterator, Mapping
from functools import partial

import numpy as np

from gradcal_jax.api.cycle_plan import CyclePlan
from gradcal_jax.api.minimise_time import minimise_time
from gradcal_jax.api.pose_search import EVALUATIONS, QUICK_EVALUATIONS, PoseSearch
from gradcal_jax.api.search_results import Optimised, SearchStep
from gradcal_jax.api.searching import PlanSearch, search_plans
from gradcal_jax.api.structures import motion_time, with_motion
from gradcal_jax.api.turn_search import STEPS, TurnSearch
from gradcal_jax.files.design import TIMES
from gradcal_jax.files.plan import StandardPlan
from gradcal_jax.files.spec import expect_spec
from gradcal_jax.files.spec_sections import Spec

BY_HAND = (
    'rig.table.drive is "hand": the search plans turns of a motor. Search the plan with drive = "motor" and '
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
    motion: float | None = None,
    checkpoint: Mapping[str, np.ndarray] | None = None,
    stop: Callable[[], bool] = lambda: False,
) -> Iterator[SearchStep | Optimised]:
    """Yield a `SearchStep` every few iterations and the `Optimised` plan at the end.

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
        yield from minimise_time(spec, partial(optimise, spec, steps=steps, quick=quick, stop=stop), stop)
        return
    if spec.turns_one_gyro:
        search: PlanSearch = TurnSearch(spec, steps=steps or STEPS, quick=quick, motion=motion, stop=stop)
    else:
        if motion is None and spec.design is not None and (spec.design.max_motion or spec.design.max_total):
            motion = motion_time(spec, spec.design)
        timed = spec if motion is None else with_motion(spec, motion)
        evaluations = steps or (QUICK_EVALUATIONS if quick else EVALUATIONS)
        search = PoseSearch(CyclePlan(timed), evaluations, stop)
    yield from search_plans(search, until_met=until_met, checkpoint=checkpoint)
