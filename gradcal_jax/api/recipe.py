"""A spec's plan as a recipe: rounded to what the controllers accept, predicted as rounded."""

from collections.abc import Mapping
from typing import TYPE_CHECKING, Any

import gradcal_jax
from gradcal_jax.api.contract_rows import versions_of
from gradcal_jax.api.prediction import predict
from gradcal_jax.files.recipe import FORMAT, Predicted, Recipe, RecipeOrigin
from gradcal_jax.files.rounding import ControllerSteps, rounded, steps_of
from gradcal_jax.files.spec import expect_spec
from gradcal_jax.files.spec_sections import Spec
from gradcal_jax.files.tracks import Stability, tracks_of

if TYPE_CHECKING:
    from gradcal_jax.api.search_results import Optimised

_VERSIONS = ("jax", "numpy", "equinox")
NOT_OPTIMISED = "not optimised: the plan of the spec"


def recipe(
    plan: "Spec | Optimised",
    *,
    resolution: ControllerSteps | None = None,
    stability: Stability | None = None,
    keep_shapes: bool = False,
    status: str = "",
    seed: int | None = None,
    optimisation: Mapping[str, Any] | None = None,
    notes: tuple[str, ...] = (),
) -> Recipe:
    """The plan of a spec, or an optimised one, made executable, with the prediction (ppm, deg/h) of what is executed.

    `resolution`: the controllers' steps; None: those of `[rig.resolution]`, and defaults. `stability`: when a
    temperature counts as stable, and how long to wait for it. `keep_shapes`: the table follows any shape of motion;
    without it turns become trapezoids of the same angle, peak rate and duration. `status`, `seed`, `optimisation` (of
    TOML's types) and `notes` are copied; an optimised plan has its own.

    Errors: `SpecError` where the rounded plan leaves a limit of the rig.
    """
    spec = expect_spec(getattr(plan, "spec", plan))
    if not isinstance(plan, Spec):
        from gradcal_jax.api.search_results import record_of

        status, optimisation = status or plan.sentence, optimisation or record_of(plan)
        seed = plan.spec.design.seed if seed is None and plan.spec.design is not None else seed
    steps = resolution or steps_of(spec)
    executable = rounded(spec, steps, keep_shapes=keep_shapes)
    chamber, motion = tracks_of(executable.spec, None if steps.acceleration is None else float(steps.acceleration))
    rows = Predicted.of(predict(executable.spec, limits=True, notices=True))
    fields: dict[str, Any] = {
        "format": FORMAT,
        "title": spec.title,
        "status": status or NOT_OPTIMISED,
        "notes": (*notes, *executable.notes) or None,
        "rounded": executable.changes or None,
        "made": RecipeOrigin(
            by=f"gradcal {gradcal_jax.__version__}", versions=versions_of(_VERSIONS), **_without_none(seed=seed)
        ),
        "resolution": ControllerSteps(**_without_none(**{n: getattr(steps, n) for n in ControllerSteps.model_fields})),
        # With defaults, which may change in another version.
        "stability": Stability(**{n: getattr(stability or Stability(), n) for n in Stability.model_fields}),
        "chamber": chamber,
        "motion": motion,
        "prediction": rows,
        "optimisation": None if optimisation is None else dict(optimisation),
        "spec": executable.spec,
    }
    return Recipe(**_without_none(**fields))


def _without_none(**values: Any) -> dict[str, Any]:
    """The values that are not None: a file has no key for None."""
    return {name: value for name, value in values.items() if value is not None}
