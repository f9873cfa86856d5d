"""The steps that start from a spec, each one function with the name of its command.

They wrap functions that yield progress or take their input in parts. Steps that start from a log are in
`api.log_flow`, since they load most of SciPy.
"""

import logging
from collections.abc import Callable, Sequence

from gradcal_jax.api import frontier as frontiers
from gradcal_jax.api.imu_build import build_imu, imu_posterior
from gradcal_jax.api.limit import PlanLimit, limits
from gradcal_jax.api.optimise import optimise as searched
from gradcal_jax.api.plan_sentences import plan_warnings
from gradcal_jax.api.search_results import Optimised, SearchStep
from gradcal_jax.files.spec import expect_spec
from gradcal_jax.files.spec_sections import Spec

_LOG = logging.getLogger(__name__)


def check(spec: Spec) -> list[str]:
    """Warnings on a spec's prediction, in sentences: parameter combinations that the plan cannot observe, and
    requirements beyond the temperatures (°C) and rates (deg/s) that the plan visits.

    Errors: none; `read_spec` has validated the spec.
    """
    built = build_imu(expect_spec(spec))
    return plan_warnings(built, imu_posterior(built))


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
    margin of 10 %. `watch` is called with progress (`api.search_results.SearchStep`: `best` in `unit`, `share` of the
    work). Returns `api.search_results.Optimised`: the rounded `spec`, `now` its residual and `before` the first plan's,
    in `unit` (ppm or deg/h; minutes, where time is minimised), all requirements in `rows`, `converged` and a `sentence`
    with the reason, and the limits that bind with their shadow prices. It is the best of several local
    optima: `limit` bounds what another plan could still gain.

    Errors: `ValueError` without a [design] for an axis, where limits exclude each other, where nothing can be observed,
    for targets that are not met in the time allowed, and for `until_met` without a target or with a minimised time.
    """
    for event in searched(spec, steps=steps, quick=quick, until_met=until_met):
        if isinstance(event, Optimised):
            _LOG.info("optimise: %.4g %s; %s", event.now, event.unit, event.sentence)
            return event
        _LOG.info("optimise: %s %.4g %s, %.0f %% done", event.name, event.best, event.unit, 100.0 * event.share)
        watch(event)
    raise AssertionError("a search ends with its result")


def limit(spec: Spec) -> list[PlanLimit]:
    """The proven lower limit on the residual of any plan on this rig in this time, for every requirement of a gradient
    plan that has a proof (`gradcal_jax.api.axis_limit`, `gradcal_jax.api.limit`).

    Each `api.limit.PlanLimit` has `certified` (proven) and `value` (of the spec's own plan) in `unit`, the plan's
    `efficiency`, and `relaxed`: the limits of the rig that the proof leaves out. The derivation for a scale factor, a
    convex problem with its certificate, is in `gradcal_jax.design.limit`.

    Errors: `ValueError` for a standard plan, and without a requirement that has a proof.
    """
    return limits(spec)


def frontier(spec: Spec, motion_s: Sequence[float], *, steps: int | None = None) -> list[frontiers.FrontierPoint]:
    """The best residual for each of several durations of the ramp, `motion_s` in s, soaks not counted.

    Each `api.frontier.FrontierPoint` has `motion` (s) and its `plan` as `optimise` gives it, or None and the `reason`.

    Errors: as `optimise`, where no duration has a plan and only one was asked for.
    """
    return list(frontiers.frontier(spec, list(motion_s), steps=steps))
