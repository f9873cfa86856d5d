"""`optimise`: the best plan for a spec."""

import logging
from collections.abc import Callable, Iterator

from gradcal_jax.design.cycle_plan import CyclePlan
from gradcal_jax.design.pose_search import PoseSearch
from gradcal_jax.design.searching import Optimised, SearchStep, search_plans
from gradcal_jax.design.visits import motion_time, visit_choices, with_motion
from gradcal_jax.spec.design import Design
from gradcal_jax.spec.spec import expect_spec
from gradcal_jax.spec.spec_sections import Spec

_LOG = logging.getLogger(__name__)

BY_HAND = (
    'rig.table.drive is "hand": the search plans turns of a motor. Optimise the plan with drive = "motor" and '
    'moves without shape = "hand", then write its turns as turns by hand, with the durations that a person needs'
)
"""Why no plan of turns by hand is searched."""


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
    in `unit` (ppm or deg/h), all requirements in `rows`, `converged` and a `sentence`
    with the reason. It is the best of several local optima: `limit` bounds what another plan could still gain.

    Errors: `ValueError` where limits exclude each other, where nothing can be observed, and for `until_met` without a
    target.
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
    stop: Callable[[], bool] = lambda: False,
) -> Iterator[SearchStep | Optimised]:
    """The search of `optimise`: a `SearchStep` every few iterations and the `Optimised` plan at the end.

    `stop`: called after every step; once true, the best plan so far is finished. Errors: `ValueError` when limits
    exclude each other, nothing can be observed, the table is turned by hand or, with `until_met`, there is no target.
    """
    spec = expect_spec(spec)
    stands, design = not spec.gradient_schedule.steps, spec.design or Design()
    if spec.rig.table.drive == "hand" and not stands:
        raise ValueError(BY_HAND)
    limited = design.max_motion or design.max_total
    timed = with_motion(spec, motion_time(spec, design)) if limited else spec
    visited = spec.turns_one_gyro and not stands
    plans = [CyclePlan(timed, times) for times in visit_choices(timed, design)] if visited else [CyclePlan(timed)]
    yield from search_plans(PoseSearch(plans, steps, stop, quick=quick), until_met=until_met)


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
