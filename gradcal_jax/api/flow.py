"""The steps that start from a spec, each one function with the name of its command.

They wrap functions that yield progress or take their input in parts. Steps that start from a log are in
`api.log_flow`, since they load most of SciPy.
"""

from collections.abc import Callable, Sequence

from gradcal_jax.api import frontier as frontiers
from gradcal_jax.api import optimise as search
from gradcal_jax.api.limit import PlanLimit, limits
from gradcal_jax.api.minimise_time import NO_UNTIL_MET, minimise_time
from gradcal_jax.api.prediction import predict
from gradcal_jax.api.unit_build import assemble_unit, posterior_of_unit
from gradcal_jax.api.unit_limit import unit_limits
from gradcal_jax.api.unit_sentences import unit_warnings
from gradcal_jax.files import Prediction, Spec
from gradcal_jax.files.axis_as_imu import general
from gradcal_jax.files.design import TIMES
from gradcal_jax.files.spec import expect_spec
from gradcal_jax.files.unit_spec import UnitSpec


def check(spec: Spec | UnitSpec) -> list[str]:
    """Warnings on a spec's prediction, in sentences: parameter combinations that the plan cannot observe, and
    requirements beyond the temperatures (°C) and rates (deg/s) that the plan visits.

    Errors: none; `read_spec` has validated the spec.
    """
    built = assemble_unit(general(spec))
    return unit_warnings(built, posterior_of_unit(built))


def compare(*specs: Spec | UnitSpec) -> list[Prediction]:
    """The prediction of each spec (`predict`: s, ppm, deg/h), with the error sources that limit each requirement.

    Errors: as `predict`.
    """
    return [predict(spec, limits=True) for spec in specs]


def optimise(
    spec: Spec,
    *,
    steps: int = search.STEPS,
    quick: bool = False,
    until_met: bool = False,
    watch: Callable[[search.SearchStep], None] = lambda _: None,
) -> search.Optimised:
    """The best plan that gradient descent finds for a spec with a [design], rounded to the controllers' steps.

    `steps`: iterations of each start. `quick`: few starts, within some per cent of the best in seconds. `until_met`: no
    further than to a plan that meets every target with a margin of 10 %. `watch` is called with progress
    (`api.optimise.SearchStep`: `best` in `unit`, `share` of the work). Returns `api.optimise.Optimised`: the rounded
    `spec`, `now` its residual and `before` the first plan's, in `unit` (ppm or deg/h; minutes, where time is
    minimised), `converged` and a `sentence` with the reason, the limits that bind and their shadow prices. It is the
    best of several local optima: `limit` bounds what another plan could still gain.

    Errors: `ValueError` without a [design], where limits exclude each other, where nothing can be observed, for
    targets that are not met in the time allowed, and for `until_met` without a target or with a minimised time.
    """
    expect_spec(spec)
    shortest = spec.design is not None and spec.design.minimise in TIMES
    if shortest and until_met:
        raise ValueError(NO_UNTIL_MET)
    options = {"steps": steps, "quick": quick}
    events = minimise_time(spec, **options) if shortest else search.optimise(spec, **options, until_met=until_met)
    for event in events:
        if isinstance(event, search.Optimised):
            return event
        watch(event)
    raise AssertionError("a search ends with its result")


def limit(spec: Spec | UnitSpec) -> list[PlanLimit]:
    """The proven lower limit on the residual of any plan on this rig in this time: for every scale-factor requirement
    of a gradient plan; of a whole unit, for every requirement with a proof (`gradcal_jax.api.unit_limit`).

    Each `api.limit.PlanLimit` has `certified` (proven) and `value` (of the spec's own plan) in `unit`, the plan's
    `efficiency`, and `relaxed`: the limits of the rig that the proof leaves out. The derivation, a convex problem with
    its certificate, is in `gradcal_jax.design.limit`.

    Errors: `ValueError` for a plan without moves, and without a requirement that has a proof.
    """
    return unit_limits(spec) if isinstance(spec, UnitSpec) else limits(expect_spec(spec))


def frontier(spec: Spec, motion_s: Sequence[float], *, steps: int = search.STEPS) -> list[frontiers.FrontierPoint]:
    """The best residual for each of several durations of the ramp, `motion_s` in s, soaks not counted.

    Each `api.frontier.FrontierPoint` has `motion` (s) and its `plan` as `optimise` gives it, or None and the `reason`.

    Errors: as `optimise`, where no duration has a plan and only one was asked for.
    """
    return list(frontiers.frontier(expect_spec(spec), list(motion_s), steps=steps))
