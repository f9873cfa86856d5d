"""The steps of the flow that start from a spec as single calls, each by the name of the command that prints its result.

Where a room's own function yields progress or takes its input in pieces, it stands behind one of these. Those that
start from a log, which load more of SciPy than all else together, stand in `api.log_flow`.
"""

from collections.abc import Callable, Sequence

from gradcal_jax.api import frontier as frontiers
from gradcal_jax.api import optimise as search
from gradcal_jax.api.build import assemble
from gradcal_jax.api.limit import PlanLimit, limits
from gradcal_jax.api.minimise_time import NO_UNTIL_MET, minimise_time
from gradcal_jax.api.posterior_of_plan import posterior_of_plan
from gradcal_jax.api.prediction import predict
from gradcal_jax.api.sensitivity import Sensitivities, sensitivities
from gradcal_jax.api.unit_build import assemble_unit
from gradcal_jax.api.unit_limit import unit_limits
from gradcal_jax.api.unit_prediction import posterior_of_unit
from gradcal_jax.api.unit_sentences import unit_warnings
from gradcal_jax.api.warnings import warnings
from gradcal_jax.files import Prediction, Spec
from gradcal_jax.files.design import TIMES
from gradcal_jax.files.spec import expect_spec
from gradcal_jax.files.unit_spec import UnitSpec


def check(spec: Spec | UnitSpec) -> list[str]:
    """What a spec's prediction should not be read without, in sentences: what the plan cannot observe, and where a
    requirement goes beyond the temperatures (°C) and rates (deg/s) that the plan visits. Empty: nothing.

    Errors: none; whatever is wrong with a file, `read_spec` has refused already.
    """
    if isinstance(spec, UnitSpec):
        unit = assemble_unit(spec)
        return unit_warnings(unit, posterior_of_unit(unit))
    built = assemble(spec)
    return warnings(built, {channel: posterior_of_plan(built, channel) for channel in built.channels})


def compare(*specs: Spec | UnitSpec) -> list[Prediction]:
    """The prediction of each spec (`predict`: s, ppm, deg/h), with what its requirements are limited by.

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
    further than to a plan that meets every target with a margin of 10 %. `watch` is told of progress
    (`api.optimise.Step`: `best` in `unit`, `share` of the work). Returns `api.optimise.Optimised`: the rounded `spec`,
    `now` its residual and `before` the first plan's, in `unit` (ppm or deg/h; minutes, where time is minimised),
    `converged` and a `sentence` that says why or why not, the limits that bind and what easing them is worth. The best
    of several local optima: `limit` says how much another plan could still gain.

    Errors: `ValueError` without a [design], where limits exclude each other, where nothing can be observed, for
    targets that are not met in the time allowed, and for `until_met` without a target or of the shortest plan.
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
    """What no plan on this rig in this time can do better than, for every scale-factor requirement of a gradient plan;
    of a whole unit, for every requirement with a proof (`gradcal_jax.api.unit_limit`).

    Each `api.limit.PlanLimit` has `certified` (proven) and `value` (of the spec's own plan) in `unit`, the plan's
    `efficiency`, and `relaxed`: what the proof lets a plan do that the rig does not. The derivation, a convex problem
    with its certificate, stands in `gradcal_jax.design.limit`.

    Errors: `ValueError` for a plan without moves, and without a requirement that has a proof.
    """
    return unit_limits(spec) if isinstance(spec, UnitSpec) else limits(expect_spec(spec))


def frontier(spec: Spec, motion_s: Sequence[float], *, steps: int = search.STEPS) -> list[frontiers.FrontierPoint]:
    """The best residual for each of several durations of the ramp, `motion_s` in s, soaks not counted.

    Each `api.frontier.FrontierPoint` has `motion` (s) and its `plan` as `optimise` gives it, or None and the `reason`.

    Errors: as `optimise`, where no duration has a plan and only one was asked for.
    """
    return list(frontiers.frontier(expect_spec(spec), list(motion_s), steps=steps))


def sensitivity(spec: Spec | UnitSpec) -> Sensitivities:
    """What one per cent more of every figure of sensor, rig and plan changes, in per cent of each residual.

    `rows` of (requirement, figure, percent), the largest first; `residuals` of (value, unit) by requirement, in ppm or
    deg/h. For an optimised plan it is also what is left once the plan is optimised again (envelope theorem). Of a whole
    unit they are central differences of the prediction, two predictions a figure.

    Errors: `ValueError` where nothing is required, or where the plan cannot observe what is.
    """
    return sensitivities(spec if isinstance(spec, UnitSpec) else expect_spec(spec))
